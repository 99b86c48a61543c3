"""Checks and conversions of a user's arguments. Concrete numbers are checked, tracers are not."""

import dataclasses
import math
import os
import reprlib
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache, partial, wraps
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import core
from jax.core import Tracer
from jaxtyping import Array, Bool

from ._messages import P, R, warn


class Range(NamedTuple):
    """An interval of finite numbers. Its bounds belong to it unless they are open."""

    low: float = -np.inf
    high: float = np.inf
    open_low: bool = False
    open_high: bool = False

    def holds(self, numbers: Any) -> Any:
        """Return whether each number is in the interval; a traced array for traced numbers."""
        fits = jnp.isfinite(numbers) if isinstance(numbers, jax.Array) else np.isfinite(numbers)
        fits = fits & (numbers > self.low if self.open_low else numbers >= self.low)
        return fits & (numbers < self.high if self.open_high else numbers <= self.high)

    def __str__(self) -> str:
        left = "(" if self.open_low or np.isinf(self.low) else "["
        right = ")" if self.open_high or np.isinf(self.high) else "]"
        return f"{left}{self.low:g}, {self.high:g}{right}"


REAL, POSITIVE, NOT_NEGATIVE, SHARE = Range(), Range(0.0, open_low=True), Range(0.0), Range(0, 1)


def require(name: str, value: object, **bounds: Any) -> None:
    """Raise a `ValueError` unless each concrete number in `value` is in the `Range` of `bounds`, or
    a `TypeError` if it is no real number. Placeholders and tracers are not checked."""
    numbers, range_ = _real(name, value), Range(**bounds)
    if numbers is None:
        return
    fits = np.asarray(range_.holds(numbers))
    if not fits.all():
        worst = numbers[~fits].ravel()[0] if numbers.ndim else numbers[()]
        raise ValueError(f"Argument `{name}` must be finite and in {range_}, but got {worst!s}.")


@lru_cache(maxsize=256)
def fields_with(kind: type, about: str) -> dict[str, Any]:
    """Return the metadata `about` (`"range"` or `"unit"`) of the fields of a class that have it."""
    found = {x.name: x.metadata[about] for x in dataclasses.fields(kind) if about in x.metadata}
    return found | (getattr(kind, "ranges", {}) if about == "range" else {})


def require_ranges(part: Any) -> None:
    """Apply `require` to each number of a module whose field has a range."""
    for name, range_, value in _ranged(part):
        require(name, value, **range_._asdict())


def in_range(tree: object) -> Bool[Array, ""]:
    """Return whether all numbers of all modules in a tree are in their ranges, traced ones
    included. Numbers that are traced or inserted by `eqx.tree_at` have passed no other check."""
    fits = jnp.asarray(True)
    for part in {id(part): part for part in _modules(tree)}.values():
        for _, range_, value in _ranged(part):
            fits = fits & jnp.all(range_.holds(jnp.asarray(value)))
    return fits


def _ranged(part: Any) -> Iterator[tuple[str, Range, Any]]:
    for name, range_ in fields_with(type(part), "range").items():
        value = getattr(part, name)
        if value is not None and not callable(value):
            yield name, range_, value


def _modules(node: object) -> Iterator[eqx.Module]:
    if isinstance(node, eqx.Module):
        yield node
        inner = list(vars(node).values())
    else:
        inner = list(node) if isinstance(node, tuple | list) else []
    for part in inner:
        yield from _modules(part)


def count(name: str, value: object, *, least: int = 0, most: int = 2**31 - 1) -> int:
    """Return an integer from `least` to `most` as a Python integer. Concrete integers of JAX and
    NumPy, such as an orbit's `cycles`, are allowed. **Raises:** `TypeError` or `ValueError`."""
    if isinstance(value, Tracer):
        raise TypeError(f"Argument `{name}` must be an integer that is known, but is being traced.")
    if isinstance(value, jax.Array | np.ndarray) and not value.ndim:
        value = np.asarray(value)[()]
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"Argument `{name}` must be an integer, but got {value!r}.")
    if value < least:
        raise ValueError(f"Argument `{name}` must be at least {least}, but got {value}.")
    if value > most:
        raise ValueError(f"Argument `{name}` must be at most {most}, but got {value}.")
    return int(value)


def unwritable(folder: str | Path) -> str | None:
    """Create a folder. Return why no file can be written into it, or `None`."""
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return None
    except (FileExistsError, NotADirectoryError):
        return f"{folder} is or lies below a file"
    except (OSError, ValueError) as error:
        return str(getattr(error, "strerror", None) or error)


