"""What a sweep settled on: the motion at each value, and where one gives way to another."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._messages import so_many
from .._types import State, xr
from ..flow import REASON_NAMES, RESULTS, batch_names, in_names, present, states, tidy
from ..machine import PLAIN, Stated, Summarized, name_in, unit_of, with_unit, with_units
from .regime import CODES, REGIMES, flags

# A jump is so many times the change at the values beside it, and this part of 1 + |number|:
# choices.
_JUMP, _NOTED = 3.0, 0.01

# What is a number at each value of every sweep.
COLUMNS = "y_min", "y_max", "period", "impacts", "frequency_ratio", "impact_speed"


class Sweep(Summarized):
    """The motion at each value of a sweep, in their order, in the machine's units (see
    `AbstractMachine.units`). Under `vmap` batch axes come first."""

    parameter: str = eqx.field(static=True)
    """Name of the number that was changed."""
    values: Float[Array, "..."]
    """Its values."""
    y_min: Float[Array, "..."]
    """Smallest position (of the first coordinate) over the cycles observed."""
    y_max: Float[Array, "..."]
    """Largest position over the cycles observed."""
    period: Int[Array, "..."]
    """Period in drive cycles, or `REGIMES.unsettled` if none was found, or `REGIMES.failed`."""
    impacts: Float[Array, "..."]
    """Impacts in a period; in a cycle, on average, where there is no period."""
    frequency_ratio: Float[Array, "..."] | None
    """ζ: mean speed of the drive; `None` for machines that are not driven."""
    impact_speed: Float[Array, "..."]
    """Greatest V⁻ over the cycles observed."""
    sections: State
    """Section states of the cycles observed; leaves (values, cycles)."""
    result: RESULTS
    """Whether each value was simulated to its end."""
    averages: dict[str, Float[Array, "..."]] = eqx.field(default_factory=dict)
    """The machine's own averages over the time of the cycles observed, by name (see
    `AbstractMachine.averages`)."""
    labels: tuple[str, str] = eqx.field(static=True, default=PLAIN)
    """What pictures write beside position and velocity, in the machine's words."""
    periods: tuple[str, ...] = eqx.field(static=True, default=())
    """Names of the periods of 1, 2, ... cycles, in the machine's words."""
    units: Stated = eqx.field(static=True, default=())
    """In which units its quantities are, as the machine states it."""

    @property
    def successful(self) -> Bool[Array, "..."]:
        """Whether each value was simulated to its end."""
        return self.result == RESULTS.successful

    def to_xarray(
        self, dims: Sequence[str] | None = None, *, along: str | None = None
    ) -> "xr.Dataset":
        """This sweep, or a batch of them, as an `xarray.Dataset` over its values.

        The values are the coordinate that has the parameter's name, section states a variable for
        each component (`section_Y`), and `result` is the reason's name. Not to be traced.

        **Arguments:** names of the batch axes, by default `lane`; `along`, to keep only what is
        given along one dimension: `"value"`, or `"cycle"` (the sections).

        **Raises:** `ValueError` if these are not as many as there are batch axes, or there is no
        such dimension.
        """
        each = (*batch_names(dims, self.values.ndim - 1), "value")
        variables = present({name: getattr(self, name) for name in COLUMNS} | self.averages, each)
        variables |= states("section", self.sections, (*each, "cycle"))
        variables["result"] = each, in_names(self.result, RESULTS, REASON_NAMES)
        data = xr.Dataset(variables, {self.parameter: (each, np.asarray(self.values))})
        data["period"].attrs |= flags(CODES)
        own = {name: name for name in (*self.averages, self.parameter)}
        return tidy(with_units(data, dict(self.units), own), along)

    def drawn(self) -> Any:
        """The smallest position at each value."""
        return self.y_min if self.values.ndim == 1 else None

    def summary(self) -> str:
        """The motions in the order of the values, and where one gives way to another."""
        if self.values.ndim != 1:
            good = int(jnp.sum(self.successful))
            return (
                f"Sweeps of {self.parameter}, shape {self.values.shape} with the values last; "
                f"{good} of {self.values.size} successful"
            )
        values, lines = np.asarray(self.values), []
        kinds, jumps = self._kinds(), self._jumps()
        for i, value in enumerate(values):
            same = bool(i) and kinds[i] == kinds[i - 1]
            if same and not jumps[i]:
                continue
            line = f"  {'still ' if same else ''}{kinds[i]} from {value:.6g}"
            if jumps[i]:
                line += f", jump since {values[i - 1]:.6g}: {', '.join(jumps[i])}"
            lines.append(line)
        if len(lines) > 12:
            lines = [*lines[:12], f"  {len(lines) - 12} further changes"]
        return "\n".join([f"Sweep of {self.parameter}, {values.size} values:", *lines])

    def _kinds(self) -> list[str]:
        """The motion at each value in words: its period and its impacts."""
        names: dict[int, str] = {
            REGIMES.unsettled: "no period",
            REGIMES.failed: REGIMES.failed.meaning,
        }
        periods = dict(enumerate(self.periods, 1))
        return [
            names.get(int(p))
            or f"{periods.get(int(p), f'{2 * int(p)}π')} with {so_many(round(float(n)), 'impact')}"
            for p, n in zip(np.asarray(self.period), np.asarray(self.impacts), strict=True)
        ]

    def _jumps(self) -> list[list[str]]:
        """What changes at each value by far more than at the values beside it.

        Not looked for within motions without a period, whose extremes differ by chance.
        """
        name, units = name_in(self.labels[0]), dict(self.units)
        numbers = {
            f"min {name}": (self.y_min, unit_of(units, "position")),
            f"max {name}": (self.y_max, unit_of(units, "position")),
            "ζ": (self.frequency_ratio, unit_of(units, "frequency_ratio")),
        }
        period = np.asarray(self.period)
        found: list[list[str]] = [[] for _ in period]
        for name, (x, unit) in numbers.items():
            if x is None:
                continue
            x = np.asarray(x)
            steps = np.abs(np.diff(x))
            beside = np.nan_to_num(np.concatenate([[0.0], steps, [0.0]]))
            usual = np.maximum(beside[:-2], beside[2:])
            scale = 1 + np.maximum(np.abs(x[1:]), np.abs(x[:-1]))
            far = (steps > _JUMP * usual) & (steps > _NOTED * scale)
            far &= (period[1:] > 0) | (period[:-1] > 0)
            for i in np.flatnonzero(far) + 1:
                found[i].append(with_unit(f"{name} {x[i - 1]:.6g} → {x[i]:.6g}", unit))
        return found
