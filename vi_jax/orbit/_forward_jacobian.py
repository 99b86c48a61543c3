"""Derivatives by columns, for maps that are differentiated within another derivative."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree


def forward_jacobian(f: Callable[..., Any]) -> Callable[..., Any]:
    """`f`, with a derivative that is its Jacobian, taken forward, times the tangent.

    Only leaves that are being differentiated make columns. Inside of another derivative, as that of
    an orbit by the implicit function theorem, the columns are few and stay together.

    **Arguments:** a function of pytrees that returns a pytree of floating-point arrays.

    **Returns:** the function, with the same arguments; under `vmap` as under `jit`.
    """

    @eqx.filter_custom_jvp
    def wrapped(*args):
        return _tied(f(*args), args)

    @wrapped.def_jvp
    def _(primals, tangents):
        perturbed = jtu.tree_map(lambda t: t is not None, tangents, is_leaf=lambda t: t is None)

        def columns(*args):
            moving, still = eqx.partition(args, perturbed)
            flat, unravel = ravel_pytree(moving)

            def along(direction):
                def moved(moving):
                    return f(*eqx.combine(moving, still))

                return jax.jvp(moved, (moving,), (unravel(direction),))

            basis = jnp.eye(flat.size, dtype=flat.dtype)
            return jax.vmap(along, out_axes=(None, -1))(basis)

        out, jacobian = forward_jacobian(columns)(*primals)
        step, _ = ravel_pytree(tangents)
        return out, jtu.tree_map(lambda column: column @ step, jacobian)

    return wrapped


def _tied(out: object, args: object) -> Any:
    """`out`, batched by `vmap` in every leaf as soon as one of `args` is.

    JAX mixes up the axes of a staged custom derivative whose values are batched in other leaves
    than its tangents.
    """
    leaves = [x for x in jtu.tree_leaves(args) if eqx.is_inexact_array(x)]
    same = sum(jnp.sum(x) for x in leaves) > 0
    return jtu.tree_map(lambda x: jnp.where(same, x, x), out)
