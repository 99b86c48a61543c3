# %% [markdown]
# # How quickly the explorer redraws
#
# What `vi-jax explore` does when a slider moves, without the browser: it computes the motion anew
# and draws its picture. Each slider is moved 50 times over its range, the others staying where they
# begin; frames and labels are drawn anew only where a motion leaves them.
#
# Run with `python experiments/benchmarks/explorer.py` (`--quick` for few moves, writes nothing).

# %%
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path

import jax
import numpy as np
from vi_jax.explore import controls
from vi_jax.explore.diagram import SHOWN, diagram
from vi_jax.explore.motion import look
from vi_jax.explore.pictures import DiagramPicture, MotionPicture
from vi_jax.explore.serve import compile_all

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.study import QUICK, write
from tools.tables import table

MOVES = 3 if QUICK else 50
LIMIT = 0.2  # seconds, within which a redrawing seems immediate

Values = Mapping[str, float]

# %%
PICTURES = {"ideal": MotionPicture(), "motor": MotionPicture(motor=True)}
DIAGRAM = DiagramPicture()


def ideal(values: Values) -> bytes:
    """The picture of a motion with the ideal drive."""
    machine, start = controls.ideal(values)
    return PICTURES["ideal"].draw(look(machine, start, int(values["settle"])), values["gap"])


def motor(values: Values) -> bytes:
    """The picture of a motion with the motor."""
    machine, start = controls.motor(values)
    motion = look(machine, start, int(values["settle"]))
    return PICTURES["motor"].draw(motion, float(machine.stops[0].gap))


def bifurcations(values: Values) -> bytes:
    """The diagram over the frequency ratio."""
    across = controls.NUMBERS["frequency_ratio"]
    found = diagram(
        {name: values[name] for name in controls.NUMBERS}, "frequency_ratio",
        (across.low, across.high), Y=values["Y"], V=values["V"],
    )  # fmt: skip
    axes = DIAGRAM.set(found, values["frequency_ratio"], shown=next(iter(SHOWN)))
    stream = BytesIO()
    axes.figure.savefig(stream, format="png")  # pyright: ignore[reportAttributeAccessIssue]
    return stream.getvalue()


def moved(draw: Callable[[Values], bytes], sliders: Mapping[str, controls.Control]) -> np.ndarray:
    """Seconds by the clock of every move of every slider."""
    begin = controls.beginning(sliders)
    draw(begin)
    found = []
    for name, slider in sliders.items():
        for value in np.linspace(slider.low, slider.high, MOVES):
            since = time.perf_counter()
            draw({**begin, name: slider.nearest(float(value))})
            found.append(time.perf_counter() - since)
    return np.asarray(found)


# %%
TABS = {
    "motion, ideal drive": (ideal, controls.IDEAL),
    "motion, motor": (motor, controls.MOTOR),
    "diagram": (bifurcations, {name: controls.IDEAL[name] for name in (*controls.NUMBERS, *"YV")}),
}
compile_all(print)  # as the explorer does when it starts
rows = []
for tab, (draw, sliders) in TABS.items():
    times = moved(draw, sliders)
    late = np.mean(times > LIMIT)
    median, worst = (f"{1e3 * x:.0f}" for x in (np.median(times), times.max()))
    rows.append((tab, times.size, median, worst, f"{100 * late:.1f}"))
    print(rows[-1], flush=True)

# %%
page = f"""# How quickly the explorer redraws

{MOVES} moves of each slider over its range: computing and drawing, in ms by the clock of an idle
machine ({os.cpu_count()} cores, {platform.machine()}), without what the browser needs to show it.

![The motion where the sliders begin](../figures/explorer.png)

{table(["", "moves", "median", "worst", f"later than {1e3 * LIMIT:.0f} ms, %"], rows)}"""

values = controls.beginning(controls.IDEAL)
ideal(values)
low, high = look(*controls.ideal(values), int(values["settle"])).extremes
numbers = {"lowest position where the sliders begin": low, "highest": high}
figure = PICTURES["ideal"].figure
for artist in figure.findobj():
    artist.set_animated(False)  # the page draws them over the frame
write("explorer", page, numbers, figure)
