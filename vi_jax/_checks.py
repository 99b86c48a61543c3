"""Host-side checks of what a user passes in. Concrete numbers are looked at; tracers pass."""

import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def number(name: str, value: Any) -> jax.Array:
    """A real number or array of numbers as a floating-point JAX array.

    What is no tracer stays a known number inside of `jit` too, so that it can be checked there.

    **Raises:** `TypeError` if `value` is not real-valued.
    """
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating):
        return value
    if isinstance(value, bool | str) or value is None:
        raise TypeError(f"Argument `{name}` must be a real number, but got {value!r}.")
    if isinstance(value, int | float | np.generic | np.ndarray):
        with jax.ensure_compile_time_eval():
            return _floating(name, jnp.asarray(value))
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError):
        raise TypeError(f"Argument `{name}` must be a real number, but got {value!r}.") from None
    return _floating(name, array)


def _floating(name: str, array: jax.Array) -> jax.Array:
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise TypeError(
            f"Argument `{name}` must be a real number, but its dtype is {array.dtype.name}."
        )
    return array.astype(jnp.result_type(float))


def concrete(value: Any) -> np.ndarray | None:
    """The numbers behind `value`, or `None` while they are being traced."""
    if not isinstance(value, jax.Array | np.ndarray | float | int):
        return None  # a placeholder (a spec, a tangent's None), which holds no number to check
    if isinstance(value, Tracer):
        return None
    return np.asarray(value)


def require(
    name: str,
    value: Any,
    *,
    low: float = -np.inf,
    high: float = np.inf,
    open_low: bool = False,
    open_high: bool = False,
) -> None:
    """Raise a `ValueError` unless every concrete number in `value` is finite and in range."""
    numbers = concrete(value)
    if numbers is None:
        return
    fits = np.isfinite(numbers)
    fits &= numbers > low if open_low else numbers >= low
    fits &= numbers < high if open_high else numbers <= high
    if not fits.all():
        left = "(" if open_low or np.isinf(low) else "["
        right = ")" if open_high or np.isinf(high) else "]"
        worst = numbers[~fits].ravel()[0] if numbers.ndim else numbers[()]
        raise ValueError(
            f"Argument `{name}` must be finite and in {left}{low:g}, {high:g}{right}, "
            f"but got {worst!s}."
        )


def count(name: str, value: Any, *, least: int = 0) -> int:
    """A Python integer not below `least`, or an error that says what came."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"Argument `{name}` must be an integer, but got {value!r}.")
    if value < least:
        raise ValueError(f"Argument `{name}` must be at least {least}, but got {value}.")
    return int(value)


def unwritable(folder: str | Path) -> str | None:
    """Why nothing can be written into this folder, or `None`; makes the folder."""
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return None
    except (FileExistsError, NotADirectoryError):
        return f"{folder} is or lies below a file"
    except (OSError, ValueError) as error:
        return str(getattr(error, "strerror", None) or error)


def one_of(name: str, value: Any, allowed: tuple[str, ...]) -> str:
    """One of a few words, or an error that lists them."""
    if value not in allowed:
        words = ", ".join(repr(word) for word in allowed)
        raise ValueError(f"Argument `{name}` must be one of {words}, but got {value!r}.")
    return value
