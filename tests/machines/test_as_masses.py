"""A ready machine, compared with a `Mechanical` one in other coordinates, where the momentum and
the energy of an impact follow from the masses."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

LANES, CYCLES = 24, 4


class Box(vi.Mechanical):
    """A ball in a box on a spring, with the parameters of an `ImpactPair`."""

    of: Any

    q: ClassVar = ("box", "ball")
    cycle: ClassVar = 2 * np.pi

    @property
    def mass(self):
        return 1.0, self.of.mass_ratio

    def force(self, t, q, v):
        w, push = self.of.frequency, self.of.amplitude * jnp.sin(t)
        return dict(box=push - w * (w * q.box + 2 * self.of.damping_ratio * v.box), ball=0.0)

    @property
    def contacts(self):
        gap, on = self.of.half_gap, lambda q: q.ball - q.box
        return tuple(vi.RigidStop(gap, self.of.restitution, x, on=on) for x in ("right", "left"))

    def from_ready(self, x):
        v = dict(box=x.v.box, ball=x.v.box + x.v.place)
        return self.at(box=x.box, ball=x.box + x.place, v=v)

    def view(self, z):
        return z.ball - z.box, z.box, z.v.ball - z.v.box, z.v.box


NUMBERS = {
    "restitution": (0.3, 0.9), "half_gap": (0.6, 2), "mass_ratio": (0.1, 1),
    "damping_ratio": (0, 0.3), "amplitude": (0.1, 1), "frequency": (0, 2),
}  # fmt: skip
STARTS = {
    "place": (-0.5, 0.5), "box": (-0.2, 0.2), "v": {"place": (-1, 1), "box": (-0.3, 0.3)}
}  # fmt: skip


@pytest.mark.slow
def test_an_impact_pair_equals_a_machine_with_masses():
    draw = np.random.default_rng(5).uniform
    drawn = jax.tree.map(
        lambda ends: jnp.asarray(draw(*ends, LANES)), (NUMBERS, STARTS),
        is_leaf=lambda x: isinstance(x, tuple) and not isinstance(x[0], dict),
    )  # fmt: skip

    def both(numbers, begin):
        machine = vi.machines.ImpactPair(**numbers)
        start, other = machine.at(**begin), Box(machine)
        runs = [
            vi.simulate(x, at, CYCLES, method=vi.Adaptive(rtol=1e-12))
            for x, at in ((machine, start), (other, other.from_ready(start)))
        ]
        ours = jnp.stack(jax.tree.leaves(runs[0].sections)), jnp.stack(other.view(runs[1].sections))
        return ours, [x.impact_energy for x in runs], [x.impacts for x in runs], runs

    states, energies, impacts, runs = vi.jit(jax.vmap(both))(*drawn)
    assert all(bool(run.successful.all()) for run in runs)
    for a, b in (states, energies):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-8)
    few = np.maximum(*impacts) < 20  # rounding decides the last of a chatter
    np.testing.assert_array_equal(impacts[0][few], impacts[1][few])
    np.testing.assert_allclose(*(run.duration for run in runs), rtol=1e-8)
    assert int(impacts[0].sum()) > LANES
