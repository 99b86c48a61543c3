"""Numbers as arrays of one floating-point type, and what is said of their precision."""

import contextlib
import sys
import warnings
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer


def number(name: str, value: object) -> jax.Array:
    """A real number or array of numbers as a floating-point JAX array.

    What is no tracer stays a known number inside of `jit` too, so that it can be checked there.

    **Raises:** `TypeError` if `value` is not real-valued.
    """
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating):
        return _floating(name, value)
    if isinstance(value, bool | str) or value is None:
        raise TypeError(f"Argument `{name}` must be a real number, but got {value!r}.")
    try:
        if isinstance(value, int | float | np.generic | np.ndarray):
            with jax.ensure_compile_time_eval():
                return _floating(name, jnp.asarray(value, *_type_of(value)))
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(f"Argument `{name}` must be a real number, but got {value!r}.") from None
    return _floating(name, array)


def _type_of(value: object) -> tuple[Any, ...]:
    """The type of the array that holds it, where it is not its own: a `float` of Python's would
    make an array of no certain type, for which a program is compiled apart from that for others."""
    own = isinstance(value, np.generic) or not isinstance(value, float)
    return () if own else (jnp.result_type(float),)


def strongly_typed(value: object) -> Any:
    """A number as an array of a certain type; all else, whole numbers and rows among it, as it is.

    What is no tracer stays a known number inside of `jit` too.
    """
    if isinstance(value, jax.Array):
        return value.astype(value.dtype) if value.weak_type else value
    if isinstance(value, float | np.floating) or (
        isinstance(value, np.ndarray) and not value.ndim and value.dtype.kind == "f"
    ):
        with jax.ensure_compile_time_eval():
            return jnp.asarray(value, *_type_of(value))
    return value


def real(name: str) -> Callable[[Any], jax.Array]:
    """The converter of a field that holds real numbers."""
    return partial(number, name)


def optional_real(name: str) -> Callable[[Any], jax.Array | None]:
    """The converter of a field that holds real numbers or `None`."""
    return lambda value: None if value is None else number(name, value)


def real_or_law(name: str) -> Callable[[Any], Any]:
    """The converter of a field that holds a real number, or a function that gives one."""
    return lambda value: value if callable(value) else number(name, value)


def _floating(name: str, array: jax.Array) -> jax.Array:
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise TypeError(
            f"Argument `{name}` must be a real number, but its dtype is {array.dtype.name}."
        )
    if narrow(array):
        warn_of_narrow(f"Argument `{name}` is")
    elif jnp.issubdtype(array.dtype, jnp.floating):
        return array
    return array.astype(jnp.result_type(float))


def narrow(value: object) -> bool:
    """Whether these are floating-point numbers of less than the session's precision."""
    return _bits(value) < 0


def _bits(value: Any) -> int:
    """By how many bits a floating-point JAX array is wider than the session's numbers."""
    if not (eqx.is_inexact_array(value) and jnp.issubdtype(value.dtype, jnp.floating)):
        return 0
    return jnp.finfo(value.dtype).bits - jnp.finfo(jnp.result_type(float)).bits


def require_session(name: str, tree: object) -> None:
    """**Raises:** `TypeError` for JAX arrays of double precision in a session of single precision,
    in which operations on them are not defined."""
    wide = [path for path, x in jtu.tree_leaves_with_path(tree) if _bits(x) > 0]
    if wide:
        names = ", ".join(jtu.keystr(path).lstrip(".") for path in wide)
        raise TypeError(
            f"Argument `{name}` must be of single precision, as this session is, but has numbers "
            f"of double precision ({names}), made while that was switched on. Make it again, or "
            'switch it on: `jax.config.update("jax_enable_x64", True)`.'
        )


def warn_of_narrow(what: str) -> None:
    """Say that numbers came in less than the session's precision, which nothing gives back."""
    eps = float(jnp.finfo(jnp.float32).eps)
    warn(
        f"{what} of less than double precision, known to {eps:.0e} only, in a session of double "
        "precision, to which it is promoted. Make numbers after double precision is switched on."
    )


# What has been warned of in the call of a user's that is at work.
_SAID: ContextVar[set[str] | None] = ContextVar("said", default=None)

# Whose frames lie between a user's line and what is said about it.
_BETWEEN = {
    __name__.partition(".")[0], "beartype", "contextlib", "diffrax", "equinox", "functools", "jax",
    "jaxtyping", "lineax", "optimistix",
}  # fmt: skip


@contextlib.contextmanager
def saying_once() -> Iterator[None]:
    """Within it each warning is given once, however often a call simulates and JAX traces it."""
    token = _SAID.set(set()) if _SAID.get() is None else None
    try:
        yield
    finally:
        if token is not None:
            _SAID.reset(token)


def warn(words: str) -> None:
    """Warn at the line of the user's that called this package, however deep within it this is."""
    said = _SAID.get()
    if said is not None:
        if words in said:
            return
        said.add(words)
    frame, level = sys._getframe(), 1
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in _BETWEEN:
        frame, level = frame.f_back, level + 1
    warnings.warn(words, stacklevel=level)


def concrete(value: object) -> np.ndarray | None:
    """The numbers behind `value`, or `None` while they are being traced."""
    if not isinstance(value, jax.Array | np.ndarray | np.generic | float | int):
        return None  # a placeholder (a spec, a tangent's None), which holds no number to check
    if isinstance(value, Tracer):
        return None
    return np.asarray(value)
