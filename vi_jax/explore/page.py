"""The page itself, a marimo app: what to show where. The other files compute and draw."""

import marimo  # pyright: ignore[reportMissingImports]

app = marimo.App(width="full", app_title="vi_jax")


@app.cell
def _():
    import html
    import time
    from base64 import b64encode

    import marimo as mo  # pyright: ignore[reportMissingImports]

    from vi_jax.explore import controls
    from vi_jax.explore.diagram import SHOWN, diagram
    from vi_jax.explore.motion import look
    from vi_jax.explore.pictures import MAPS, DiagramPicture, MotionPicture

    return (
        MAPS, SHOWN, DiagramPicture, MotionPicture, b64encode, controls, diagram, html, look, mo,
        time,
    )  # fmt: skip


@app.cell
def _(DiagramPicture, MotionPicture, b64encode, html, mo, time):
    pictures = {
        "ideal": MotionPicture(), "motor": MotionPicture(motor=True), "diagram": DiagramPicture(),
    }  # fmt: skip

    def sliders(kinds, values):
        return mo.ui.dictionary(
            {
                name: mo.ui.slider(
                    c.low, c.high, c.step, value=values[name], label=c.label,
                    include_input=True, full_width=True,
                )
                for name, c in kinds.items()
            }
        )  # fmt: skip

    def shown(motion, picture, since):
        """A motion in words and as a picture."""
        low, high = motion.extremes
        words = motion.fault or f"{motion.stability}; Y from {low:.4f} to {high:.4f}"
        took = 1000 * (time.perf_counter() - since)
        return mo.Html(
            f'<p id="regime"><b>{html.escape(motion.regime)}</b><br>{html.escape(words)}</p>'
            f'<img id="motion" style="max-width: 100%" alt="{html.escape(motion.regime)}" '
            f'src="data:image/png;base64,{b64encode(picture).decode()}">'
            f'<p style="opacity: 0.6"><small>redrawn in {took:.0f} ms</small></p>'
        )

    def stop_at(fault):
        """Say what is wrong instead of showing anything."""
        mo.stop(fault is not None, mo.Html(f'<p id="fault">{html.escape(str(fault))}</p>'))

    return pictures, shown, sliders, stop_at


@app.cell
def _(mo):
    tab = mo.ui.tabs({"Ideal drive": "", "Bifurcations": "", "Motor": ""})
    mo.vstack([tab])
    return (tab,)


@app.cell
def _(controls, mo):
    # A click in the diagram moves the sliders.
    picked, pick = mo.state(controls.beginning(controls.IDEAL))
    return pick, picked


@app.cell
def _(controls, picked, sliders):
    ideal = sliders(controls.IDEAL, picked())
    return (ideal,)


@app.cell
def _(MAPS, SHOWN, controls, mo, sliders):
    motor = sliders(controls.MOTOR, controls.beginning(controls.MOTOR))
    which = mo.ui.radio(MAPS, value=MAPS[0])
    names = {c.label: name for name, c in controls.NUMBERS.items()}
    across = mo.ui.dropdown(names, value=next(iter(names)), label="across")
    upwards = mo.ui.dropdown(list(SHOWN), value=next(iter(SHOWN)), label="upwards")
    return across, motor, upwards, which


@app.cell
def _(across, ideal, mo, motor, tab, upwards, which):
    _parts = {
        "Ideal drive": [*ideal.elements.values(), which],
        "Bifurcations": [across, upwards, *ideal.elements.values(), which],
        "Motor": [*motor.elements.values()],
    }
    mo.sidebar([mo.md("### vi_jax"), *_parts[tab.value]], width="340px")
    return


@app.cell
def _(across, controls, diagram, ideal, mo, pictures, stop_at, tab, upwards):
    mo.stop(tab.value != "Bifurcations")
    stop_at(controls.fault(controls.IDEAL, ideal.value))
    _control, _values = controls.NUMBERS[across.value], ideal.value
    _found = diagram(
        {name: _values[name] for name in controls.NUMBERS},
        across.value,
        (_control.low, _control.high),
        Y=_values["Y"],
        V=_values["V"],
    )
    _axes = pictures["diagram"].set(_found, _values[across.value], shown=upwards.value)
    place = mo.ui.matplotlib(_axes, debounce=True)
    mo.vstack([place, mo.md("*Click on the diagram to see the motion there.*")])
    return (place,)


@app.cell
def _(across, controls, ideal, pick, place):
    if place.value:
        _middle = (place.value.x_min + place.value.x_max) / 2
        pick({**ideal.value, across.value: controls.NUMBERS[across.value].nearest(_middle)})
    return


@app.cell
def _(controls, ideal, look, mo, pictures, shown, stop_at, tab, time, which):
    mo.stop(tab.value == "Motor")
    stop_at(controls.fault(controls.IDEAL, ideal.value))
    _since = time.perf_counter()
    _scene, _start = controls.ideal(ideal.value)
    _motion = look(_scene, _start, ideal.value["settle"])
    _picture = pictures["ideal"].draw(_motion, ideal.value["gap"], which=which.value)
    shown(_motion, _picture, _since)
    return


@app.cell
def _(controls, look, mo, motor, pictures, shown, stop_at, tab, time):
    mo.stop(tab.value != "Motor")
    stop_at(controls.fault(controls.MOTOR, motor.value))
    _since = time.perf_counter()
    _scene, _start = controls.motor(motor.value)
    _motion = look(_scene, _start, motor.value["settle"])
    _picture = pictures["motor"].draw(_motion, float(_scene.stops[0].gap))
    shown(_motion, _picture, _since)
    return


if __name__ == "__main__":
    app.run()
