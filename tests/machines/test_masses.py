"""Masses that depend on time, and plots of several coordinates."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from matplotlib.figure import Figure
from scipy.integrate import quad
from scipy.optimize import brentq


class Growing(vi.AbstractMachine):
    """A free body with a mass that depends on time: m(s) V is constant."""

    contacts: tuple = (vi.RigidStop(1.0, 0.5),)
    cycle: float = 2 * np.pi

    @property
    def coordinates(self):
        def place(z):
            return z.Y

        def speed(z):
            return z.V

        def put(z, Y, V):
            return vi.OscillatorState(Y, V)

        return (vi.Coordinate(place, speed, put, self.weight),)

    def weight(self, s, z):
        return 2 + jnp.sin(s)

    def field(self, s, z):
        return vi.OscillatorState(z.V, -z.V * jnp.cos(s) / self.weight(s, z))


class Pairs(Growing):
    @property
    def coordinates(self):
        return (super().coordinates[0]._replace(mass=lambda s, z: (s, z.V)),)


def test_a_mass_may_be_a_function():
    start = vi.OscillatorState(jnp.asarray(0.0), jnp.asarray(1.0))
    run = vi.simulate(Growing(), start, 1, impact_log=2, method=vi.Adaptive(rtol=1e-11))
    met = brentq(lambda s: quad(lambda s: 2 / (2 + np.sin(s)), 0, s)[0] - 1, 0.5, 3.0)
    speed = 2 / (2 + np.sin(met))
    np.testing.assert_allclose(run.impact_log.phase[0, 0], met, rtol=1e-9)
    lost = 0.5 * (2 + np.sin(met)) * (1 - 0.5**2) * speed**2
    np.testing.assert_allclose(run.impact_energy[0], lost, rtol=1e-9)
    with pytest.raises(TypeError, match=r"`mass` of coordinate 0 of a Pairs must be one number"):
        vi.simulate(Pairs(), start, 1)


class Bodies(vi.Mechanical):
    """Two free bodies, each with a stop."""

    q = ("x", "y")
    mass = (1.0, 1.0)
    cycle = 3.0
    contacts = (vi.RigidStop(1.0, 0.5, on="x"), vi.RigidStop(2.0, 0.5, "left", on="y"))

    def force(self, t, q, v):
        return dict(x=0.0, y=0.0)


def test_plots_show_a_coordinate_with_its_own_stops_and_impacts():
    machine = Bodies()
    start = machine.at(v=dict(x=0.7, y=-1.1))
    run = vi.simulate(machine, start, 1, samples=30, impact_log=4, rests=False)
    assert run.impact_log.stop[0, :2].tolist() == [0, 1]
    for k, (speed, place) in enumerate(((0.7, 1.0), (-1.1, -2.0))):
        path = vi.plot.motion_path(run, machine=machine, coordinate=k)
        s = 3 * path.cycles
        wanted = np.where(s * abs(speed) <= abs(place), speed * s, 1.5 * place - 0.5 * speed * s)
        np.testing.assert_allclose(path.Y, wanted, atol=1e-9)
        ends = [np.sort(path.V)[[0, -1]].tolist()]
        np.testing.assert_allclose(ends[0], sorted((speed, -0.5 * speed)), atol=1e-9)
        for draw, along in ((vi.plot.plot_history, 1), (vi.plot.plot_phase_portrait, 0)):
            ax = draw(run, machine=machine, ax=Figure().subplots(), coordinate=k)
            stops = [x for x in ax.lines if x.get_label() == "stop"]
            assert [float(x.get_data()[along][0]) for x in stops] == [place]
    shown = vi.plot.animate(run, machine, seconds=2.0, fps=10)._frames.positions
    np.testing.assert_allclose(shown[0].max(), 1.0, atol=0.1)
    np.testing.assert_allclose(shown[1].min(), -2.0, atol=0.15)
    with pytest.raises(ValueError, match="`coordinate` must be at most 1"):
        vi.plot.motion_path(run, machine=machine, coordinate=2)
