"""A structure of many degrees of freedom with rigid stops, defined by its matrices or its modes."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import (
    NOT_NEGATIVE,
    POSITIVE,
    concrete,
    number,
    optional_real,
    real,
    require,
    require_ranges,
    tuple_of,
)
from ..machine import RigidStop
from ._base import number_field
from .linear import LinearMachine

# The largest asymmetry of a matrix, relative to its largest entry, that is rounding: a choice.
_SYMMETRY = 1e-12


def _numbered(contacts: object) -> tuple[RigidStop, ...]:
    """Return contacts with the indices of their coordinates; equal `at` share the first index."""
    rows, found = [], []
    for stop in tuple_of("contacts", contacts, RigidStop):
        if stop.at is not None:
            equal = [k for k, row in enumerate(rows) if _equal_rows(row, stop.at)]
            if equal:
                stop = dataclasses.replace(stop, at=None, coordinate=equal[0])
            else:
                stop = dataclasses.replace(stop, coordinate=len(rows))
                rows.append(stop.at)
        found.append(stop)
    return tuple(found)


def _equal_rows(a: object, b: object) -> bool:
    one, other = concrete(a), concrete(b)
    return a is b or (one is not None and other is not None and np.array_equal(one, other))


class Structure(LinearMachine):
    """A structure of n degrees of freedom that is linear between its impacts on rigid stops:

        M x'' + C x' + K x = f₀ + A (f₁ cos ωs + f₂ sin ωs)

    Its state is a `StructureState` of displacements x and velocities x', n numbers each. Each stop
    limits a sum c·x, where c is its `at`. With `vi.RigidStop(0.5, 0.8, at=[0, 0, 1])` the third
    mass has a stop at 0.5; with `at=[1, -1, 0]` the first two approach each other. An impact with
    the restitution k takes x' to x' - (1 + k) (c·x') M⁻¹c/(cᵀM⁻¹c), by an impulse along c (B.
    Brogliato, Nonsmooth Mechanics, 2016). A resting coordinate stays on its stop, while the rest of
    the structure moves, until the stop would have to pull.

    Time is the independent variable, and a cycle is 2π/ω, also without a force.

    The natural modes are used, by default with `ExactFlight`, which has no step error for any
    damping, also for rigid bodies and in resonance. Derivatives with respect to all numbers exist,
    also at coincident frequencies.

    **Arguments:**

    - `mass` M, symmetric and positive definite; `damping` C (0 by default) and `stiffness` K,
      symmetric: (n, n), or (n,) for a diagonal matrix.
    - `contacts`, `vi.RigidStop`s with `at`; two with the same `at` are the two sides of a gap.
    - `force` f₁, `sine_force` f₂ and `static_force` f₀: (n,), or `None`.
    - `amplitude` A, any number; `frequency` ω, positive.

    **Raises:** `ValueError` for other numbers and shapes.
    """

    mass: jax.Array = eqx.field(kw_only=True, converter=real("mass"))
    stiffness: jax.Array = eqx.field(kw_only=True, converter=real("stiffness"))
    damping: jax.Array = eqx.field(kw_only=True, default=None, converter=optional_real("damping"))  # pyright: ignore
    contacts: tuple[RigidStop, ...] = eqx.field(kw_only=True, default=(), converter=_numbered)
    force: jax.Array | None = eqx.field(
        kw_only=True, default=None, converter=optional_real("force")
    )
    sine_force: jax.Array | None = eqx.field(
        kw_only=True, default=None, converter=optional_real("sine_force")
    )
    static_force: jax.Array | None = eqx.field(
        kw_only=True, default=None, converter=optional_real("static_force")
    )
    amplitude: Any = number_field("amplitude", 1.0)
    frequency: Any = number_field("frequency", 1.0, POSITIVE)

    def __check_init__(self):
        loss = jnp.zeros(self.mass.shape[-1:]) if self.damping is None else self.damping
        n = _check_matrices(self.mass, loss, self.stiffness)
        for name in ("force", "sine_force", "static_force"):
            if getattr(self, name) is not None:
                _check_vector(name, getattr(self, name), n)
        _check_contacts(self.contacts, n)
        require_ranges(self)

    @classmethod
    def from_modes(
        cls,
        frequencies: Any,
        damping_ratios: Any = 0.0,
        shapes: Any = None,
        *,
        contacts: Any = (),
        force: Any = None,
        sine_force: Any = None,
        static_force: Any = None,
        **others: Any,
    ) -> "Structure":
        """Return a structure from n modes, measured or of a larger model.

        Its state has modal coordinates q; the points of `shapes` are displaced by `shapes @ q`.

        **Arguments:**

        - `frequencies`, angular (n,), not negative; `damping_ratios` (n,), or one for all.
        - `shapes` (points, n) of modes of mass 1: the displacement of each point by each mode. Rows
          `at` and forces have a number for each point, or without shapes for each mode.
        - The others are those of a `Structure`.

        **Raises:** `ValueError` for other numbers and shapes.
        """
        omega, xi = number("frequencies", frequencies), number("damping_ratios", damping_ratios)
        require("frequencies", omega, **NOT_NEGATIVE._asdict())
        require("damping_ratios", xi)
        if omega.ndim != 1 or not omega.size or xi.shape not in ((), omega.shape):
            raise ValueError(
                "Arguments `frequencies` and `damping_ratios` must have the shapes (n,) and (n,) "
                f"or (), but have {omega.shape} and {xi.shape}."
            )
        forces = {"force": force, "sine_force": sine_force, "static_force": static_force}
        if shapes is not None:
            shapes = number("shapes", shapes)
            if shapes.ndim != 2 or shapes.shape[1] != omega.size or not shapes.size:
                raise ValueError(
                    f"Argument `shapes` must have the shape (points, {omega.size}), a column for "
                    f"each mode, but has {shapes.shape}."
                )
            require("shapes", shapes)
            forces = {name: _in_modes(name, f, shapes) for name, f in forces.items()}
            contacts = tuple(
                stop
                if getattr(stop, "at", None) is None
                else eqx.tree_at(lambda x: x.at, stop, _in_modes("at", stop.at, shapes))
                for stop in _numbered(contacts)
            )
        return cls(
            mass=jnp.ones_like(omega), damping=2 * xi * omega, stiffness=omega**2,
            contacts=contacts, **forces, **others,
        )  # fmt: skip

    @property
    def forces(self) -> tuple[Any, Any, Any]:
        cosine, sine = (
            None if f is None else self.amplitude * f for f in (self.force, self.sine_force)
        )
        return self.static_force, cosine, sine


def _in_modes(name: str, f: Any, shapes: Float[Array, "points n"]) -> Any:
    """Return a force or a row of points in terms of the modes."""
    if f is None:
        return None
    f = number(name, f)
    _check_vector(name, f, shapes.shape[0], "point of `shapes`")
    return f @ shapes


def _check_matrices(mass: Any, damping: Any, stiffness: Any) -> int:
    """Return the number of degrees of freedom. **Raises:** `ValueError` for matrices of other
    shapes, that are not symmetric or not finite, and for a mass that is not positive definite."""
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
    known = concrete(mass)
    if known is not None:
        values = known if known.ndim == 1 else np.linalg.eigvalsh(known)
        if not values.min() > n * np.finfo(values.dtype).eps * np.abs(values).max():
            raise ValueError(
                "Argument `mass` must be positive definite, but its smallest eigenvalue is "
                f"{values.min():.3g}, its largest {values.max():.3g}."
            )
    return n


def _check_numbers(name: str, value: object) -> None:
    """Raise `ValueError` for a known matrix that is not finite or not symmetric."""
    known = concrete(value)
    if known is None:
        return
    if not np.isfinite(known).all():
        raise ValueError(
            f"Argument `{name}` must be finite, but holds {known[~np.isfinite(known)][0]}."
        )
    if known.ndim < 2:
        return
    asymmetry = np.abs(known - known.T)
    if asymmetry.max() > _SYMMETRY * np.abs(known).max():
        i, j = np.unravel_index(asymmetry.argmax(), asymmetry.shape)
        raise ValueError(
            f"Argument `{name}` must be symmetric, but its numbers [{i}, {j}] and [{j}, {i}] are "
            f"{known[i, j]:.9g} and {known[j, i]:.9g}."
        )


def _check_vector(name: str, value: Any, n: int, each: str = "degree of freedom") -> None:
    if value.shape != (n,):
        raise ValueError(
            f"Argument `{name}` must have the shape ({n},), one number for each {each}, but has "
            f"{value.shape}."
        )
    _check_numbers(name, value)


def _check_contacts(contacts: tuple[RigidStop, ...], n: int) -> None:
    """Raise `ValueError` for a contact without a row of n numbers, or with zeros only."""
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
        _check_vector(f"contacts[{i}].at", stop.at, n)
        known = concrete(stop.at)
        if known is not None and not known.any():
            raise ValueError(f"Argument `contacts[{i}].at` must not be zero throughout.")
