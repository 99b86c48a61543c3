"""The page of any machine, a marimo app: sliders of its numbers, its motion, a diagram, and the
machine moving. The other files compute and draw."""

import marimo  # pyright: ignore[reportMissingImports]

app = marimo.App(width="full", app_title="vi_jax")


@app.cell
def _():
    import html
    import time
    from base64 import b64encode

    import marimo as mo  # pyright: ignore[reportMissingImports]

    from vi_jax.explore import controls, subject
    from vi_jax.explore.diagram import SHOWN
    from vi_jax.explore.pictures import MAPS, DiagramPicture, MotionPicture, gif_of
    from vi_jax.explore.serve import served

    return (
        MAPS, SHOWN, DiagramPicture, MotionPicture, b64encode, controls, gif_of, html, mo, served,
        subject, time,
    )  # fmt: skip


@app.cell
def _(mo, served, subject):
    own, subjects = served(), {}
    kinds = {**({} if own is None else {own[0]: None}), **subject.ready()}
    menu = mo.ui.dropdown(list(kinds), value=next(iter(kinds)), label="machine")
    tab = mo.ui.tabs({"Motion": "", "Diagram": "", "Animation": ""})
    mo.hstack([menu, tab], justify="start", gap=2)
    return kinds, menu, own, subjects, tab


@app.cell
def _(DiagramPicture, MotionPicture, kinds, menu, mo, own, subject, subjects):
    # Compiled when it is first chosen; the machine that the command names is already.
    if menu.value not in subjects:
        if kinds[menu.value] is None:
            chosen = own[1]
        else:
            chosen = subject.Subject(kinds[menu.value]())
            with mo.status.spinner(title=f"compiling the {menu.value}"):
                chosen.compile(lambda step: None)
        subjects[menu.value] = (
            chosen, MotionPicture(labels=chosen.machine.labels), DiagramPicture(),
        )  # fmt: skip
    shown, picture, wide = subjects[menu.value]
    return picture, shown, wide


@app.cell
def _(SHOWN, mo, shown):
    sliders = mo.ui.dictionary(
        {
            name: mo.ui.slider(
                c.low, c.high, c.step, value=c.value, label=c.label,
                include_input=True, full_width=True,
            )
            for name, c in shown.controls.items()
        }
    )  # fmt: skip
    across = mo.ui.dropdown(list(shown.names), value=shown.names[0], label="across")
    upwards = mo.ui.dropdown(list(SHOWN), value=list(SHOWN)[1], label="upwards")
    moving = mo.ui.run_button(label="let it move")
    return across, moving, sliders, upwards


@app.cell
def _(across, menu, mo, moving, sliders, tab, upwards):
    _parts = {"Motion": [], "Diagram": [across, upwards], "Animation": [moving]}
    _all = [*_parts[tab.value], *sliders.elements.values()]
    mo.sidebar([mo.md(f"### {menu.value}"), *_all], width="340px")
    return


@app.cell
def _(controls, html, mo, shown, sliders, time):
    since = time.perf_counter()
    _fault, motion, machine = controls.fault(shown.controls, sliders.value), None, None
    if _fault is None:
        try:
            machine, _ = shown.at(sliders.value)
            motion = shown.seen(sliders.value)
        except ValueError as error:
            _fault = str(error)
    mo.stop(_fault is not None, mo.Html(f'<p id="fault">{html.escape(str(_fault))}</p>'))
    return machine, motion, since


@app.cell
def _(MAPS, b64encode, html, machine, mo, motion, picture, shown, since, tab, time):
    mo.stop(tab.value != "Motion" or motion is None)
    assert motion is not None
    _png = picture.draw(motion, shown.stops(machine), which=MAPS[1])
    _words = {"": motion.fault or motion.stability, **shown.words(motion)}
    _told = "; ".join(html.escape(f"{name} {text}".strip()) for name, text in _words.items())
    _took = 1000 * (time.perf_counter() - since)
    mo.Html(
        f'<p id="regime"><b>{html.escape(motion.regime)}</b><br>{_told}</p>'
        f'<img id="motion" style="max-width: 100%" alt="{html.escape(motion.regime)}" '
        f'src="data:image/png;base64,{b64encode(_png).decode()}">'
        f'<p id="took" style="opacity: 0.6"><small>redrawn in {_took:.0f} ms</small></p>'
    )
    return


@app.cell
def _(across, html, mo, motion, shown, sliders, tab, upwards, wide):
    mo.stop(tab.value != "Diagram" or motion is None)
    _found = shown.diagram(sliders.value, across.value)
    _axes = wide.set(
        _found,
        sliders.value[across.value],
        shown=upwards.value,
        label=shown.controls[across.value].label,
    )
    mo.vstack([_axes.figure, mo.Html(
        f'<p id="diagram">{html.escape(across.value)}: each value from the same start, '
        f'{shown.before} cycles before {_found.Y.shape[1]} are drawn.</p>'
    )])  # fmt: skip
    return


@app.cell
def _(b64encode, gif_of, machine, mo, motion, moving, tab):
    mo.stop(tab.value != "Animation" or motion is None)
    assert motion is not None
    mo.stop(not moving.value, mo.md("*Set the sliders, then let it move: some seconds of work.*"))
    _gif = gif_of(motion, machine)
    mo.Html(
        f'<img id="moving" style="max-width: 100%" alt="{motion.regime}" '
        f'src="data:image/gif;base64,{b64encode(_gif).decode()}">'
    )
    return


if __name__ == "__main__":
    app.run()
