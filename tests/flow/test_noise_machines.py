"""Noise on machines with dry friction, with an uneven clock, or with natural modes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from belts import Belt
from free_oscillator import Free
from rubbing import Rubbing
from structures import machine_and_truth

pytestmark = pytest.mark.slow
SIGMA = 0.5
REST = vi.OscillatorState(jnp.array(0.0), jnp.array(0.0))


def white_noise(impulses=16, amplitude=SIGMA):
    return vi.WhiteNoise({"V": amplitude}, impulses=impulses)


def averaged(machine, name, impulses, cycles=100, lanes=512):
    """Return the time mean of an average over all lanes, and its standard error."""

    def one(key):
        options = {"settle": 20, "noise": white_noise(impulses), "key": key}
        run = vi.simulate(machine, REST, cycles, **options)
        return jnp.sum(run.averages[name] * run.duration) / jnp.sum(run.duration), run.successful

    each, good = vi.jit(jax.vmap(one))(jax.random.split(jax.random.key(impulses), lanes))
    assert np.all(good)
    return float(each.mean()), float(each.std(ddof=1)) / lanes**0.5


class DryFriction(Rubbing):
    """v' = -μ sgn v + σ dW: friction dissipates the power of the noise, μ E|v| = σ²/2."""

    def averages(self, s, x):
        return {"speed": jnp.abs(x.V)}


def test_friction_dissipates_the_power_of_the_noise():
    """The balance holds for any number of impulses. With few, the body sticks most of the time."""
    level = 0.5
    mean, error = averaged(DryFriction(lambda machine, s, x: 0.0 * x.V, level), "speed", 4)
    assert error < 0.02 * SIGMA**2 / (2 * level)
    assert abs(mean - SIGMA**2 / (2 * level)) < 3 * error


class Uneven(Free):
    """The oscillator in a clock that runs unevenly, and faster at higher velocity."""

    def pace(self, s, x):
        return (1 + 0.6 * jnp.cos(s)) / (1 + 0.5 * jnp.tanh(x.V))

    def field(self, s, x):
        pace = self.pace(s, x)
        return vi.OscillatorState(pace * x.V, pace * (-x.Y - 0.2 * x.V))

    def averages(self, s, x):
        return {"square": x.V**2}


def test_noise_over_measured_time_keeps_the_temperature():
    """0.2 E[v²] = σ²/2, although the time between impulses is known only afterwards."""
    mean, error = averaged(Uneven(), "square", 8)
    assert error < 0.02 * 0.625 and abs(mean - 0.625) < 3 * error


def test_path_and_derivatives_over_measured_time():
    def sections(sigma=SIGMA, **options):
        given = {"noise": white_noise(16, sigma), "key": jax.random.key(5), "settle": 2, **options}
        return vi.simulate(Uneven(), REST, 3, **given).sections.V

    whole = sections()
    np.testing.assert_allclose(sections(record="sections"), whole, atol=1e-9)
    np.testing.assert_allclose(sections(samples=8), whole, atol=1e-9)
    step = 1e-6
    slope = (sections(SIGMA + step)[-1] - sections(SIGMA - step)[-1]) / (2 * step)
    assert jax.jacfwd(sections)(SIGMA)[-1] == pytest.approx(float(slope), rel=1e-6)


def test_noise_on_a_motor_gives_the_same_path_in_both_clocks():
    """Noise acts on the body and on the crank's speed, at equal phases of the crank."""
    scene = vi.Parameters(torque=10.0, control=1.2, restitution=0.7, gap=0.05).scene()
    noise = vi.WhiteNoise({"V": 0.1, "W": 0.05}, impulses=16)
    found = []
    for clock in ("phase", "time"):
        options = {"clock": clock, "noise": noise, "key": jax.random.key(1)}
        found.append(vi.simulate(scene, scene.start(), 20, **options))
    one, other = found
    assert int(one.impacts.sum()) > 10 and np.ptp(one.duration) > 0.05
    np.testing.assert_allclose(one.sections.V, other.sections.V, atol=1e-7)
    np.testing.assert_allclose(one.duration, other.duration, atol=1e-7)


class Plain(vi.machines.Structure):
    """A structure with its own methods, so it is not solved in natural modes."""

    def averages(self, s, state):
        return {"square": jnp.sum(state.velocity**2)}

    def step_limit(self, s, state):
        return jnp.asarray(0.2)

    def relaxation(self, s, state):
        return jnp.asarray(1.0)


def test_noise_on_a_structure_is_the_same_in_natural_modes():
    machine, _, start = machine_and_truth(3, 3, "general")
    names = (
        "mass", "damping", "stiffness", "contacts", "static_force", "force", "sine_force",
        "amplitude", "frequency",
    )  # fmt: skip
    plain = Plain(**{name: getattr(machine, name) for name in names})
    noise = vi.WhiteNoise({"velocity": jnp.array([0.1, 0.2, 0.3])}, impulses=16)
    start = machine.start(displacement=start[0], velocity=start[1])
    given = {"noise": noise, "key": jax.random.key(1), "record": "sections"}
    run = vi.simulate(machine, start, 12, **given)
    other = vi.simulate(plain, start, 12, method=vi.FixedStep(steps_per_cycle=64), **given)
    assert int(run.impacts.sum()) == int(other.impacts.sum()) > 10
    np.testing.assert_allclose(run.sections.velocity, other.sections.velocity, atol=1e-9)
    noise = vi.WhiteNoise({"velocity": lambda state: 0.1})
    with pytest.raises(ValueError, match="must have numbers as amplitudes"):
        vi.simulate(machine, start, 2, noise=noise, key=jax.random.key(1))


class Lifted(vi.AbstractMachine):
    """A force z presses a body on its stop or pulls it off. Only noise changes z."""

    rebound: float = 0.5
    cycle: float = 1.0

    @property
    def contacts(self):
        return (vi.RigidStop(0.0, self.rebound),)

    def field(self, s, x):
        return {"Y": x.V, "V": x.z, "z": 0.0 * x.z}


def test_jump_of_a_force_releases_a_resting_body():
    start = vi.State(Y=0.0, V=0.0, z=0.3)

    def one(key):
        given = {"noise": vi.WhiteNoise({"z": 1.0}, impulses=1), "key": key}
        return vi.simulate(Lifted(), start, 2, **given).sections

    found = jax.vmap(one)(jax.random.split(jax.random.key(0), 64))
    force, place = np.asarray(found.z)[:, 1], np.asarray(found.Y)[:, 2]
    assert 10 < np.sum(force < 0) < 54
    np.testing.assert_allclose(place, np.minimum(0.5 * force, 0.0), atol=1e-12)


def test_run_continues_at_rest_on_its_section():
    """The motion has decayed to steady sliding, so only rounding crosses the section."""
    start = vi.OscillatorState(jnp.array(0.3), jnp.array(0.0))
    run = vi.simulate(Belt(1.5), start, 4, settle=300)
    assert bool(run.successful) and int(run.steps) < 65536
    np.testing.assert_allclose(run.sections.Y, 0.5 + 0.5 * np.exp(-3.0), atol=1e-14)
    np.testing.assert_allclose(run.sections.V, 0.0, atol=1e-14)
