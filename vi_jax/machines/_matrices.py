"""What is checked of the matrices and the contacts of a linear machine, before any work."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from .._checks import concrete, number, tuple_of
from ..machine import RigidStop

# A matrix differs from its transpose by no more than this share of its largest number: rounding of
# one that was assembled. A choice.
_ALIKE = 1e-12


def matrix(name: str) -> Callable[[Any], jax.Array]:
    """The converter of a field that holds a matrix, or the diagonal of one."""
    return lambda value: number(name, value)


def vector(name: str) -> Callable[[Any], jax.Array | None]:
    """The converter of a field that holds a vector or `None`."""
    return lambda value: None if value is None else number(name, value)


def check_matrices(mass: Any, damping: Any, stiffness: Any) -> int:
    """The number of degrees of freedom. **Raises:** `ValueError` for matrices of other shapes, that
    are not symmetric or hold what is no number, and for a mass that is not positive definite."""
    shape = mass.shape
    if len(shape) not in (1, 2) or shape[0] != shape[-1] or not shape[0]:
        raise ValueError(
            "Argument `mass` must be a square matrix, or the diagonal of one, of one degree of "
            f"freedom at least, but has the shape {shape}."
        )
    n = shape[0]
    for name, value in (("mass", mass), ("damping", damping), ("stiffness", stiffness)):
        if value.shape not in ((n,), (n, n)):
            raise ValueError(
                f"Argument `{name}` must have the shape ({n}, {n}), or ({n},) for a diagonal "
                f"matrix, like `mass`, but has {value.shape}."
            )
        _check_numbers(name, value)
    _check_positive(mass)
    return n


def _check_numbers(name: str, value: object) -> None:
    """**Raises:** `ValueError` for a matrix that is known and not finite, or not symmetric."""
    known = concrete(value)
    if known is None:
        return
    if not np.isfinite(known).all():
        raise ValueError(
            f"Argument `{name}` must be finite, but holds {known[~np.isfinite(known)][0]}."
        )
    if known.ndim < 2:
        return
    apart = np.abs(known - known.T)
    if apart.max() > _ALIKE * np.abs(known).max():
        i, j = np.unravel_index(apart.argmax(), apart.shape)
        raise ValueError(
            f"Argument `{name}` must be symmetric, but its numbers [{i}, {j}] and [{j}, {i}] are "
            f"{known[i, j]:.9g} and {known[j, i]:.9g}."
        )


def _check_positive(mass: object) -> None:
    """**Raises:** `ValueError` for masses that are known and not positive definite."""
    known = concrete(mass)
    if known is None:
        return
    values = known if known.ndim == 1 else np.linalg.eigvalsh(known)
    if not values.min() > known.shape[0] * np.finfo(values.dtype).eps * np.abs(values).max():
        raise ValueError(
            "Argument `mass` must be positive definite, but its smallest eigenvalue is "
            f"{values.min():.3g}, its largest {values.max():.3g}."
        )


def check_vector(name: str, value: Any, n: int) -> None:
    """**Raises:** `ValueError` for a vector of another length, or that is not finite."""
    if value is None:
        return
    if value.shape != (n,):
        raise ValueError(
            f"Argument `{name}` must have the shape ({n},), one number for each degree of freedom, "
            f"but has {value.shape}."
        )
    _check_numbers(name, value)


def numbered(contacts: object) -> tuple[RigidStop, ...]:
    """Contacts with the numbers of their coordinates; those of one `at` share the first one's."""
    rows, found = [], []
    for stop in tuple_of("contacts", contacts, RigidStop):
        if not isinstance(stop, RigidStop):
            raise TypeError(f"Argument `contacts` must hold `RigidStop`s, but holds {stop!r}.")
        if stop.at is not None:
            same = [k for k, row in enumerate(rows) if _same(row, stop.at)]
            if same:
                stop = dataclasses.replace(stop, at=None, coordinate=same[0])
            else:
                stop = dataclasses.replace(stop, coordinate=len(rows))
                rows.append(stop.at)
        found.append(stop)
    return tuple(found)


def _same(a: object, b: object) -> bool:
    one, other = concrete(a), concrete(b)
    return a is b or (one is not None and other is not None and np.array_equal(one, other))


def check_contacts(contacts: tuple[RigidStop, ...], n: int) -> None:
    """**Raises:** `ValueError` for a contact without a row of n numbers, or of zeros alone."""
    rows = 0
    for i, stop in enumerate(contacts):
        if stop.at is None:
            if stop.coordinate >= rows:
                raise ValueError(
                    f"Stop {i} in argument `contacts` must name the sum of displacements that it "
                    f"limits: `RigidStop(..., at=c)` with {n} numbers."
                )
            continue
        rows += 1
        check_vector(f"contacts[{i}].at", stop.at, n)
        known = concrete(stop.at)
        if known is not None and not known.any():
            raise ValueError(f"Argument `contacts[{i}].at` must not be zero throughout.")
