"""Reverse-mode gradients of a run, compared with forward mode and with differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.lanes import _backward
from vi_jax.machine import switches_of

from differences import quick

RESTING = vi.Scene.ideal(frequency_ratio=0.3, restitution=0.3, gap=-0.5, damping_ratio=0.05)
CASES = {
    "chatter and rest": (RESTING, RESTING.start(Y=-0.6), 6, {"method": vi.FixedStep()}),
    "friction": (vi.machines.Capsule(), vi.machines.Capsule().start(), 4, {}),
    "relief valve": (vi.machines.ReliefValve(), vi.machines.ReliefValve().start(), 3, {}),
}


def weighted_sum(case):
    """Return the weighted sum of all numbers of a run as a function of its inputs, and the values
    of these inputs."""
    machine, start, cycles, options = CASES[case]
    numbers, rest = eqx.partition((machine, start), eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(numbers)

    def function(leaves):
        own, begin = eqx.combine(jax.tree.unflatten(tree, leaves), rest)
        run = vi.simulate(own, begin, cycles, **options)
        draw = np.random.default_rng(1).normal
        found = jax.tree.leaves(eqx.filter(run, eqx.is_inexact_array))
        return sum(jnp.sum(jnp.where(jnp.isfinite(x), x * draw(size=x.shape), 0)) for x in found)

    return function, [jnp.asarray(x, float) for x in leaves]


@pytest.mark.parametrize("case", quick(CASES))
def test_tape_matches_forward_derivatives(case, monkeypatch):
    """The tolerance is 1e-10 of the largest derivative: rounding grows along a motion (measured: at
    most 4e-12). A step lands within 1e-9 of an event, at a place that depends on rounding. After a
    change of mode, derivatives depend on this place: one rounding of the start changes them by
    about 1e-9."""
    monkeypatch.setattr(_backward, "_BY_COLUMNS", 0)
    function, at = weighted_sum(case)
    assert "lanes_backward" in str(jax.make_jaxpr(jax.grad(function))(at))
    flat = lambda slopes: np.concatenate([np.ravel(x) for x in slopes])
    tape, columns = (flat(jax.jit(d(function))(at)) for d in (jax.grad, jax.jacfwd))
    close = 1e-8 if switches_of(CASES[case][0]) else 1e-10
    np.testing.assert_allclose(tape, columns, rtol=close, atol=close * np.abs(columns).max())


@pytest.mark.slow
def test_gradient_over_many_cycles_has_limited_memory():
    """The tape of 10,000 cycles of a motor takes 256 MB for a group of eight lanes."""
    import resource

    def last(x):
        machine = vi.Parameters(torque=10.0, control=x[0], restitution=x[1]).scene()
        start = machine.start(Y=x[2], V=x[3], W=x[4])
        run = vi.simulate(machine, start, 4, settle=9_996, method=vi.FixedStep(),
                          record="sections")  # fmt: skip
        return run.sections.Y[-1] + run.sections.W[-1]

    at = jnp.asarray([0.9, 0.5, 0.0, 0.0, 0.9])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    slope = jax.jit(jax.grad(last))(at)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert np.isfinite(slope).all() and grown < 1024


SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=0.5, damping_ratio=0.1)


def cycle_by_cycle(wrapped):
    def end(V):
        def cycle(state, _):
            run = vi.simulate(SCENE, state, 1, rests=False)
            return run.last, run.y_min[0]

        state, lowest = jax.lax.scan(wrapped(cycle), SCENE.start(V=V), length=3)
        return state.Y + jnp.sum(lowest)

    return end


def slope_of(f, V, h=1e-6):
    return (f(V + h) - f(V - h)) / (2 * h)


def test_a_checkpoint_in_a_scan():
    truth = slope_of(cycle_by_cycle(lambda f: f), 0.1)
    np.testing.assert_allclose(jax.grad(cycle_by_cycle(jax.checkpoint))(0.1), truth, rtol=1e-5)
