"""Two coupled bodies; the first one hits a stop and rests on it."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import vi_jax as vi


class Two(NamedTuple):
    x: Any
    u: Any
    z: Any
    v: Any


class Coupled(vi.AbstractMachine):
    """x'' + 0.1 x' + x + κ (x - z) = cos ωt, z'' + 0.1 z' + K z + κ (z - x) = 0, x ≤ d."""

    omega: Any = 0.35
    restitution: Any = 0.5
    gap: Any = -0.4
    coupling: Any = 6.0
    spring: Any = 0.0

    @property
    def cycle(self):
        return 2 * jnp.pi / self.omega

    @property
    def contacts(self):
        return vi.RigidStop(self.gap, self.restitution, on=("x", "u"))

    def field(self, s, q):
        pull = self.coupling * (q.x - q.z)
        x = jnp.cos(self.omega * s) - q.x - 0.1 * q.u - pull
        return Two(q.u, x, q.v, pull - 0.1 * q.v - self.spring * q.z)


def settled(machine, cycles=200):
    start = Two(*(jnp.asarray(a) for a in (float(machine.gap) - 0.1, 0.0, 0.0, 0.0)))
    last = vi.simulate(machine, start, 1, settle=cycles).last
    return vi.find_orbit(machine, last, impact_log=64, throw=True)
