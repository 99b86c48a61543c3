"""Types that every room uses."""

from jaxtyping import Array, Bool, Float

Scalar = Float[Array, ""]
"""One number of one lane."""
Flag = Bool[Array, ""]
"""One truth value of one lane."""
Vector = Float[Array, " _"]
"""A state as one row of numbers."""