def one_of(name: str, value: object, allowed: tuple[str, ...]) -> str:
    """Return `value` if it is an allowed word. **Raises:** `ValueError` that lists these."""
    if not isinstance(value, str) or value not in allowed:
        words = ", ".join(repr(word) for word in allowed)
        raise ValueError(f"Argument `{name}` must be one of {words}, but got {value!r}.")
    return value


def _is_real(kind: Any) -> bool:
    return bool(jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer))


def _real(name: str, value: object) -> np.ndarray | None:
    """Return the numbers of `value`, or `None` for tracers and placeholders."""
    numbers = concrete(value)
    wrong = isinstance(value, bool | str | bytes | complex | list | tuple | set | dict)
    if wrong or (numbers is not None and not _is_real(numbers.dtype)):
        raise TypeError(f"Argument `{name}` must be a real number, but got {value!r}.")
    return numbers


def given_number(name: str, value: object, **limits: Any) -> float:
    """Return one concrete, finite real number within the limits of `require`."""
    numbers = _real(name, value)
    if numbers is None or numbers.ndim:
        raise TypeError(f"Argument `{name}` must be a real number, but got {value!r}.")
    require(name, value, **limits)
    return float(numbers)


def interval(name: str, value: Any) -> tuple[float, float]:
    """Return two finite numbers, the lower one first. **Raises:** `ValueError` for other values."""
    try:
        low, high = (given_number(name, x) for x in value)
        if low < high:
            return low, high
    except (TypeError, ValueError):
        pass
    raise ValueError(
        f"Argument `{name}` must be two finite numbers (low, high), low < high, but got {value!r}."
    )


def _row_of_numbers(values: object) -> np.ndarray | None:
    """Return a non-empty list of finite real numbers as an array; `None` for other values. Strings,
    booleans, dates and complex numbers are refused, even those that NumPy converts."""
    if isinstance(values, list | tuple) and any(isinstance(x, bool | np.bool_) for x in values):
        return None
    try:
        row = np.asarray(values)
    except (TypeError, ValueError):
        return None
    if not _is_real(row.dtype) or row.ndim != 1 or not row.size:
        return None
    row = row.astype(float)
    return row if np.isfinite(row).all() else None


def axes_of(axes: Mapping[str, Any], argument: str = "axes") -> dict[str, np.ndarray]:
    """Return the axes as arrays of numbers. **Raises:** `ValueError` that names the wrong axis;
    `TypeError` if `axes` is no mapping or is empty."""
    if not isinstance(axes, Mapping) or not axes:
        raise TypeError(
            f"Argument `{argument}` must map names of numbers to rows of values, such as "
            f'{{"drive.frequency_ratio": [0.8, 0.9]}}, but got {axes!r}.'
        )
    found = {}
    for name, values in axes.items():
        row = _row_of_numbers(values)
        if row is None:
            raise ValueError(
                f"Axis {name!r} must be one row of finite real numbers, but got "
                f"{reprlib.repr(values)}."
            )
        found[str(name)] = row
    return found


def flag(name: str, value: object) -> bool:
    """Return a flag as a Python `bool`. **Raises:** `TypeError` for values that are no booleans."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"Argument `{name}` must be True or False, but got {value!r}.")
    return bool(value)


def tuple_of(name: str, value: Any, kind: type) -> tuple[Any, ...]:
    """Return a tuple whose items are instances of `kind`. **Raises:** `TypeError` for others."""
    try:
        if isinstance(value, str):
            raise TypeError
        found = tuple(value)
    except TypeError:
        raise TypeError(
            f"Argument `{name}` must be a tuple of `{kind.__name__}`s, but got {value!r}."
        ) from None
    for part in found:
        if not isinstance(part, kind):
            raise TypeError(f"Argument `{name}` must hold `{kind.__name__}`s, but holds {part!r}.")
    return found


def tuple_of_names(name: str, value: object) -> tuple[str, ...]:
    """Return a tuple of names. A single name may be given as a string."""
    return (value,) if isinstance(value, str) else tuple_of(name, value, str)


def instance_of(name: str, value: object, kind: type | tuple[type, ...], described: str) -> None:
    """Raise a `TypeError` unless `value` is an instance of `kind`, which `described` names."""
    if isinstance(value, kind):
        return
    got = short(value)
    if isinstance(value, type) and issubclass(value, kind):
        got = f"the class `{value.__name__}`: call it, `{value.__name__}(…)`, for one"
    raise TypeError(f"Argument `{name}` must be {described}, but got {got}.")


def returned(found: Any, whose: str, what: str) -> Any:
    """Return the result of a user's function. **Raises:** `TypeError` if it is `None`: the function
    `whose` must return `what`."""
    if found is None:
        raise TypeError(f"{whose} must return {what}, but its `return` is missing.")
    return found


def short(value: object) -> str:
    """Return the first line of the value's `repr`, with an ellipsis if there are more."""
    first, *more = repr(value).splitlines() or [""]
    return first + " …" * bool(more)


