"""Feet of one body that land at one instant: which of them strike."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from differences import some


class Feet(eqx.Module):
    y: Any
    tilt: Any
    v: Any
    turn: Any


class Rod(vi.AbstractMachine):
    """A rod of unit mass that falls flat on feet at `places` along it (inertia .3)."""

    restitution: tuple[float, ...]
    places: tuple[float, ...] = eqx.field(static=True)

    @property
    def stops(self):
        return tuple(vi.RigidStop(0.0, k, coordinate=i) for i, k in enumerate(self.restitution))

    @property
    def coordinates(self):
        def foot(at):
            share = 1 / (1 + at * at / 0.3)

            def placed(z, Y, V):
                far, fast = share * (Y - z.y - at * z.tilt), share * (V - z.v - at * z.turn)
                turns = at / 0.3
                return Feet(z.y + far, z.tilt + turns * far, z.v + fast, z.turn + turns * fast)

            return vi.Coordinate(
                lambda z: z.y + at * z.tilt, lambda z: z.v + at * z.turn, placed, share
            )

        return tuple(foot(at) for at in self.places)

    @property
    def cycle(self):
        return 1.0

    def field(self, s, z):
        return Feet(z.v, z.turn, 0 * z.v, 0 * z.turn)


FEET = {
    "both push": ((-0.5, 1.0), (0.5, 0.5), (-0.5, 0.0)),
    "one is redundant": ((-1.0, 0.0, 1.0), (0.5,) * 3, (-0.5, 0.0)),
    "on one side": (
        (0.5, 1.0), (0.5, 0.5), (1 - 1.5 / (1 + 1 / 1.2), -1.5 * 0.5 / 0.3 / (1 + 1 / 1.2))
    ),
    "laws that would gain energy together": ((-0.5, 1.0), (0.0, 1.0), None),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", some(FEET, "one is redundant", "laws that would gain energy together")
)
def test_a_rod_lands_flat_on_its_feet(name):
    """Where the far foot would have to pull, only the near one strikes."""
    places, restitution, wanted = FEET[name]
    start = Feet(*(jnp.array(x) for x in (-0.3, 0.0, 1.0, 0.0)))
    run = vi.simulate(Rod(restitution, places), start, 1)
    assert bool(run.successful)
    v, turn = float(run.last.v), float(run.last.turn)
    assert v * v + 0.3 * turn * turn <= 1 + 1e-12
    assert all(v + at * turn <= 1e-12 for at in places)
    if wanted is not None:
        np.testing.assert_allclose((v, turn), wanted, atol=1e-12)
