"""Chains of masses that strike a stop, for the benchmark of long chains and its test."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import vi_jax as vi

AMPLITUDE, DAMPING, GAP, RESTITUTION = 1.0, 0.05, 1.5, 0.7


def linear_chain(frequency: Any, size: int) -> vi.machines.Structure:
    """Return N unit masses on unit springs with proportional dashpots, shaken at the first mass."""
    stiffness = 2 * jnp.eye(size) - jnp.eye(size, k=1) - jnp.eye(size, k=-1)
    stiffness = stiffness.at[-1, -1].set(1.0)
    last = jnp.zeros(size).at[-1].set(1.0)
    return vi.machines.Structure(  # pyright: ignore[reportCallIssue]
        mass=jnp.ones(size),
        damping=DAMPING * stiffness,
        stiffness=stiffness,
        contacts=(vi.RigidStop(GAP, RESTITUTION, at=last),),
        force=AMPLITUDE * jnp.zeros(size).at[0].set(1.0),
        frequency=frequency,
    )


class CubicChain(vi.AbstractMachine):
    """The same chain, with springs of force e + cubic e³ at the stretch e."""

    frequency: Any
    cubic: Any
    size: int = eqx.field(static=True)

    @property
    def contacts(self):  # pyright: ignore
        return (vi.RigidStop(GAP, RESTITUTION),)

    @property
    def coordinates(self):
        return (
            vi.Coordinate(
                lambda z: z.displacement[-1],
                lambda z: z.velocity[-1],
                lambda z, Y, V: vi.machines.StructureState(
                    z.displacement.at[-1].set(Y), z.velocity.at[-1].set(V)
                ),
            ),
        )

    @property
    def cycle(self):
        return 2 * jnp.pi / self.frequency

    def start(self):
        return vi.machines.StructureState(jnp.zeros(self.size), jnp.zeros(self.size))

    def field(self, s, state):
        x, v = state.displacement, state.velocity
        stretch = jnp.concatenate([x[:1], x[1:] - x[:-1]])
        rate = jnp.concatenate([v[:1], v[1:] - v[:-1]])
        pull = stretch + self.cubic * stretch**3 + DAMPING * rate
        drive = jnp.zeros_like(x).at[0].set(AMPLITUDE * jnp.cos(self.frequency * s))
        pulled = jnp.concatenate([pull[1:], jnp.zeros(1)])
        return vi.machines.StructureState(v, drive - pull + pulled)


def cubic_chain(frequency: Any, cubic: Any, size: int) -> CubicChain:
    """Return a `CubicChain` of N masses."""
    return CubicChain(frequency, cubic, size)  # pyright: ignore[reportCallIssue]
