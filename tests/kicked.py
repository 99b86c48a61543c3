"""Machines that stand still but for a kick in each cycle: their section map is any map."""

import equinox as eqx
import jax
import jax.numpy as jnp
import vi_jax as vi


class Kicked(vi.AbstractMachine):
    """The map is `kick`, of a state that nothing else moves."""

    a: jax.Array = eqx.field(converter=jnp.asarray)
    b: jax.Array = eqx.field(converter=jnp.asarray)
    stops: tuple = ()

    @property
    def cycle(self):
        return 1.0

    @property
    def events(self):
        half = 2 * jnp.pi * 0.5
        return (
            vi.Reset(
                lambda machine, s, x: jnp.sin(2 * jnp.pi * s - half),
                lambda machine, s, x: machine.kick(*x),
            ),
        )

    def kick(self, *x):
        """The state after a cycle."""
        raise NotImplementedError

    def field(self, s, x):
        return tuple(0 * y for y in x)

    def position(self, x):
        return x[0]

    def velocity(self, x):
        return x[1]


def at(*x):
    return tuple(jnp.asarray(y, float) for y in x)
