"""Pictures of motions agree with the simulation: points, impacts, stops, units."""

import dataclasses

import matplotlib

matplotlib.use("Agg")

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from matplotlib.figure import Figure
from vi_jax.plot import motion_path, plot_history, plot_phase_portrait


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
        oscillator=vi.Oscillator(0.01),
        drive=vi.IdealDrive(0.9),
        stops=(vi.RigidStop(1.0, 0.7, side="left"),),
    )
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


class Stated(vi.AbstractMachine):
    """An oscillator between a rigid and a soft stop, in millimetres."""

    contacts = (vi.RigidStop(1.5, 0.5), vi.SoftStop(1.2, 50.0, side="left"))
    cycle: float = 6.0

    @property
    def units(self):
        return {"position": "mm", "velocity": "mm/s"}

    def field(self, s, x):
        return vi.OscillatorState(x.V, -x.Y)


def test_pictures_show_a_machines_units_and_soft_stop():
    machine, start = Stated(), vi.OscillatorState(jnp.array(1.0), jnp.array(0.0))
    run = vi.simulate(machine, start, 1, samples=16)
    assert plot_history(run, machine=machine, ax=_axes()).get_ylabel() == "position (mm)"
    portrait = plot_phase_portrait(run, machine, ax=_axes())
    assert portrait.get_xlabel() == "position (mm)" and portrait.get_ylabel() == "velocity (mm/s)"
    drawn = [line.get_xdata() for line in vi.plot_sketch(machine, start, ax=_axes()).lines]
    face = -1.2 - 0.35 * 1.5 / 2  # half a body beyond the stop
    assert any(np.allclose(x, [face, face]) for x in drawn)


def test_errors_name_the_argument(scene, run):
    with pytest.raises(ValueError, match="`motion` must have samples"):
        plot_history(dataclasses.replace(run, samples=None))
    with pytest.raises(ValueError, match="`unit` must be"):
        plot_history(run, unit="seconds")
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), run)
    with pytest.raises(ValueError, match="one motion"):
        motion_path(batch)
    samples = vi.Samples(run.samples.cycles, run.samples.time, {"q": run.samples.state.Y})
    with pytest.raises(ValueError, match="`machine` must be given"):
        motion_path(samples)


@pytest.mark.slow
def test_impacts_of_a_machine_without_a_drive_are_drawn_in_place():
    """The motion's period differs from the machine's nominal cycle."""
    valve = vi.machines.ReliefValve()
    start = valve.start(lift=2.4936, speed=0.0, pressure=1.5342)
    run = vi.find_orbit(valve, start, throw=True).trajectory()
    path = vi.plot.motion_path(run, machine=valve)
    step = float(run.duration[0]) / 128
    assert np.abs(np.diff(path.Y)).max() < 1.01 * step * np.abs(path.V).max()
    ax = plot_history(run, machine=valve, ax=_axes())
    assert ax.get_xlabel() == "time since the start"
    assert ax.lines[0].get_xdata().max() == pytest.approx(float(run.duration[0]))
