"""Flights of structures as far as no stop can be met, which are not searched."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.flow.methods._linear import clear, flown

from structures import machine_and_truth


@pytest.mark.slow
def test_where_no_stop_can_be_met_steps_are_longer():
    """A run of sections alone takes them, one with extremes does not; they meet the same stops."""
    fewer = impacts = 0
    for seed, kind in enumerate(("undamped", "proportional", "proportional")):
        machine, _, start = machine_and_truth(seed, 3, kind)
        start = machine.start(displacement=start[0], velocity=start[1])
        long, short = (
            vi.simulate(machine, start, 2, record=record, rests=False)
            for record in ("sections", "motion")
        )
        np.testing.assert_array_equal(long.impacts, short.impacts)
        for a, b in zip(*(jax.tree.leaves(run.sections) for run in (long, short)), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
        impacts += int(long.impacts.sum())
        fewer += int(short.steps) - int(long.steps)
    assert impacts >= 4 and fewer > 20


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_what_is_said_to_be_clear_is(seed):
    """No stop is met within the length given, from any state, by a fine sampling of the flight."""
    random = np.random.default_rng(seed)
    machine, *_ = machine_and_truth(seed, 4, "proportional")
    way = machine.prepared_modes()
    states = vi.machines.StructureState(
        jnp.asarray(0.2 * random.normal(size=(200, 4))), jnp.asarray(random.normal(size=(200, 4)))
    )
    s = jnp.asarray(random.uniform(0, machine.cycle, 200))
    free = tuple(jnp.zeros(()) for _ in way.machine.coordinates)

    def nearest(s, state):
        begin = way.inward(state)
        length = jnp.minimum(clear(way.machine, s, begin), machine.cycle)

        def beyond(share):
            there = flown(way.machine, free, s, share * length, begin)
            return jnp.stack([
                stop.beyond(way.machine.coordinates[stop.coordinate].position(there))
                for stop in way.machine.stops
            ])  # fmt: skip

        return length, jax.vmap(beyond)(jnp.linspace(0, 1, 65)).max()

    length, furthest = jax.jit(jax.vmap(nearest))(s, states)
    assert (length > 0).sum() > 60 and np.median(length[length > 0]) > 0.1
    assert (furthest[length > 0] < 0).all()
