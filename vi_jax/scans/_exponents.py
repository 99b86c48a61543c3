"""What `lyapunov` returns."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._types import State, xr
from ..flow import (
    REASON_NAMES,
    RESULTS,
    batch_names,
    in_names,
    present,
    states,
    tidy,
)
from ..machine import (
    Stated,
    Summarized,
    attributes,
    in_unit,
    number_in_words,
    with_unit,
    with_units,
)


class Lyapunov(Summarized):
    """Lyapunov exponents of a motion. Under `vmap` batch axes come first."""

    exponents: Float[Array, "... states"]
    """The spectrum, greatest first: mean growth rates in time, as the machine counts it (`unit`;
    for a `Scene` ω)."""
    per_cycle: Float[Array, "... states"]
    """The same per drive cycle (dimensionless): ln|multipliers|/n on an orbit of n cycles. Of an
    autonomous machine per usual `cycle`, at which it is observed."""
    spread: Float[Array, "..."]
    """Difference of the greatest exponent between the two halves of the run."""
    state: State
    """Section state at the end."""
    result: RESULTS
    """Whether the run was simulated to its end; if not, the numbers are NaN."""
    averages: dict[str, Float[Array, "..."]] = eqx.field(default_factory=dict)
    """The machine's own averages over the time of the cycles observed, by name."""
    units: Stated = eqx.field(static=True, default=())
    """In which units they are, as the machine states it."""
    unit: str = eqx.field(static=True, default="")
    """Of the exponents, as the machine states it; "" if it does not."""

    @property
    def successful(self) -> Bool[Array, "..."]:
        """Whether the run was simulated to its end."""
        return self.result == RESULTS.successful

    def to_xarray(
        self, dims: Sequence[str] | None = None, *, along: str | None = None
    ) -> "xr.Dataset":
        """These exponents, or a batch of them, as an `xarray.Dataset`.

        The state at the end becomes a variable for each component (`state_Y`), and `result` is the
        reason's name. Host-side: not to be traced.

        **Arguments:** names of the batch axes, by default `lane`; `along`, to keep only what is
        given along one dimension: `"exponent"`, or a batch axis.

        **Raises:** `ValueError` if these are not as many as there are batch axes, or there is no
        such dimension.
        """
        batch = batch_names(dims, self.exponents.ndim - 1)
        each = *batch, "exponent"
        variables = present({"exponents": self.exponents, "per_cycle": self.per_cycle}, each)
        variables |= states("state", self.state, batch)
        variables |= present(self.averages, batch)
        alone = {"spread": self.spread, "result": in_names(self.result, RESULTS, REASON_NAMES)}
        data = xr.Dataset(variables | present(alone, batch))
        for name in ("exponents", "spread"):
            data[name].attrs |= attributes(self.unit)
        own = {name: name for name in self.averages}
        return tidy(with_units(data, dict(self.units), own) if own else data, along)

    def summary(self) -> str:
        """The exponents; of a batch the range of the greatest."""
        if self.exponents.ndim > 1:
            lanes, good = self.spread.shape, int(jnp.sum(self.successful))
            greatest = number_in_words(self.exponents[..., 0].ravel(), self.unit)
            return f"Lyapunov exponents of lanes {lanes}, {good} successful; greatest: {greatest}"
        numbers = ", ".join(f"{x:.9g}" for x in self.exponents)
        ended = "" if bool(self.successful) else f"; ended: {RESULTS[self.result]}"
        numbers = with_unit(numbers, self.unit)
        first = f"Lyapunov exponents {numbers} (halves differ by {self.spread:.1g}){ended}"
        lines = (
            f"  mean {name}: {in_unit(f'{float(x):.6g}', dict(self.units), name)}"
            for name, x in self.averages.items()
        )
        return "\n".join([first, *lines])
