"""Animations and schematics: frames, files and error messages."""

import base64

import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")

import numpy as np
import pytest
import vi_jax as vi
from matplotlib.figure import Figure
from PIL import Image
from vi_jax.plot.colors import GREEN
from vi_jax.plot.schematic import sketch

M = vi.machines
MACHINES = {
    "ideal": vi.Scene.ideal(frequency_ratio=0.9, damping_ratio=0.05), "pair": M.ImpactPair(),
    "motor": vi.Parameters().scene(crank="slider"),
    "soft stop": vi.Scene(
        damping_ratio=0.05, drive=vi.IdealDrive(0.9),
        soft_stops=(vi.SoftStop(1.2, 50.0, restitution=0.5),),
    ),
}  # fmt: skip


class Own(vi.AbstractMachine):
    """A body on a spring between two stops."""

    contacts: tuple = (vi.RigidStop(1.0, 0.5), vi.RigidStop(1.0, 0.5, "left"))
    cycle: float = 6.0

    def field(self, s, state):
        return vi.OscillatorState(state.V, -state.Y)


class Drawn(Own):
    """A machine that defines its sketch."""

    def sketch(self, pen, state, phase):
        pen.ball(float(state.Y), phase, 0.1, color=pen.red)


def sampled_run(scene, start=None, cycles=2):
    start = scene.start() if start is None else start
    return vi.simulate(scene, start, cycles, samples=32, impact_log=4, throw=True)


@pytest.fixture(scope="module")
def run():
    return sampled_run(MACHINES["ideal"], MACHINES["ideal"].start(Y=1.6, V=-1.9))


def picture(figure):
    canvas = matplotlib.backends.backend_agg.FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()).astype(int)


@pytest.mark.parametrize("name", ["motor", "soft stop", "pair"])
def test_every_machine_is_drawn(name):
    scene = MACHINES[name]
    ax = vi.plot_sketch(scene, ax=Figure().subplots())
    assert ax.texts and (ax.patches or ax.lines)
    if name == "soft stop":
        return
    shown = vi.animate(sampled_run(scene), scene, seconds=0.4, fps=10)
    assert len(shown) == 4
    first, third = (picture(shown.draw(i)) for i in (0, 2))
    half = first.shape[0] // 3  # the machine must move, not only the history
    assert first.shape == third.shape and (first[:half] != third[:half]).any()


def test_frames_show_the_body_at_its_position(run):
    scene = MACHINES["ideal"]
    shown = vi.animate(run, scene, seconds=2.0, fps=25, window=(0, 2))
    figure = shown.draw(-1)
    above, below = figure.axes
    dot = below.lines[-1]
    assert float(dot.get_xdata()[0]) == pytest.approx(4.0)  # 2 cycles, in units of π
    assert float(dot.get_ydata()[0]) == pytest.approx(float(run.last.Y))
    shown.draw(len(shown) // 2)
    passed = np.asarray(below.lines[-2].get_xdata())
    assert passed[0] == pytest.approx(0.0, abs=1e-8) and passed.max() == below.lines[-1].get_xdata()
    limits = above.get_xlim(), above.get_ylim()

    def body():
        return max(p.get_x() for p in above.patches if hasattr(p, "get_x"))

    places = [body()]
    for i in range(len(shown) - 1):
        shown.draw(i)
        places.append(body())
        assert (above.get_xlim(), above.get_ylim()) == limits
    # The body's range is that of the motion, and ends at the stop.
    walked = float(run.y_max.max() - run.y_min.min())
    assert np.ptp(places) == pytest.approx(walked, abs=0.15)
    wall = max(line.get_xdata()[0] for line in above.lines if line.get_color() == GREEN
               and len(set(line.get_xdata())) == 1)  # fmt: skip
    assert max(places) + 0.8 <= wall + 1e-9


def test_a_machine_may_define_its_sketch():
    own, drawn = Own(), Drawn()
    start = vi.OscillatorState(jnp.asarray(0.5), jnp.asarray(0.0))
    plain = vi.plot_sketch(own, start, ax=Figure().subplots())
    assert len(plain.patches) == 2  # a body, filled and outlined
    assert len(plain.lines) > 4  # two walls, the ground
    with pytest.raises(ValueError, match="`start` is missing"):
        vi.plot_sketch(own)
    ax = Figure().subplots()
    sketch(drawn, vi.plot.Pen(ax), start, 0.25)
    assert ax.patches[0].center == (0.5, 0.25)


def test_files_are_written(run, tmp_path):
    shown = vi.animate(run, MACHINES["ideal"], seconds=0.4, fps=10)
    shown.save(tmp_path / "motion.gif")
    with Image.open(tmp_path / "motion.gif") as gif:
        assert gif.n_frames == 4 and gif.size[0] >= 600 and gif.info["duration"] == 100
    assert (tmp_path / "motion.gif").stat().st_size < 200_000
    shown.save(str(tmp_path / "motion.html"))
    text = (tmp_path / "motion.html").read_text()
    first = text.split("data:image/png;base64,")[1].split('"')[0].replace("\\\n", "")
    assert base64.b64decode(first)[:4] == b"\x89PNG"
    assert "data:image/png;base64," in shown._repr_html_()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["motion.gif", "motion.html"]
