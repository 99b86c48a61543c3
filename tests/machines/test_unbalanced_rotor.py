"""A motor with an unbalance: the averaged Sommerfeld response, rest, both clocks."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

ROTOR = vi.machines.UnbalancedRotor


@pytest.mark.slow
def test_the_sommerfeld_response_is_that_of_averaging_to_its_order():
    """Mean speed and amplitude beside the averaged ones, as ε and the motor's strength fall
    together, which leaves the averaged response as it is."""
    couplings = jnp.asarray([0.005, 0.0025, 0.00125, 0.000625])
    # On the rising side, near the peak, and beyond it.
    for zeta in (0.85, 0.98, 1.15):
        rotor = ROTOR(strength=0.2, coupling=0.02)
        kappa = rotor.averaged_control(zeta)
        reach = zeta**2 / ((1 - zeta**2) + 0.1j * zeta)

        def error(coupling, kappa=kappa, zeta=zeta, reach=reach):
            weak = ROTOR(strength=10 * coupling, control=kappa, coupling=coupling)
            guess = weak.start(Y=reach.real, V=-zeta * reach.imag, W=zeta)
            orbit = vi.find_orbit(weak, guess)
            return orbit.frequency_ratio - zeta, orbit.y_max - abs(reach), orbit.successful

        speed, amplitude, good = jax.vmap(error)(couplings)
        assert bool(good.all())
        order, _ = np.polyfit(np.log(couplings), np.log(np.abs(speed)), 1)
        assert order == pytest.approx(1.0, abs=0.1) and abs(float(speed[-1])) < 1e-4
        assert abs(float(amplitude[-1])) < 1e-3 * abs(reach)


@pytest.mark.slow
def test_a_start_from_rest_and_a_stall():
    rotor = ROTOR(control=1.2, strength=0.3)
    with pytest.raises(ValueError, match=r"W > 0 in the phase clock.*W = 0"):
        vi.simulate(rotor, rotor.start(W=0.0), 2)
    run = vi.simulate(rotor, rotor.start(W=0.0), 60, clock="time")
    assert bool(run.successful)
    assert float(run.duration[0]) > 1.5 * float(run.duration[-1])
    slack = ROTOR(control=-0.5, strength=0.3)
    for method in (vi.Adaptive(), vi.FixedStep()):
        stalled = vi.simulate(slack, slack.start(W=0.5), 20, method=method)
        assert bool(stalled.result == vi.RESULTS.stalled)


@pytest.mark.slow
def test_a_body_pressed_on_comes_to_rest_and_leaves():
    """The unbalance presses the body on while W² cos φ exceeds the gap; in both clocks."""
    rotor = ROTOR(
        control=1.2, strength=2.0, gap=0.1, restitution=0.1, coupling=0.1, damping_ratio=0.6
    )
    method = vi.Adaptive(rtol=1e-11)
    start = rotor.start(Y=0.0, V=0.1)
    phase, time = (vi.simulate(rotor, start, 8, clock=c, method=method) for c in ("phase", "time"))
    assert int(phase.rests.sum()) > 4
    np.testing.assert_array_equal(phase.rests, time.rests)
    for name in "YVP":
        a, b = getattr(phase.sections, name), getattr(time.sections, name)
        np.testing.assert_allclose(a, b, atol=1e-7)


@pytest.mark.slow
def test_an_orbit_of_the_time_clock_is_that_of_the_angle():
    """A search takes the machine by its angle, and states that were made for either clock."""
    timed = ROTOR(clock_name="time")
    settled = vi.simulate(timed, timed.start(), 1, settle=300, record="sections").last
    by_time = vi.find_orbit(timed, settled)
    by_angle = vi.find_orbit(ROTOR(), ROTOR().start())
    assert bool(by_time.stable) and bool(by_angle.stable)
    for name in "YVP":
        values = [float(getattr(x, name)) for x in (settled, by_time.state, by_angle.state)]
        assert values == pytest.approx(values[:1] * 3, abs=1e-6)
    midway = eqx.tree_at(lambda x: x.phase, settled, jnp.asarray(1.3))
    with pytest.raises(ValueError, match=r"`guess` must lie on the section, .* but has 1.3"):
        vi.find_orbit(timed, midway)
