"""Pictures of motions agree with the simulation, and every kind of special point can be drawn."""

from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
import vi_jax as vi
from matplotlib.figure import Figure
from vi_jax.orbit import KINDS
from vi_jax.orbit.kinds import FOLLOWED

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from vi_jax.plot import motion_path, plot_history


@pytest.fixture(scope="module")
def scene():
    return vi.Scene.ideal(frequency_ratio=0.9)


@pytest.fixture(scope="module")
def run(scene):
    return vi.simulate(
        scene, scene.start(), 6, method=vi.ExactFlight(), samples=32, impact_log=2, throw=True
    )


def _axes():
    return Figure().subplots()


def test_path_holds_the_samples_and_the_impacts(scene, run):
    path = motion_path(run, machine=scene)
    impacts = int(run.impacts.sum())
    assert impacts > 0
    assert path.Y.size == 6 * 32 + 1 + 2 * impacts
    assert (np.diff(path.cycles) >= 0).all()
    touching = np.flatnonzero(path.Y == 2.0)
    assert touching.size == 2 * impacts
    before, after = path.V[touching[::2]], path.V[touching[1::2]]
    assert (before > 0).all()
    np.testing.assert_allclose(after, -0.5 * before)
    # Samples do not reach the stop; impacts, drawn if a machine is given, lie on it.
    assert motion_path(run).Y.max() < 2.0 == path.Y.max()
    # Positions are continuous: a misplaced impact would cause a jump of several tenths.
    step = np.abs(np.diff(path.Y))
    assert step.max() < 1.05 * np.abs(path.V).max() * 2 * np.pi / 0.9 / 32


def test_stop_on_the_left():
    left = vi.Scene(
        damping_ratio=0.01, drive=vi.IdealDrive(0.9), stops=(vi.RigidStop(1.0, 0.7, side="left"),),
    )  # fmt: skip
    run = vi.simulate(left, left.start(), 6, samples=32, impact_log=4)
    path = motion_path(run, machine=left)
    at = np.flatnonzero(path.Y == -1.0)
    assert at.size == 2 * int(run.impacts.sum()) > 0
    assert (path.V[at[::2]] < 0).all() and (path.V[at[1::2]] > 0).all()


def test_history_axis_and_stop(scene, run):
    ax = _axes()
    assert plot_history(run, machine=scene, ax=ax, window=(2, 4), shift=1) is ax
    line, stop = ax.lines
    x = line.get_xdata()
    # The x axis is the crank angle in units of π: two per cycle.
    assert x.min() == pytest.approx(6.0) and x.max() == pytest.approx(10.0)
    assert set(stop.get_ydata()) == {2.0}
    assert ax.get_ylabel() == "Y = y/a"
    ticks = ax.xaxis.get_major_formatter()
    assert [ticks(v, 0) for v in (0, 1, 4, -1)] == ["0", "π", "4π", "-π"]
    cycles = plot_history(run.samples, ax=_axes(), unit="cycles")
    assert cycles.lines[0].get_xdata().max() == pytest.approx(6.0)


def test_history_of_a_machine_counts_cycles():
    ball = vi.machines.BouncingBall(restitution=0.5, acceleration=3.0)
    run = vi.simulate(ball, ball.start(), 3, samples=16)
    ax = plot_history(run, machine=ball, ax=_axes())
    assert ax.get_xlabel() == "cycles since the start" and ax.get_ylabel() == "height (g/ω²)"
    assert ax.lines[0].get_xdata().max() == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("name", "width", "points", "line"), [("journal", 85 / 25.4, 8, 1.0), ("slides", 6, 16, 2.2)]
)
def test_sizes_of_figure_words_and_lines(run, name, width, points, line):
    with plt.style.context(f"vi_jax.plot.{name}"):
        ax = vi.plot_history(run)
    assert ax.figure.get_size_inches()[0] == pytest.approx(width, abs=1e-3)
    assert ax.xaxis.label.get_size() == points
    plain = vi.plot_history(run)
    assert tuple(plain.figure.get_size_inches()) == (7, 3.5)
    ratio = ax.lines[0].get_linewidth() / plain.lines[0].get_linewidth()
    assert ratio == pytest.approx(line / 1.5)
    plt.close(plain.figure)
    plt.close(ax.figure)


SCENE = vi.Scene.ideal(frequency_ratio=0.9)


class Drawn(vi.Boundary):
    """A boundary of a line, with a special point of each kind."""

    names = ("stops.0.gap", "stops.0.restitution")
    parameters = np.array([[1.0, 0.2], [2.0, 0.8]])
    impact_speed = np.zeros((2, 1))
    special = tuple(SimpleNamespace(kind=k, parameters=np.array([1.5, 0.5])) for k in KINDS)


@pytest.mark.parametrize("kind", FOLLOWED)
def test_curves_of_every_kind_are_drawn(kind):
    problem = SimpleNamespace(cycles=1, machine=SCENE, conditions=(SimpleNamespace(kind=kind),))
    curve = Drawn(problem=problem, steps=[], ends=("bounds", "bounds"))
    ax = vi.plot_boundary(curve, ax=Figure().subplots())
    labels = [line.get_label() for line in ax.lines]
    assert labels[0] == kind and set(KINDS) <= set(labels)
    dashes = [row.dash for row in KINDS.values() if row.dash is not None]
    assert len({str(dash) for dash in dashes}) == len(dashes) == len(FOLLOWED)
