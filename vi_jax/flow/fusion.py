"""How the loop is kept fast on a CPU: what XLA must not copy, and how it should compile."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

_CPU_OPTIONS = {
    # Small kernels lose more by being split over threads than they gain.
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner",
    "xla_cpu_prefer_vector_width": 512,
}


def pin(x: Any, one: Float[Array, ""]) -> Any:
    """The same values, divided by a 1 that the compiler does not know.

    XLA's CPU backend copies cheap producers into each of their consumers when it fuses, which
    multiplies the work of an iteration; it does not copy divisions.
    """
    return jtu.tree_map(lambda v: v / one, x)


def pin_flag(flag: Bool[Array, ""], one: Float[Array, ""]) -> Bool[Array, ""]:
    """`pin` for a truth value."""
    return pin(jnp.where(flag, one, 0.0), one) > 0.5


def jit(function: Callable, **options: Any) -> jax.stages.Wrapped:
    """`jax.jit` with the compiler options that suit batches of simulations on a CPU.

    On other backends it is plain `jax.jit`. Measured on 1,024 motor lanes on one core it saves a
    tenth to a third of the time. For outermost use only: JAX refuses compiler options inside of
    another `jit`.

    **Arguments:** `function` and any options of `jax.jit`.
    """
    return jax.jit(function, **{**compiling(), **options})


def compiling() -> dict[str, Any]:
    """Options for `jax.jit`, by backend."""
    return {"compiler_options": _CPU_OPTIONS} if jax.default_backend() == "cpu" else {}
