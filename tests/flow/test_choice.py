"""Presets, `suggest_method`, error estimates, and parameters that stay constants in `jit`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.flow.methods.choice import chosen

IDEAL = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.8, damping_ratio=0.045)
MOTOR = vi.Parameters(torque=10.0, restitution=0.8, gap=0.08, control=1.1).scene()


def test_presets_by_scene():
    names = "draft", "standard", "reference"
    assert all(isinstance(vi.preset(IDEAL, name), vi.ExactFlight) for name in names)
    steps = [vi.preset(MOTOR, name).steps_per_cycle for name in names]
    assert steps == sorted(steps) and len(set(steps)) == 3
    assert chosen(MOTOR, None).steps_per_cycle == vi.preset(MOTOR).steps_per_cycle
    with pytest.raises(ValueError, match="'draft', 'standard', 'reference', but got 'fast'"):
        vi.simulate(MOTOR, MOTOR.start(), 2, method="fast")
    with pytest.raises(TypeError, match="name of a preset, but got 3"):
        chosen(IDEAL, 3, argument="flow")


@pytest.mark.slow
def test_presets_keep_their_promise_from_slow_to_fast_drives():
    """Errors were measured for κ from 0.5 to 1.9. Equal steps per free period keep them beyond."""

    def last(kappa, method):
        motor = vi.Motor(0.65, kappa, 0.0093, 0.0053)
        scene = vi.Scene(damping_ratio=0.045, drive=motor, stops=[vi.RigidStop(2.0, 0.8)])
        return jnp.stack(jax.tree_util.tree_leaves(vi.simulate(scene, scene.start(), 30,
                                                               method=method).last))  # fmt: skip

    kappas = jnp.geomspace(0.1, 10.0, 33)
    runs = {
        name: np.asarray(jax.jit(jax.vmap(lambda kappa, n=name: last(kappa, n)))(kappas))
        for name in ("draft", "standard", "reference")
    }
    for name, promise in (("draft", 1e-6), ("standard", 4e-9)):
        error = np.abs(runs[name] - runs["reference"]).max(axis=1)
        # The promise is for 95 of 100 lanes. The factor allows for many impacts in a slow cycle.
        assert np.quantile(error, 0.95) < 10 * promise


@pytest.mark.slow
@pytest.mark.parametrize("scene, method", [(MOTOR, "draft"), (MOTOR, vi.Adaptive(rtol=1e-7))])
def test_estimated_errors_match_true_errors(scene, method):
    run = vi.simulate(scene, scene.start(), 40, method=method, estimate=True)
    truth = vi.simulate(scene, scene.start(), 40, method="reference")
    made = np.abs(np.asarray(run.sections.Y - truth.sections.Y))
    estimated = np.asarray(run.errors.sections.Y)
    assert 0.5 < estimated.max() / made.max() < 2.0
    assert int(run.errors.impacts.max()) == 0
    assert "estimated" in str(run)
    assert vi.simulate(scene, scene.start(), 2).errors is None


@pytest.mark.slow
def test_errors_are_estimated_under_strong_damping():
    def lane(xi):
        scene = vi.Scene.ideal(frequency_ratio=1.0, gap=None, damping_ratio=xi)
        run = vi.simulate(scene, scene.start(), 8, method=vi.FixedStep(), estimate=True)
        truth = vi.simulate(scene, scene.start(), 8, method=vi.ExactFlight())
        made = jnp.max(jnp.abs(run.sections.Y - truth.sections.Y))
        return made, jnp.max(run.errors.sections.Y)

    made, estimated = jax.vmap(lane)(jnp.array([3.0, 10.0]))
    assert (made < 4e-9).all() and (estimated > 0.5 * made).all() and (estimated < 2 * made).all()


def test_rounding_is_estimated_under_exact_flight():
    run = vi.simulate(IDEAL, IDEAL.start(), 40, estimate=True)
    assert 0 < float(jnp.max(run.errors.sections.Y)) < 1e-12


def test_suggested_for_an_ideal_drive():
    found = vi.suggest_method(IDEAL, error=1e-9, cycles=5, lanes=4)
    assert isinstance(found.method, vi.ExactFlight) and found.reached
    assert found.error < 1e-10


def test_invalid_calibrations_raise():
    with pytest.raises(TypeError, match="outside of `jit`"):
        jax.jit(
            lambda z: vi.suggest_method(vi.Scene.ideal(frequency_ratio=z)).error
        )(0.9)  # fmt: skip
    # The crank stops in every lane.
    drive = vi.Motor(0.0, 0.0, 1.0, 0.005)
    weak = vi.Scene(damping_ratio=0.0, drive=drive, stops=[vi.RigidStop(2.0, 0.5)])
    with pytest.raises(ValueError, match="4 of 4 lanes of the calibration failed"):
        vi.suggest_method(weak, start=weak.start(Y=-1.0, W=0.05), lanes=4, cycles=3)


@pytest.mark.slow
def test_suggested_for_a_motor():
    found = vi.suggest_method(MOTOR, error=1e-7, cycles=5, lanes=16)
    assert found.reached and found.error <= 1e-7
    assert min(t.seconds for t in found.tried if t.error <= 1e-7) == next(
        t.seconds for t in found.tried if t.method is found.method
    )
    # The scene itself has an error of this order.
    run = vi.simulate(MOTOR, MOTOR.start(), 5, method=found.method)
    truth = vi.simulate(MOTOR, MOTOR.start(), 5, method="reference")
    assert abs(float(run.last.Y - truth.last.Y)) < 1e-6
    assert "tried" in str(found)


def test_constants_stay_constants_inside_jit():
    seen = {}

    @jax.jit
    def run(zeta):
        for gap in (1.0, 2.0):
            seen[gap] = vi.Scene.ideal(frequency_ratio=zeta, gap=gap).may_rest()
        seen["table"] = vi.Parameters(gap=0.08).scene().may_rest()
        return zeta

    run(0.9)
    assert seen == {1.0: True, 2.0: False, "table": False}
    with pytest.raises(ValueError, match="restitution"):
        jax.jit(lambda z: vi.Scene.ideal(frequency_ratio=z, restitution=2.0).drive)(0.9)


def test_absolute_tolerance_limits_errors_of_small_states():
    """Compare with x = a (cos ωs - cos s)/(1 - ω²), the response from rest to a force of 1e-6."""
    a, omega = 1e-6, 1.3
    numbers = {"stiffness": 1.0, "cubic": 0.0, "damping": 0.0, "gap": 1.0}
    small = vi.machines.Duffing(amplitude=a, frequency=omega, **numbers)
    steps = []
    for atol, error in ((1e-3, 1e-8), (1e-15, 1e-14)):
        method = vi.Adaptive(rtol=1e-9, atol=atol)
        run = vi.simulate(small, small.start(), 3, method=method)
        end = 3 * 2 * np.pi / omega
        truth = a * (1 - np.cos(end)) / (1 - omega**2)
        assert abs(float(run.last.Y) - truth) < error
        steps.append(int(run.steps))
    assert steps[1] > steps[0]
