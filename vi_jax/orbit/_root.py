"""The root of the cycle map's residual: of F(x, p), what the arcs that begin in x lack to end where
the next one begins, with p the numbers of the machine. How a root is searched for is in
`root_finders.py`, its derivative in `_arcs.py`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from .._types import State, Vector
from ..flow import simulate
from ..machine import angles_in, bare, in_rows, nearest_images, raveled
from ._cycle_map import CycleMap
from .root_finders import AbstractRootFinder, Found, find_root


def _missing(
    arc: CycleMap, arcs: Float[Array, "arcs states"], unravel: Callable[[Vector], State]
) -> Float[Array, "arcs states"]:
    """F: what each arc lacks to end where the next one begins; after the last comes the first."""
    ends = jax.vmap(lambda x: raveled(arc(unravel(x)))[0])(arcs)
    angles, after = angles_in(arc.machine, bare(unravel(arcs[0]))), jnp.roll(arcs, -1, axis=0)
    return nearest_images(angles, ends, after) - after


def root_of(arc: CycleMap, guess: State, root_finder: AbstractRootFinder) -> Found:
    """Where a root finder comes to from a guess.

    **Arguments:** `arc`, the map over one arc; `guess`, a state on its section, in which the first
    arc begins, the others where the motion from there is then; `root_finder`, which says how many
    arcs there are.

    **Returns:** `Found`, all its numbers floats; its `x` are the states in which the arcs begin, as
    rows.
    """
    x, unravel = raveled(guess)
    arcs = x[None]
    if root_finder.arcs > 1:
        run = simulate(
            arc.machine, guess, arc.cycles * root_finder.arcs, method=arc.method, rests=arc.rests
        )
        sections = in_rows(run.sections)[: -1 : arc.cycles]
        arcs = jnp.where(jnp.isfinite(sections), sections, x)
    found = find_root(root_finder, lambda arcs: _missing(arc, arcs, unravel), arcs)
    return jtu.tree_map(lambda a: a.astype(x.dtype), found)  # numbers all, for `jvp`


def shooting_matrix(jacobians: Float[Array, "arcs states states"]) -> Float[Array, "all all"]:
    """∂F/∂x from the derivative Jᵢ of each arc's end by its start: Jᵢ on the diagonal, beside it
    the -1 by which the next arc's start enters."""
    arcs, states, _ = jacobians.shape
    following = jnp.kron(jnp.roll(jnp.eye(arcs), 1, axis=1), jnp.eye(states))
    return block_diag(*jacobians) - following.astype(jacobians.dtype)
