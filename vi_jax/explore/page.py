"""The page, a marimo app: sliders of a machine's numbers, its motion, a diagram, and an animation.
The other files compute and draw."""

import marimo  # pyright: ignore[reportMissingImports]

app = marimo.App(width="full", app_title="vi_jax")


@app.cell
def _():
    import html
    import time
    from base64 import b64encode

    import marimo as mo  # pyright: ignore[reportMissingImports]

    from vi_jax.explore.pictures import MAPS, MotionPicture, draw_diagram, gif_of
    from vi_jax.explore.serve import SERVED
    from vi_jax.explore.subject import SHOWN, ready

    return (
        MAPS, SHOWN, MotionPicture, b64encode, draw_diagram, gif_of, html, mo, ready, SERVED, time,
    )  # fmt: skip


@app.cell
def _(MAPS, SERVED, SHOWN, mo, ready):
    first, kinds, subjects = SERVED[-1], ready(), {}
    menu = mo.ui.dropdown([*dict.fromkeys([first[0], *kinds])], value=first[0], label="machine")
    tab = mo.ui.tabs({"Motion": "", "Diagram": "", "Animation": ""})
    which = mo.ui.radio(MAPS, value=MAPS[0])
    upwards = mo.ui.dropdown(list(SHOWN), value=next(iter(SHOWN)), label="upwards")
    moving = mo.ui.run_button(label="let it move")
    picked, pick = mo.state(("", {}))  # for a machine, the values chosen by a click
    mo.hstack([menu, tab], justify="start", gap=2)
    return first, kinds, menu, moving, pick, picked, subjects, tab, upwards, which


@app.cell
def _(MotionPicture, first, kinds, menu, mo, subjects):
    # Compiled at its first choice; the first machine is compiled already.
    if menu.value not in subjects:
        chosen = first[1]
        if menu.value != first[0]:
            chosen = kinds[menu.value]()
            with mo.status.spinner(title=f"compiling {menu.value}"):
                chosen.compile(lambda step: None)
        subjects[menu.value] = chosen, MotionPicture(chosen.machine.labels)
    shown, picture = subjects[menu.value]
    names = {shown.controls[name].label: name for name in shown.names}
    across = mo.ui.dropdown(names, value=next(iter(names), None), label="across")
    return across, picture, shown


@app.cell
def _(menu, mo, picked, shown):
    _machine_name, _values = picked()
    _values = shown.first_values() | (_values if _machine_name == menu.value else {})
    sliders = mo.ui.dictionary(
        {
            name: mo.ui.slider(
                c.low, c.high, c.step, value=_values[name], label=c.label,
                include_input=True, full_width=True,
            )
            for name, c in shown.controls.items()
        }
    )  # fmt: skip
    listed = [*sliders.elements.values()]  # so that a move does not render the sidebar again
    return listed, sliders


@app.cell
def _(across, listed, menu, mo, moving, tab, upwards, which):
    _parts = {"Motion": [which], "Diagram": [across, upwards, which], "Animation": [moving]}
    mo.sidebar([mo.md(f"### {menu.value}"), *_parts[tab.value], *listed], width="340px")
    return


@app.cell
def _(html, mo, shown, sliders, time):
    _since, _fault, motion = time.perf_counter(), "", None
    try:
        motion = shown.motion_at(sliders.value)
    except ValueError as error:
        _fault = str(error)
    mo.stop(motion is None, mo.Html(f'<p id="fault">{html.escape(_fault)}</p>'))
    computed = time.perf_counter() - _since
    return computed, motion


@app.cell
def _(b64encode, computed, gif_of, html, mo, motion, moving, picture, shown, tab, time, which):
    _since = time.perf_counter() - computed
    if tab.value == "Animation":
        mo.stop(not moving.value, mo.md("*Set the sliders, then let it move: it takes seconds.*"))
        _name, _kind, _drawn = "moving", "gif", gif_of(motion)
    else:
        _name, _kind, _drawn = "motion", "svg+xml", picture.draw(motion, which.value)
    _words = {"": motion.fault or motion.stability, **shown.words(motion)}
    _text = "; ".join(html.escape(f"{name} {text}".strip()) for name, text in _words.items())
    _milliseconds = 1000 * (time.perf_counter() - _since)
    mo.Html(
        f'<p id="regime"><b>{html.escape(motion.regime)}</b><br>{_text}</p>'
        f'<img id="{_name}" style="max-width: 100%" alt="{html.escape(motion.regime)}" '
        f'src="data:image/{_kind};base64,{b64encode(_drawn).decode()}">'
        f'<p id="took" style="opacity: 0.6"><small>redrawn in {_milliseconds:.0f} ms</small></p>'
    )
    return


@app.cell
def _(across, draw_diagram, html, mo, motion, shown, sliders, tab, upwards):
    mo.stop(tab.value != "Diagram" or motion is None or across.value is None)
    if not shown.before:
        with mo.status.spinner(title="compiling the diagram"):
            shown.diagram(sliders.value, across.value)
    _found = shown.diagram(sliders.value, across.value)
    _axes = draw_diagram(_found, sliders.value[across.value], upwards.value)
    place = mo.ui.matplotlib(_axes, debounce=True)
    mo.vstack([place, mo.Html(
        f'<p id="diagram">{html.escape(across.value)}: each value from the same start, '
        f'{shown.before} cycles before {_found.low.shape[1]} are drawn. A click moves the '
        f'slider there.</p>'
    )])  # fmt: skip
    return (place,)


@app.cell
def _(across, menu, pick, place, shown, sliders):
    if place.value:
        _control = shown.controls[across.value]
        _middle = (place.value.x_min + place.value.x_max) / 2
        _steps = round((_middle - _control.low) / _control.step)
        _value = min(max(_control.low + _steps * _control.step, _control.low), _control.high)
        pick((menu.value, {**sliders.value, across.value: _value}))
    return


if __name__ == "__main__":
    app.run()
