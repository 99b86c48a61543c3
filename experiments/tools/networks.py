"""A shaken oscillator of which a network is a part, by whose weights it is differentiated."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import vi_jax as vi
from jax.flatten_util import ravel_pytree

FREQUENCY, GAP, RESTITUTION, AMPLITUDE, DAMPING = 0.9, 0.6, 0.7, 1.0, 0.02


def network(width: int) -> Any:
    """Of one number, with two hidden layers of this width."""
    return eqx.nn.MLP("scalar", "scalar", width, 2, jnp.tanh, key=jax.random.key(0))


class Law(eqx.Module):
    """k of the speed of approach, from 0.3 to 0.7."""

    network: Any

    def __call__(self, v):
        return 0.3 + 0.4 * jax.nn.sigmoid(self.network(v))


class Oscillator(vi.AbstractMachine):
    """A body on a spring; `part` says what the network is: its `law` of restitution, a part of its
    `spring`'s force, or that `without` a stop."""

    network: Any
    part: str = eqx.field(static=True)

    @property
    def contacts(self):  # pyright: ignore
        if self.part == "without":
            return ()
        return (vi.RigidStop(GAP, Law(self.network) if self.part == "law" else RESTITUTION),)

    @property
    def cycle(self):
        return 2 * jnp.pi / FREQUENCY

    def start(self, *, Y):  # pyright: ignore
        """At rest in a place."""
        return vi.OscillatorState(Y, 0 * Y)

    def field(self, s, state):
        return vi.OscillatorState(state.V, self.rate(s, state.Y, state.V))

    def rate(self, s, Y, V):
        """dV/ds."""
        force = Y if self.part == "law" else Y + 0.1 * self.network(Y)
        return AMPLITUDE * jnp.cos(FREQUENCY * s) - 2 * DAMPING * V - force


def oscillator(width: int, part: str) -> Oscillator:
    """With a network of this width in this part."""
    return Oscillator(network(width), part)  # pyright: ignore[reportCallIssue]: stops are no field


def flat(tree: Any) -> tuple[jax.Array, Any]:
    """All numbers of a machine or network in one row, and the function from such a row to it."""
    leaves, rest = eqx.partition(tree, eqx.is_inexact_array)
    row, shaped = ravel_pytree(leaves)
    return row, lambda numbers: eqx.combine(shaped(numbers), rest)


def last_places(machine: Any, starts: jax.Array, cycles: int, method: Any) -> tuple[Any, jax.Array]:
    """The sum of the squares of where lanes end, as a function of the machine's numbers in a row,
    and that row."""
    row, whole = flat(machine)

    def lane(numbers, Y):
        own = whole(numbers)
        return vi.simulate(own, own.start(Y=Y), cycles, method=method).last.Y

    return lambda numbers: jnp.sum(jax.vmap(lane, (None, 0))(numbers, starts) ** 2), row
