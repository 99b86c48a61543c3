"""Periodic motions of machines with delays, beside closed forms and values by collocation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.special import lambertw

from delayed import Fed, Masses, Struck, Turning, by_steps


@pytest.fixture(scope="module")
def orbit():
    return vi.find_orbit(Masses(), vi.simulate(Masses(), settle=30).last)


@pytest.mark.slow
def test_orbit_with_an_impact_is_checked_by_the_whole_history(orbit):
    assert orbit.successful
    np.testing.assert_allclose(orbit.state.x, -0.3631911886, rtol=0, atol=2e-5)
    np.testing.assert_allclose(orbit.impact_phase, [7.0342180392], rtol=0, atol=1e-4)
    found = orbit.multipliers[:2]
    np.testing.assert_allclose(found, [0.332155 + 0.205150j, 0.332155 - 0.205150j], atol=3e-4)
    assert 1e-6 < float(orbit.delay_error) < 3e-4
    assert "whole history" in str(orbit) and "history[" not in str(orbit)


@pytest.mark.slow
def test_error_of_a_body_that_rests_on_the_section_is_that_of_its_impact():
    machine = Struck(gap=0.2, restitution=0.0)
    run = vi.simulate(machine, settle=40)
    orbit = vi.find_orbit(machine, run.last)
    error = abs(float(run.impact_speed[0] / orbit.impact_speed[0]) - 1)
    assert orbit.state.x == 0.2 and error > 1e-7
    np.testing.assert_allclose(orbit.delay_error, error, rtol=1e-3)


@pytest.mark.slow
def test_a_search_for_a_torus_takes_a_machine_with_delays():
    with pytest.raises(ValueError, match="repeats after 1 cycle"):
        vi.find_torus(Fed(gain=0.1, damping=0.2), settle=50, observed=600)


@pytest.mark.slow
def test_fold_of_a_branch(orbit):
    branch = vi.continue_orbit(orbit, parameter="gain", bounds=(0.25, 0.9), progress=False)
    fold = next(x for x in branch.special if "fold" in str(x))
    np.testing.assert_allclose(float(fold.parameter), 0.7514467176, rtol=0, atol=5e-5)


@pytest.mark.slow
def test_more_nodes_are_more_accurate():
    errors = []
    for nodes, elements in ((16, 1), (8, 8)):
        chain = vi.delay_chain(Struck(), nodes, elements=elements)
        run = vi.simulate(chain, cycles=5)
        errors.append(abs(float(run.last.x) + 0.3721662410390))
    assert errors[1] < 1e-6 < errors[0] < 2e-5


@pytest.mark.slow
def test_boundary_in_two_parameters():
    """On the boundary λ = iΩ: g = (a² + 4ζ²Ω²)/2a with a = Ω² - 1, and tan ΩT follows."""
    orbit = vi.find_orbit(vi.delay_chain(Fed(gain=0.2, delay=3.06), 10))
    branch = vi.continue_orbit(orbit, parameter="gain", bounds=(0.18, 0.3), progress=False)
    curve = vi.boundary(
        branch.special[0], parameter="delay", bounds=((0.2, 0.28), (3.0, 3.12)), step=0.2,
        max_step=0.4, progress=False,
    )  # fmt: skip
    assert curve.kind == "neimark-sacker" and len(curve.parameter) > 4
    gain, delay = np.asarray(curve.parameters).T
    half = gain - 2 * 0.05**2
    a = half + np.sqrt(half**2 - 4 * 0.05**2)
    omega = np.sqrt(1 + a)
    exact = (np.arctan2(-2 * 0.05 * omega, 1 + gain - omega**2) + 2 * np.pi) / omega
    np.testing.assert_allclose(delay, exact, rtol=0, atol=1e-6)


class Relaxing(vi.AbstractMachine):
    """T' = -T(t - 1) - 0.2 T + cos(2πt/6), a state with one component."""

    cycle = 6.0
    delays = property(lambda self: dict(valve=1.0))

    def field(self, t, z, past):
        return dict(T=-past.valve.T - 0.2 * z.T + jnp.cos(2 * jnp.pi * t / 6))

    def start(self):
        return vi.State(T=0.0)


@pytest.mark.slow
def test_orbit_of_one_component_is_that_of_the_closed_form():
    """T = Re A exp(iωt) with A (iω + exp(-iω) + 0.2) = 1, and λ + 0.2 + exp(-λ) = 0."""
    orbit = vi.find_orbit(Relaxing())
    omega = 2 * np.pi / 6
    amplitude = 1 / (1j * omega + np.exp(-1j * omega) + 0.2)
    np.testing.assert_allclose(orbit.state.T, amplitude.real, rtol=0, atol=1e-9)
    np.testing.assert_allclose([orbit.y_max, -orbit.y_min], abs(amplitude), rtol=0, atol=1e-9)
    found = np.sort_complex(orbit.multipliers[:4])
    exact = np.exp(6 * (lambertw(-np.exp(0.2), k=[0, -1, 1, -2]) - 0.2))
    np.testing.assert_allclose(found, np.sort_complex(exact), rtol=0, atol=1e-9)


