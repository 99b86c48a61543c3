"""Types that signatures are written in, throughout the package."""

from typing import TYPE_CHECKING, Any

from jaxtyping import Array, Bool, Float

Scalar = Float[Array, ""]
"""One number of one lane."""
Flag = Bool[Array, ""]
"""One truth value of one lane."""
Scalars = tuple[Scalar, ...]
"""Several such numbers, as one for each mode or for each coordinate."""
Vector = Float[Array, " _"]
"""A state as one row of numbers."""
State = Any
"""The state of a machine: a pytree of numbers (or arrays, which not every verb takes) whose
structure the machine chooses. What changes it, as its rate, has the same structure."""

if TYPE_CHECKING:
    from jax.typing import ArrayLike as Number

    from .machine import AbstractMachine as Machine
else:
    Machine = Any  # for what the module of `AbstractMachine` itself imports
    Number = Any  # what is none is refused in words of ours, not by a check of types
    """One number as a user gives it: Python's, NumPy's or JAX's, which may be traced."""
