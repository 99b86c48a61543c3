"""The animation of the README: one machine in motion, and the sections of many starts.

`python experiments/moving_picture.py` writes `experiments/figures/moving_picture.gif`.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from vi_jax.plot import BLUE, RED
from vi_jax.plot.schematic import pen_for, sketch

TARGET = Path(__file__).parent / "figures" / "moving_picture.gif"
# Starts along each axis, cycles shown, frames per cycle.
GRID, CYCLES, FRAMES = 20, 12, 8
# With these parameters two motions of period 4π are stable (`examples/minimal_kick.py`).
SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)
MOTIONS = {"one motion": (1.283, 1.007), "the other one": (1.528, 1.314)}
LOW, HIGH = (-4.0, -4.0), (2.0, 4.0)


def simulated() -> tuple[np.ndarray, np.ndarray, Any]:
    """Return the sections of all starts, (starts, cycles + 1, 2); the number of the motion that
    each settles on; the sampled run that is drawn as a machine."""
    Y, V = (x.ravel() for x in jnp.meshgrid(*map(lambda a, b: jnp.linspace(a, b, GRID), LOW, HIGH)))
    run = jax.vmap(lambda Y, V: vi.simulate(SCENE, SCENE.start(Y=Y, V=V), CYCLES))(Y, V)
    ends = jax.vmap(lambda x: vi.simulate(SCENE, x, 600).last)(run.last)
    last = np.stack([ends.Y, ends.V], -1)
    distances = []
    for Y0, V0 in MOTIONS.values():
        orbit = vi.find_orbit(SCENE, SCENE.start(Y=Y0, V=V0), cycles=2)
        after = vi.simulate(SCENE, orbit.state, 1).sections
        points = np.stack([after.Y, after.V], -1)
        distances.append(np.linalg.norm(last[:, None] - points, axis=-1).min(1))
    settled = np.argmin(distances, 0)
    assert np.min(distances, 0).max() < 1e-6, "a start has settled elsewhere"
    rest = vi.simulate(SCENE, SCENE.start(Y=0.0, V=0.0), CYCLES, samples=FRAMES)
    return np.stack([run.sections.Y, run.sections.V], -1), settled, rest


def drawn(sections: np.ndarray, settled: np.ndarray, rest: vi.Run) -> Iterator[Image.Image]:
    """Yield the pictures, one for each sample."""
    figure = Figure(figsize=(7.0, 2.6), dpi=90, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    above, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    assert rest.samples is not None
    states = jax.tree_util.tree_map(np.asarray, rest.samples.state)
    pen = pen_for(SCENE, above, states.Y)
    for i in range(2 * FRAMES):
        sketch(SCENE, pen, _at(states, i), 2 * np.pi * i / FRAMES)
    box = above.dataLim
    limits = (box.x0 - 0.3, box.x1 + 0.3), (box.y0 - 0.3, box.y1 + 0.3)
    colors = np.where(settled == 0, BLUE, RED)
    dots = right.scatter(*sections[:, 0].T, s=5, c=colors, lw=0)
    (ring,) = right.plot([], [], "o", ms=8, mfc="none", mec="black", mew=1.5)
    right.set(
        xlim=(-4.2, 2.2), ylim=(-4.4, 4.4), xlabel="position Y (a)", ylabel="velocity V (a ω)"
    )
    right.spines[["top", "right"]].set_visible(False)

    for i in range(CYCLES * FRAMES + 1):
        cycle = i // FRAMES
        above.clear()
        sketch(SCENE, pen, _at(states, i), 2 * np.pi * (i % FRAMES) / FRAMES)
        above.axis("off")
        above.set(aspect="equal", xlim=limits[0], ylim=limits[1])
        dots.set_offsets(sections[:, cycle])
        ring.set_data([states.Y[cycle * FRAMES]], [states.V[cycle * FRAMES]])
        right.set_title(f"{len(sections)} starts after {cycle:2d} cycles", fontsize=10)
        canvas.draw()
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def _at(states: Any, i: int) -> Any:
    return jax.tree_util.tree_map(lambda x: jnp.asarray(x[i]), states)


def main() -> None:
    """Write the pictures with one palette, so that unchanged pixels take no space in the file."""
    frames = list(drawn(*simulated()))
    exact, plain = Image.Quantize.MAXCOVERAGE, Image.Dither.NONE
    palette = frames[FRAMES].quantize(20, method=exact, dither=plain)
    first, *others = (x.quantize(palette=palette, dither=plain) for x in frames)
    first.save(TARGET, save_all=True, append_images=others, loop=0, optimize=True, duration=70)
    print(TARGET, TARGET.stat().st_size)


if __name__ == "__main__":
    main()
