"""Gradients of all that a run has, by a tape: the same as by columns, and as differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.lanes import _backward
from vi_jax.machine import switches_of

from differences import quick

IDEAL = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.05)
RESTING = vi.Scene.ideal(frequency_ratio=0.3, restitution=0.3, gap=-0.5, damping_ratio=0.05)
MOTOR = vi.Parameters(torque=10.0, control=0.9, restitution=0.5).scene()
CASES = {
    "every impact logged": (IDEAL, IDEAL.start(), 8, {"method": vi.ExactFlight(), "impact_log": 4}),
    "samples and events": (IDEAL, IDEAL.start(), 4, {"samples": 8, "event_log": 6}),
    "chatter and rest": (RESTING, RESTING.start(Y=-0.6), 6, {"method": vi.FixedStep()}),
    "motor in time": (MOTOR, MOTOR.start(W=0.9), 8, {"clock": "time"}),
    "friction": (vi.machines.Capsule(), vi.machines.Capsule().start(), 4, {}),
    "chatter of a ball": (vi.machines.BouncingBall(), vi.machines.BouncingBall().start(), 4, {}),
    "a section of its own": (vi.machines.ReliefValve(), vi.machines.ReliefValve().start(), 3, {}),
}


def lost(case):
    """All numbers of a run, each with a weight of its own, as a function of all that it has a
    derivative by; and where to begin."""
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


@pytest.mark.parametrize(
    "case", quick(CASES, "a section of its own", slow=("chatter and rest", "friction"))
)
def test_the_tape_gives_what_columns_give(case, monkeypatch):
    """Forward derivatives are the columns. The two round differently, which grows along a motion:
    1e-10 of the largest derivative (measured: at most 4e-12). Where a step lands within 1e-9 of an
    event is a matter of rounding, and derivatives behind a change of mode depend on it: there one
    rounding of the start makes as much as the difference, some 1e-9."""
    monkeypatch.setattr(_backward, "_BY_COLUMNS", 0)
    function, at = lost(case)
    assert "lanes_backward" in str(jax.make_jaxpr(jax.grad(function))(at))
    flat = lambda slopes: np.concatenate([np.ravel(x) for x in slopes])
    tape, columns = (flat(jax.jit(d(function))(at)) for d in (jax.grad, jax.jacfwd))
    close = 1e-8 if switches_of(CASES[case][0]) else 1e-10
    np.testing.assert_allclose(tape, columns, rtol=close, atol=close * np.abs(columns).max())


@pytest.mark.slow
def test_beside_differences():
    function, at = lost("motor in time")
    along = [jnp.asarray(x) for x in np.random.default_rng(2).normal(size=len(at))]
    h = 1e-6
    step = lambda h: [x + h * d * (x != 0) for x, d in zip(at, along, strict=True)]
    run = jax.jit(function)
    slope = sum(g * d * (x != 0) for g, d, x in zip(jax.grad(function)(at), along, at, strict=True))
    difference = (run(step(h)) - run(step(-h))) / (2 * h)
    # The difference's own error: rounding 1e-13/1e-6 and (1e-6)² times a third derivative.
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


@pytest.mark.slow
def test_many_cycles_keep_within_their_memory():
    """10,000 cycles of a motor in a group of eight: a tape of 256 MB."""
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
