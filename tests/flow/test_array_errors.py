"""What is wrong about arrays of one's own machine is told before any work."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import pytest
import vi_jax as vi


class Rows(eqx.Module):
    x: Any
    v: Any


class Springs(vi.AbstractMachine):
    k: Any = eqx.field(default_factory=lambda: jnp.array([1.0, 2.0]))
    gap: Any = 9.0
    restitution: Any = 0.5
    cycle: Any = 3.0

    @property
    def stops(self):
        return (vi.RigidStop(self.gap, self.restitution),)

    def position(self, state):
        return state.x[0]

    def velocity(self, state):
        return state.v[0]

    def placed(self, state, Y, V):
        return Rows(state.x.at[0].set(Y), state.v.at[0].set(V))

    def field(self, s, state):
        return Rows(state.v, -self.k * state.x)


class Unplaced(Springs):
    def position(self, state):
        return state.x

    def velocity(self, state):
        return state.v


class Squares(Springs):
    def quantities(self, s, state):
        return {"square": state.x**2}


START = Rows(jnp.zeros(2), jnp.ones(2))


@pytest.mark.parametrize(
    ("machine", "words"),
    [
        (Springs(k=jnp.array([1.0, jnp.nan])), "`machine` must hold numbers, but its k is"),
        (Springs(gap=jnp.array([9.0])), r"must have one number as `gap`, but has shape \(1,\)"),
        (Springs(restitution=jnp.ones(2)), r"one number as `restitution`, but has shape \(2,\)"),
        (Springs(cycle=jnp.ones(1)), r"`cycle` of a Springs must be one number, but has shape"),
        (Unplaced(), r"shape \(2,\). Of a state of arrays a machine of your own says by"),
        (Squares(), "`quantities` of a Squares must be numbers, but 'square' is an array"),
    ],
)
def test_of_a_machine(machine, words):
    with pytest.raises((TypeError, ValueError), match=words):
        vi.simulate(machine, START, 2)


def test_of_a_whole_array_as_an_axis():
    with pytest.raises(ValueError, match=r"name one of its numbers, as 'k\[0\]'"):
        vi.scan(Springs(), {"k": [1.0, 2.0]}, start=START, measure="extremes", cycles=2)
