"""The root of the cycle map's residual, and how it moves with the numbers of the machine."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from ..flow import simulate
from ._neutral import least
from .cycle_map import CycleMap
from .root_finders import AbstractRootFinder, search


class Root(NamedTuple):
    """Starting states of the arcs, as rows, and how the search went; all floats."""

    arcs: Float[Array, "arcs states"]
    residual: Float[Array, ""]
    converged: Float[Array, ""]
    steps: Float[Array, ""]
    history: Float[Array, " max_steps"]


def _missing(arc: CycleMap, arcs: Float[Array, "arcs states"], unravel: Any) -> Array:
    """What each arc lacks to end where the next one begins."""
    ends = jax.vmap(lambda x: ravel_pytree(arc(unravel(x)))[0])(arcs)
    return ends - jnp.roll(arcs, -1, axis=0)


@eqx.filter_custom_jvp
def root_of(arc: CycleMap, guess: Any, root_finder: AbstractRootFinder) -> Root:
    """Where the search from a guess ends; differentiated by the implicit function theorem."""
    x, unravel = ravel_pytree(guess)
    arcs = x[None]
    if root_finder.arcs > 1:
        run = simulate(
            arc.machine, guess, arc.cycles * root_finder.arcs, method=arc.method, rests=arc.rests
        )
        sections = jnp.stack(jtu.tree_leaves(run.sections), axis=-1)[: -1 : arc.cycles]
        arcs = jnp.where(jnp.isfinite(sections), sections, x)
    found = search(root_finder, lambda arcs: _missing(arc, arcs, unravel), arcs)
    dtype = x.dtype
    return Root(
        found.x,
        found.residual,
        found.converged.astype(dtype),
        found.steps.astype(dtype),
        found.history,
    )


@root_of.def_jvp
def _(primals, tangents):
    arc, guess, root_finder = primals
    root = root_of(arc, guess, root_finder)
    _, unravel = ravel_pytree(guess)
    still = jtu.tree_map(jnp.zeros_like, root)
    if not jtu.tree_leaves(tangents[0]):
        return root, still

    jacobians = jax.vmap(lambda x: arc.jacobian(unravel(x)))(root.arcs)
    _, rate = eqx.filter_jvp(
        lambda arc: _missing(arc, root.arcs, unravel).ravel(), (arc,), (tangents[0],)
    )
    move = -least(shooting_matrix(jacobians), rate).reshape(root.arcs.shape)
    # Where there is no orbit there is no derivative of one.
    # A product, since the transpose of a choice would be zero.
    return root, still._replace(arcs=move * jnp.where(root.converged > 0, 1.0, jnp.nan))


def shooting_matrix(jacobians: Float[Array, "arcs states states"]) -> Float[Array, "all all"]:
    """Derivative of `_missing` by the arcs, from the derivative of each arc's end by its start."""
    arcs, states, _ = jacobians.shape
    following = jnp.kron(jnp.roll(jnp.eye(arcs), 1, axis=1), jnp.eye(states))
    return block_diag(*jacobians) - following.astype(jacobians.dtype)