def state_of_numbers(name: str, state: object) -> Any:
    """Return `state` if each part of it is a real number or an array of them. **Raises:**
    `TypeError` that names a part that is not."""
    for part, value in vars(state).items():
        require_real(name, part, value)
    return state


def require_real(name: str, part: str, value: object) -> None:
    """Raise a `TypeError` unless a value is a real number or an array of them, traced or not. The
    text names `part` as the value's place in the argument; `""` stands for the whole argument."""
    real = isinstance(value, int | float) and not isinstance(value, bool)
    if isinstance(value, jax.Array | np.ndarray | np.generic):  # tracers are JAX arrays
        real = _is_real(value.dtype)
    if not real:
        got = f"its {part} is {value!r}" if part else f"got {value!r}"
        raise TypeError(f"Argument `{name}` must hold real numbers, but {got}.")


def named_leaves(tree: object) -> list[tuple[str, Any]]:
    """Return the leaves of a tree with their names; "" is the name of a tree that is a leaf."""
    return [(jtu.keystr(path).lstrip("."), x) for path, x in jtu.tree_leaves_with_path(tree)]


def fits_records(name: str, records: int, numbers: int) -> None:
    """Raise a `ValueError` if so many records of `numbers` numbers each cannot be stored."""
    count(name, records, most=2**31 - 2)
    fits_memory(name, 8.0 * records * numbers)


def fits_memory(name: str, size: int | float) -> None:
    """Raise a `ValueError` if `size` bytes are more than this machine's memory."""
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return
    if size > memory:
        raise ValueError(
            f"Argument `{name}` must ask for results that fit into the memory, "
            f"{math.ceil(memory / 1e9):,} GB, but asks for {math.ceil(size / 1e9):,} GB."
        )


def number(name: str, value: object) -> jax.Array:
    """Return a real number or an array of them as a floating-point JAX array. A concrete number
    stays concrete within `jit`, so that it can be checked there. **Raises:** `TypeError` if `value`
    is not real-valued."""
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating):
        return _floating(name, value)
    if isinstance(value, bool | str) or value is None:
        raise TypeError(f"Argument `{name}` must be a real number, but got {value!r}.")
    try:
        if isinstance(value, int | float | np.generic | np.ndarray):
            with jax.ensure_compile_time_eval():
                # By NumPy, since JAX compiles a program to convert a number.
                return _floating(name, from_host(np.asarray(value, *_type_of(value))))
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(f"Argument `{name}` must be a real number, but got {value!r}.") from None
    return _floating(name, array)


def _type_of(value: object) -> tuple[Any, ...]:
    """Return the data type for an array of `value` as a tuple, empty to keep the value's own. A
    Python `float` would become a weakly typed array, for which JAX compiles a separate program."""
    keeps_type = isinstance(value, np.generic) or not isinstance(value, float)
    return () if keeps_type else (jnp.result_type(float),)


def strongly_typed(value: object) -> Any:
    """Return a number as a strongly typed array, concrete even within `jit`. Other values, such as
    integers and rows of numbers, are returned unchanged."""
    if isinstance(value, jax.Array):
        return value.astype(value.dtype) if value.weak_type else value
    if isinstance(value, float | np.floating) or (
        isinstance(value, np.ndarray) and not value.ndim and value.dtype.kind == "f"
    ):
        with jax.ensure_compile_time_eval():
            return from_host(np.asarray(value, *_type_of(value)))
    return value


def real(name: str) -> Callable[[Any], jax.Array]:
    """Return the converter of a field that holds real numbers."""
    return partial(number, name)


def optional_real(name: str) -> Callable[[Any], jax.Array | None]:
    """Return the converter of a field that holds real numbers or `None`."""
    return lambda value: None if value is None else number(name, value)


def real_or_law(name: str) -> Callable[[Any], Any]:
    """Return the converter of a field that holds a real number, or a function that returns one."""
    return lambda value: value if callable(value) else number(name, value)


