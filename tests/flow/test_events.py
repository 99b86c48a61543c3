"""Impacts that are easily missed, counted twice or resolved in the wrong order."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

METHODS = [vi.ExactFlight(), vi.Adaptive(rtol=1e-9), vi.FixedStep(diffrax.Tsit5(), 8)]
NAMES = ["ExactFlight", "Adaptive", "FixedStep"]


def scene_with(*stops, zeta=0.8, xi=0.05):
    return vi.Scene(damping_ratio=xi, drive=vi.IdealDrive(zeta), stops=stops)


@pytest.mark.parametrize("method", METHODS, ids=NAMES)
def test_the_earlier_of_two_stops_acts(method):
    """The body is so fast that a free step would take it far beyond a stop."""
    left, right = vi.RigidStop(1.1, 0.5, "left"), vi.RigidStop(1.05, 0.5)
    for V, first, gap, stops in ((40.0, 1, 1.05, (left, right)), (-40.0, 1, 1.1, (right, left))):
        scene = scene_with(*stops)
        run = vi.simulate(scene, scene.start(V=V), 1, method=method, impact_log=3)
        assert list(np.asarray(run.impact_log.stop[0])) == [first, 1 - first, first]
        # Over so short a distance, spring and damping hardly change the speed.
        assert float(run.impact_log.phase[0, 0]) == pytest.approx(0.8 * gap / 40, rel=1e-2)
        assert float(run.impact_log.speed[0, 0]) == pytest.approx(40.0, rel=1e-2)


# A method cannot find a graze shallower than its error: eight steps per cycle are too few.
@pytest.mark.parametrize("method", [*METHODS[:2], vi.FixedStep(steps_per_cycle=64)], ids=NAMES)
def test_entry_and_exit_within_a_step(method):
    """A stop just above the peak is not hit; one just below is entered and left within a step."""
    free = scene_with(zeta=0.5)
    start = free.start(Y=0.2, V=1.5)
    run = vi.simulate(free, start, 1, method=method)
    peak, depth = float(run.y_max[0]), np.array([1e-3, 1e-6, 1e-9, 1e-11])
    assert float(run.sections.Y[-1]) < peak - 0.1  # a peak of the motion, not the interval's end

    def lane(gap):
        scene = scene_with(vi.RigidStop(gap, 1.0), zeta=0.5)
        return vi.simulate(scene, start, 1, method=method, impact_log=1)

    run = jax.vmap(lane)(jnp.concatenate([peak + depth, peak - depth]))
    assert (run.impacts[:4] == 0).all()
    # V⁻² = 2 |Y''| depth at the peak, with |Y''| of order one.
    speed = run.impact_log.speed[4:, 0, 0] / np.sqrt(depth)
    assert (speed > 0.5).all() and (speed < 3).all()


def test_failed_runs_have_a_reason():
    scene = vi.Scene.ideal(frequency_ratio=0.9)
    run = vi.simulate(scene, scene.start(), 10, method=vi.FixedStep(), max_steps=50)
    assert bool(run.result == vi.RESULTS.max_steps)
    pressed = vi.Scene.ideal(frequency_ratio=0.2, restitution=0.4, gap=0.3, damping_ratio=0.1)
    options = {"method": vi.ExactFlight(), "max_impacts": 60, "rests": False}
    run = vi.simulate(pressed, pressed.start(), 3, **options)
    assert bool(run.result == vi.RESULTS.chatter)
    with pytest.raises(RuntimeError, match="chatter: The impacts within one cycle exceeded"):
        vi.simulate(pressed, pressed.start(), 3, throw=True, **options)


@pytest.mark.parametrize(
    "method",
    [vi.ExactFlight(), vi.FixedStep(diffrax.Dopri8(), 48), vi.Taylor(16, 8)],
    ids=["exact", "fixed", "taylor"],
)
def test_an_impact_on_the_section_belongs_to_the_cycle_that_ends_there(method):
    """At undamped resonance, the attractor has its impact exactly at φ = 2π. If rounding moved it
    to the next cycle, the period would be wrong."""
    scene = vi.Scene.ideal(frequency_ratio=1.0, restitution=0.5)
    starts = jax.vmap(lambda Y, V: scene.start(Y=Y, V=V))(
        jnp.asarray([-2.0, 0.0, -1.0, 0.5]), jnp.asarray([0.0, 0.5, 1.0, -0.8])
    )
    run = vi.jit(jax.vmap(lambda x: vi.simulate(scene, x, 8, settle=200, method=method)))(starts)
    assert bool(run.successful.all()) and (np.asarray(run.impacts) == 1).all()
    np.testing.assert_allclose(run.sections.Y, 2.0, rtol=1e-12)
    # In closed form the impact speed is π/(1 + k). Restitution multiplies it by k.
    np.testing.assert_allclose(run.sections.V, -0.5 * np.pi / 1.5, rtol=1e-10)
