"""Orbits of machines with discrete modes that do not follow from the state."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

pytestmark = pytest.mark.slow


class Flipped(vi.AbstractMachine):
    """x'' = -(1 + 0.3 m) x - 0.04 x' + cos 2.2 s with a stop; each impact changes m to -m."""

    depth: Any = 0.3
    contacts: tuple = (vi.RigidStop(0.1, 0.8, modes=lambda machine, s, x, m: (-m,)),)
    cycle: float = 2 * np.pi / 2.2

    def modes(self, s, x):
        return (1.0,)

    def field(self, s, x, m):
        force = jnp.cos(2.2 * s) - 0.04 * x.V
        return vi.OscillatorState(x.V, force - (1 + self.depth * m) * x.Y)


def settled(cycles):
    """Return Y, V and m after some cycles, by SciPy from impact to impact."""
    period, x, m = 2 * np.pi / 2.2, np.array([-1.4, 0.0]), 1.0

    def field(t, x, m):
        return [x[1], np.cos(2.2 * t) - 0.04 * x[1] - (1 + 0.3 * m) * x[0]]

    def hit(t, x, m):
        return x[0] - 0.1

    hit.terminal, hit.direction = True, 1
    for _ in range(cycles):
        t = 0.0
        while t < period:
            out = solve_ivp(field, (t, period), x, args=(m,), events=hit, rtol=1e-9, atol=1e-11)
            t, x = out.t[-1], out.y[:, -1]
            if len(out.t_events[0]):
                x, m = np.array([0.1, -0.8 * x[1]]), -m
    return x, m


@pytest.fixture(scope="module")
def start():
    return vi.OscillatorState(jnp.asarray(-1.4), jnp.asarray(0.0))


@pytest.fixture(scope="module")
def orbit(start):
    return vi.find_orbit(Flipped(), start, 2)


def test_modes_that_alternate_double_the_period(start, orbit):
    once = vi.find_orbit(Flipped(), start)
    assert bool(once.result == vi.ORBIT_RESULTS.other_modes) and not bool(once.successful)
    assert int(orbit.cycles) == 2 and bool(orbit.stable)
    (Y, _), m = settled(240)
    by_mode = orbit.sections.Y if m == orbit.state.modes[0] else jnp.roll(orbit.sections.Y, 1)
    assert float(by_mode[0]) == pytest.approx(Y, abs=1e-7)
    assert float(orbit.sections.Y.max()) == pytest.approx(-0.461410495, abs=1e-9)


def test_all_orbits_rejects_returns_in_other_modes(start):
    region = {"start.Y": (-2.0, 0.1), "start.V": (-2.0, 2.0)}
    found = vi.all_orbits(Flipped(), 2, region=region, starts=8, start=start)
    once, twice = found.searched
    assert (once.converged, twice.motions) == (0, 1) and twice.converged > 2
    np.testing.assert_allclose(found.orbits[0].sections.Y.max(), -0.461410495, atol=1e-9)


def test_exponents_and_simulations_start_in_the_modes_of_an_orbit(orbit):
    run = vi.simulate(orbit.machine, orbit.state, 2)
    np.testing.assert_allclose(run.sections.Y[:2], orbit.sections.Y, atol=1e-8)
    np.testing.assert_allclose(run.last.Y, orbit.state.Y, atol=1e-8)
    exponents = vi.lyapunov(Flipped(), orbit.state, 400).exponents
    wanted = np.log(np.abs(orbit.multipliers)) / float(orbit.duration)
    np.testing.assert_allclose(exponents, wanted, atol=2e-4)


def test_a_branch_and_a_table_keep_the_modes(orbit):
    branch = vi.continue_orbit(orbit, parameter="depth", bounds=(0.29, 0.31))
    assert branch.ends == ("bounds", "bounds")
    (there,) = branch.at(0.305)
    run = vi.simulate(there.machine, there.state, 2)
    np.testing.assert_allclose(run.last.Y, there.state.Y, atol=1e-8)
    kept = run.to_xarray(along="section").section_mode_0
    np.testing.assert_array_equal(kept, run.modes[0])


def test_minimal_kick_raises_if_modes_do_not_follow_from_the_state(orbit):
    """Perturbed starts have the machine's initial modes, which are not those of the orbit."""
    with pytest.raises(ValueError, match="must have modes that follow from its state"):
        vi.minimal_kick(orbit.machine, orbit, progress=False)


class Other(Flipped):
    def modes(self, s, x):
        return (-1.0,)


def test_basins_follow_the_modes_of_each_start(orbit, start):
    """The section with the greatest position is in another mode than the starts."""
    region = {"start.Y": (-1.5, -1.3), "start.V": (-0.1, 0.1)}
    options = {"start": start, "resolution": 3, "settle": 300, "longest": 4, "progress": False}
    (motion,) = vi.basins(Other(), region, **options).attractors
    order, wanted = np.argsort(motion.sections["Y"]), np.argsort(orbit.sections.Y)
    np.testing.assert_allclose(motion.sections["Y"][order], orbit.sections.Y[wanted], atol=1e-6)
    np.testing.assert_array_equal(motion.modes[0][order], orbit.modes[0][wanted])


class Marked(Flipped):
    """The mode does not change, nor does it act."""

    depth: Any = 0.0
    contacts: tuple = (vi.RigidStop(0.1, 0.8),)


@pytest.mark.parametrize(("machine", "motions"), [(Marked(), 2), (Flipped(depth=0.0), 1)])
def test_motions_in_other_modes_are_others(machine, motions, start):
    """The mode does not act, so that the sections of all these motions are the same."""
    start = vi.simulate(machine, start, 600).last.state
    state = vi.OscillatorState(jnp.full(2, start.Y), jnp.full(2, start.V))
    guesses = vi.HybridState(state, (jnp.array([1.0, -1.0]),))
    found, counts = vi.distinct_orbits(vi.find_orbit(machine, guesses, 4))
    assert len(found) == motions and counts.sum() == 2
    scanned = vi.scan(machine, {"depth": [0.0]}, measure="regime", start=start, settle=9)
    assert int(scanned.period[0]) == int(found[0].cycles)
    assert all(float(orbit.impacts) % 2 == 0 for orbit in found if motions == 1)
