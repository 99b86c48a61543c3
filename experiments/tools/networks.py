"""A shaken oscillator that contains a neural network, for gradients with respect to its weights."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import vi_jax as vi
from jax.flatten_util import ravel_pytree

FREQUENCY, GAP, RESTITUTION, AMPLITUDE, DAMPING = 0.9, 0.6, 0.7, 1.0, 0.02


def network(width: int) -> Any:
    """Return a network of one input and one output, with two hidden layers of this width."""
    return eqx.nn.MLP("scalar", "scalar", width, 2, jnp.tanh, key=jax.random.key(0))


class Law(eqx.Module):
    """The restitution as a function of the speed of approach, between 0.3 and 0.7."""

    network: Any

    def __call__(self, v):
        return 0.3 + 0.4 * jax.nn.sigmoid(self.network(v))


class Oscillator(vi.AbstractMachine):
    """A body on a spring. `part` selects the use of the network: `"law"` of restitution, a term of
    the `"spring"` force, or such a term in a machine `"without"` a stop."""

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
        """Return the state of rest at the position Y."""
        return vi.OscillatorState(Y, 0 * Y)

    def field(self, s, state):
        return vi.OscillatorState(state.V, self.rate(s, state.Y, state.V))

    def rate(self, s, Y, V):
        """Return dV/ds."""
        force = Y if self.part == "law" else Y + 0.1 * self.network(Y)
        return AMPLITUDE * jnp.cos(FREQUENCY * s) - 2 * DAMPING * V - force


def oscillator(width: int, part: str) -> Oscillator:
    """Return an oscillator with a network of this width in this part."""
    return Oscillator(network(width), part)  # pyright: ignore[reportCallIssue]: stops are no field


def flat(tree: Any) -> tuple[jax.Array, Any]:
    """Return all numbers of a machine or network as one array, and the function from it back."""
    leaves, rest = eqx.partition(tree, eqx.is_inexact_array)
    row, shaped = ravel_pytree(leaves)
    return row, lambda numbers: eqx.combine(shaped(numbers), rest)


def last_places(machine: Any, starts: jax.Array, cycles: int, method: Any) -> tuple[Any, jax.Array]:
    """Return the sum of the squared final positions of lanes, as a function of the array of the
    machine's numbers, and that array."""
    row, whole = flat(machine)

    def lane(numbers, Y):
        own = whole(numbers)
        return vi.simulate(own, own.start(Y=Y), cycles, method=method).last.Y

    return lambda numbers: jnp.sum(jax.vmap(lane, (None, 0))(numbers, starts) ** 2), row