class SelfExcited(vi.AbstractMachine):
    """x'' = (0.5 - x²) x' - x(t - 1), whose cycles end where x rises through zero."""

    pump: float = 0.5

    cycle = vi.rising("x", usual=6.3)
    delays = property(lambda self: dict(spring=1.0))

    def field(self, t, z, past):
        return dict(x=z.u, u=(self.pump - z.x**2) * z.u - past.spring.x)

    def start(self):
        return vi.State(x=0.0, u=1.0)


class EndedByReset(SelfExcited):
    cycle = 6.3
    events = vi.Reset(lambda m, t, z, past: z.x, ends_cycle=True)


@pytest.mark.slow
def test_self_excited_motion():
    """By the method of steps: instants, and the multiplier by which durations approach the last."""
    end, instants = by_steps(
        lambda t, y, past: [y[1], (0.5 - y[0] ** 2) * y[1] - past[0][0]], [0.0, 1.0],
        lambda t: [0.0, 1.0], [1.0], 48.0, guard=lambda t, y, past: y[0], jump=lambda y, past: y,
    )  # fmt: skip
    durations = np.diff(instants, prepend=0.0)
    run = vi.simulate(SelfExcited(), cycles=5)
    np.testing.assert_allclose(run.duration, durations[:5], rtol=0, atol=1e-8)
    for machine in (EndedByReset(), vi.delay_chain(EndedByReset())):
        last = vi.simulate(machine.observed_every(8.0), cycles=6).last
        np.testing.assert_allclose([last.x, last.u], end, rtol=0, atol=1e-7)
    orbit = vi.find_orbit(SelfExcited())
    np.testing.assert_allclose(orbit.duration, durations[-1], rtol=0, atol=1e-8)
    assert float(orbit.delay_error) < 1e-9
    shrinks = (durations[4] - durations[3]) / (durations[3] - durations[2])
    np.testing.assert_allclose(orbit.multipliers[0], shrinks, rtol=5e-3)
    found = vi.lyapunov(SelfExcited(), cycles=64, settle=8).exponents
    exact = [0.0, np.log(orbit.multipliers[0].real) / durations[-1]]
    np.testing.assert_allclose(found[:2], exact, rtol=0, atol=2e-3)
    length = lambda pump: vi.find_orbit(SelfExcited(pump=pump)).duration
    slope = (length(0.501) - length(0.499)) / 0.002
    np.testing.assert_allclose(jax.grad(length)(0.5), slope, rtol=1e-4)


class Wright(vi.AbstractMachine):
    """Wright's equation T' = -1.8 T(t - 1) (1 + T), whose cycles end where T rises through zero."""

    cycle = vi.rising("T", usual=4.0)
    delays = property(lambda self: dict(late=1.0))

    def field(self, t, z, past):
        return dict(T=-1.8 * past.late.T * (1 + z.T))


@pytest.mark.slow
def test_delay_error_of_one_number_is_that_of_the_duration():
    run = vi.simulate(Wright(), vi.State(T=0.5), cycles=1, settle=40)
    chain = vi.delay_chain(Wright(), 6, start=run.last.state)
    orbit = vi.find_orbit(chain, chain.chained(run.last))
    error = abs(float(orbit.duration / run.duration[0]) - 1)
    assert 1e-8 < error < 1e-2
    np.testing.assert_allclose(orbit.delay_error, error, rtol=1e-3)


@pytest.mark.slow
def test_exponents():
    """By the chain, compared with tangents through the whole history."""
    found = vi.lyapunov(Struck(), cycles=256, settle=64).exponents[:2]
    run = lambda x: vi.simulate(Struck(), vi.State(x=x, u=0.0), cycles=32).sections.x
    moved = np.asarray(jax.jit(lambda x: jax.jvp(run, (x,), (1.0,))[1])(0.0))[22:]
    # A pair μ: each tangent is 2 Re μ times the last minus |μ|² times the one before.
    rows = np.stack([moved[1:-1], moved[:-2]], axis=1)
    square = -np.linalg.lstsq(rows, moved[2:], rcond=None)[0][1]
    np.testing.assert_allclose(square**0.5, 0.3904017, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.sum(), np.log(square) / (2 * np.pi / 0.8), atol=2e-3)


class Undelayed(vi.AbstractMachine):
    cycle = 1.0

    def field(self, t, z):
        return dict(x=-z.x)

    def start(self):
        return vi.State(x=1.0)


def test_machines_without_delays_are_refused():
    with pytest.raises(ValueError, match="must have `delays`"):
        vi.delay_chain(Undelayed())


class Cutting(Turning):
    """The same with dry friction. Its `recorded` has a mode."""

    contacts = vi.DryFriction(0.05, on="u", mass=1.0)


@pytest.mark.slow
def test_chain_with_friction_and_a_switch():
    whole = vi.simulate(Cutting(), cycles=3, method="reference").last
    chain = vi.simulate(vi.delay_chain(Cutting(), 16, elements=2), cycles=3).last
    np.testing.assert_allclose([chain.x, chain.u], [whole.x, whole.u], rtol=0, atol=2e-6)
