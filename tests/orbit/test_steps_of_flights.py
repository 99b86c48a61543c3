"""Along a curve, flights may need more steps than those of its first motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.optimize import brentq


class Oscillator(vi.AbstractMachine):
    """A linear oscillator in its own time unit, without a `step_limit`."""

    omega: jax.Array | float = 0.5
    gap: jax.Array | float = 20.0
    restitution: jax.Array | float = 0.7

    @property
    def contacts(self):
        return (vi.RigidStop(self.gap, self.restitution),)

    @property
    def cycle(self):
        return 2 * jnp.pi / self.omega

    def field(self, s, state):
        Y, V = state.Y, state.V
        return vi.OscillatorState(V, -Y - 0.1 * V + jnp.cos(self.omega * s))

    def start(self):
        return vi.OscillatorState(jnp.asarray(1.3), jnp.asarray(0.0))


def amplitude(omega):
    return 1 / np.hypot(1 - omega**2, 0.1 * omega)


@pytest.mark.slow
def test_a_branch_takes_more_steps_for_a_slow_drive():
    machine = Oscillator()
    orbit = vi.find_orbit(machine, machine.start())
    branch = vi.continue_orbit(orbit, parameter="omega", bounds=(0.03, 0.55))
    assert branch.ends == ("bounds", "bounds") and not branch.special
    for name, end in (("omega", 0.0), ("restitution", 1.3)):
        words = f"`bounds` must leave the machine valid, but at {name} = {end:g}"
        with pytest.raises(ValueError, match=words):
            vi.continue_orbit(orbit, parameter=name, bounds=(end, 0.5) if end < 1 else (0.5, end))
    np.testing.assert_allclose(branch.y_max, amplitude(branch.parameter), atol=1e-9)
    periods = 2 * np.pi / branch.parameter
    product = np.prod(branch.multipliers, axis=1)
    np.testing.assert_allclose(product, np.exp(-0.1 * periods), atol=1e-9)


@pytest.mark.slow
def test_energies_of_a_branch_have_the_steps_of_its_flights():
    """Regression: with fewer steps than the flights, they were off by 6e-11."""
    machine = Oscillator(omega=0.8, gap=1.0)
    start = vi.OscillatorState(jnp.asarray(0.1), jnp.asarray(0.0))
    start = vi.simulate(machine, start, 1, settle=200).last
    orbit = vi.find_orbit(machine, start, throw=True)
    branch = vi.continue_orbit(orbit, parameter="omega", bounds=(0.71, 0.81), progress=False)
    for n in (0, len(branch.parameter) // 2):
        at, fine = Oscillator(branch.parameter[n], 1.0), vi.FixedStep(steps_per_cycle=400)
        exact = vi.simulate(at, branch.at(branch.parameter[n])[0].state, 1, method=fine)
        assert branch.impact_energy[n] == pytest.approx(float(exact.impact_energy[0]), rel=1e-12)


@pytest.mark.exhaustive
def test_flights_of_a_long_period_have_the_steps_of_the_longest():
    """Compare the multipliers of a motion with twelve impacts in sixteen cycles with the cycle map,
    and its origin with the doubling of the motion of eight cycles."""
    at = 2.2836
    scene = vi.Scene.ideal(frequency_ratio=at, restitution=0.8, gap=0.2, damping_ratio=0.02)
    last = vi.simulate(scene, scene.start(), 1, settle=3000).last
    orbit = vi.find_orbit(scene, last, cycles=16, impact_log=16, throw=True)
    followed = dict(parameter="drive.frequency_ratio", max_step=0.2)
    for width in (1e-3, 1e-2):
        branch = vi.continue_orbit(orbit, bounds=(at - width, at + width), **followed)
        # The longest flight takes less than two cycles.
        assert branch.problem.steps == 3 * 16
        here = np.argmin(abs(branch.parameter - at))
        assert abs(branch.parameter[here] - at) < 1e-12
        np.testing.assert_allclose(branch.multipliers[here], orbit.multipliers, atol=1e-8)
        assert branch.ends == ("bounds", "period-doubling")
    half = branch.special[-1].orbit
    assert int(half.cycles) == 8
    halves = vi.continue_orbit(half, bounds=(at - 1e-3, at + 1e-3), **followed)
    greatest = lambda there: float(halves.at(there)[0].multipliers[0].real)
    place = brentq(lambda there: greatest(there) + 1, at + 6e-4, at + 6.3e-4, xtol=1e-14)
    assert branch.special[-1].parameter == pytest.approx(place, abs=1e-11)
