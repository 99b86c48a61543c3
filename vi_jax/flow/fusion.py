"""How the loop is kept fast on a CPU: what XLA must not copy, and how it should compile."""

from collections.abc import Callable
from typing import Any

import jax

_CPU_OPTIONS = {
    # Small kernels lose more by being split over threads than they gain.
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner",
    # The widest there are; XLA itself prefers half of that.
    "xla_cpu_prefer_vector_width": 512,
}


def jit(function: Callable, **options: Any) -> jax.stages.Wrapped:
    """Compile as `jax.jit`, with compiler options for batches of simulations on a CPU.

    On other backends it is plain `jax.jit`. Measured on 1,024 motor lanes on one core it saves a
    tenth to a third of the time. For outermost use only: JAX refuses compiler options inside of
    another `jit`.

    **Arguments:** `function` and any options of `jax.jit`.
    """
    return jax.jit(function, **{**compiling(), **options})


def compiling() -> dict[str, Any]:
    """Options for `jax.jit`, by backend."""
    return {"compiler_options": _CPU_OPTIONS} if jax.default_backend() == "cpu" else {}
