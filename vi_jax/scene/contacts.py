"""What contacts that share bodies do to each other, in an impact and at rest.

The force of a contact changes the state as `Coordinate.placed` does with its velocity; so much of
it as changes that velocity by one is its *push*. How much of each there is, so that the velocities
of several contacts become what they are to be, is a linear system as large as there are contacts.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]

# A pivot smaller than this (its row's begins as 1) is that of a contact whose velocity the others
# have settled already, as that of the fourth leg of a table: it gets no force.
_REDUNDANT = 1e-9


def push_of(coordinate: Any, state: Any) -> Any:
    """How a state changes by a contact's force, by so much as changes its velocity by one."""
    place, velocity = coordinate.position(state), coordinate.velocity(state)
    one = jnp.ones_like(velocity)
    return jax.jvp(lambda V: coordinate.placed(state, place, V), (velocity,), (one,))[1]


def gained(coordinate: Any, state: Any, change: Any) -> Scalar:
    """What a coordinate's velocity gains as the state changes."""
    return jax.jvp(coordinate.velocity, (state,), (change,))[1]


def shares(coordinates: Sequence[Any], state: Any, pushes: Sequence[Any]) -> list[list[Scalar]]:
    """What each coordinate's velocity gains by each push."""
    return [[gained(coordinate, state, push) for push in pushes] for coordinate in coordinates]


def forces(
    gains: Sequence[Sequence[Scalar]], acting: Sequence[Flag], wanted: Sequence[Scalar]
) -> list[Scalar]:
    """How much of each push there is, so that the velocities of those contacts that are `acting`
    change as `wanted`; none of the others'.

    **Arguments:** `gains` as from `shares`, and the other two of each contact.
    """
    rows = []
    for j, row in enumerate(gains):
        both = zip(row, acting, strict=True)
        row = [
            jnp.where(acting[j] & other, x, 1.0 if j == k else 0.0)
            for k, (x, other) in enumerate(both)
        ]
        rows.append([*row, jnp.where(acting[j], wanted[j], 0.0)])
    return _solved(rows)


def _solved(rows: list[list[Scalar]]) -> list[Scalar]:
    """The solution of a small linear system, its right side as the last column. Its matrix is that
    of contacts' inverse masses, which needs no pivoting."""
    n = len(rows)
    for i in range(n):
        pivot = rows[i][i]
        found = jnp.abs(stop_gradient(pivot)) > _REDUNDANT
        by = jnp.where(found, pivot, 1.0)
        rows[i] = [jnp.where(found, x / by, 0.0) for x in rows[i]]
        for j in range(n):
            if j != i:
                rows[j] = [a - rows[j][i] * b for a, b in zip(rows[j], rows[i], strict=True)]
    return [row[-1] for row in rows]


def added(state: Any, amounts: Sequence[Scalar], changes: Sequence[Any]) -> Any:
    """A tree with so much of each change added."""
    for amount, change in zip(amounts, changes, strict=True):
        state = jtu.tree_map(lambda a, b, amount=amount: a + amount * b, state, change)
    return state