def _floating(name: str, array: jax.Array) -> jax.Array:
    if not _is_real(array.dtype):
        raise TypeError(
            f"Argument `{name}` must be a real number, but its dtype is {array.dtype.name}."
        )
    if narrow(array):
        warn_of_narrow(f"Argument `{name}` is")
    elif jnp.issubdtype(array.dtype, jnp.floating):
        return array
    return array.astype(jnp.result_type(float))


def narrow(value: object) -> bool:
    """Return whether a value holds floating-point numbers below the session's precision."""
    return _bits(value) < 0


def _bits(value: Any) -> int:
    """Return how many bits a floating-point JAX array is wider than the session's numbers."""
    if not (eqx.is_inexact_array(value) and jnp.issubdtype(value.dtype, jnp.floating)):
        return 0
    return jnp.finfo(value.dtype).bits - jnp.finfo(jnp.result_type(float)).bits


def require_session(name: str, tree: object) -> None:
    """Raise a `TypeError` for JAX arrays of double precision in a session of single precision. JAX
    does not define operations on them there."""
    wide = [part for part, x in named_leaves(tree) if _bits(x) > 0]
    if wide:
        raise TypeError(
            f"Argument `{name}` must be of single precision, as this session is, but has numbers "
            f"of double precision ({', '.join(wide)}), made while that was switched on. Make it "
            'again, or switch it on: `jax.config.update("jax_enable_x64", True)`.'
        )


def warn_of_narrow(what: str) -> None:
    """Warn that numbers have less than the session's precision; no conversion restores it."""
    eps = float(jnp.finfo(jnp.float32).eps)
    warn(
        f"{what} of less than double precision, known to {eps:.0e} only, in a session of double "
        "precision, to which it is promoted. Make numbers after double precision is switched on."
    )


# Within it, jitted functions of known numbers run at once, also while JAX traces another. Unlike
# `jax.ensure_compile_time_eval` it does not run each of their operations of constants as a program
# of its own: forty for two frictions, more than a second (JAX 0.10.2).
outside_of_traces = getattr(core, "eval_context", jax.ensure_compile_time_eval)


def concrete(value: object) -> np.ndarray | None:
    """Return the numbers of `value` as an array, or `None` for tracers and placeholders."""
    if not isinstance(value, jax.Array | np.ndarray | np.generic | float | int):
        return None  # a placeholder, such as a spec or a tangent `None`
    if isinstance(value, Tracer):
        return None
    return np.asarray(value)


def array_module(*values: object) -> Any:
    """Return `jax.numpy` if one of the values is a JAX array, traced or not, else `numpy`."""
    return jnp if any(isinstance(x, jax.Array) for x in values) else np


def on_host(tree: Any) -> Any:
    """Return a tree whose JAX arrays are NumPy arrays, if they are known. JAX compiles each
    operation on arrays outside of a program, which takes about 20 ms."""

    def leaf_on_host(x: Any) -> Any:
        is_known = isinstance(x, jax.Array) and not isinstance(x, Tracer)
        return np.asarray(x) if is_known else x

    return jtu.tree_map(leaf_on_host, tree)


def from_host(tree: Any) -> Any:
    """Return a tree of NumPy arrays and numbers as JAX arrays. `jnp.asarray` compiles a program for
    each shape."""
    put = lambda x: x if isinstance(x, jax.Array) else jax.device_put(np.array(x))
    return jtu.tree_map(put, tree)


def is_traced(*values: Any) -> bool:
    """Return whether a number in one of these trees is being traced."""
    return any(isinstance(x, Tracer) for x in jtu.tree_leaves(values))


def host_side(verb: Callable[P, R]) -> Callable[P, R]:
    """Decorator: raise a `TypeError` if an argument is being traced. NumPy would raise one later,
    which names no argument."""

    @wraps(verb)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        for value in (*args, *kwargs.values()):
            if is_traced(value):
                raise TypeError(
                    f"Arguments of `{verb.__name__}` must hold known numbers, but a number of the "
                    f"`{type(value).__name__}` is being traced: call `{verb.__name__}` outside of "
                    "`jit`, `vmap` and `grad`."
                )
        return verb(*args, **kwargs)

    return checked


def by_numpy_if_known(method: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Decorator: apply a method to `on_host` of its object, if all numbers are known there."""

    @wraps(method)
    def applied(self: Any) -> Any:
        leaves = jtu.tree_leaves(self)
        if any(isinstance(x, Tracer) or not eqx.is_array_like(x) for x in leaves):
            return method(self)
        if not any(isinstance(x, jax.Array) for x in leaves):
            return method(self)
        return from_host(method(on_host(self)))

    return applied
