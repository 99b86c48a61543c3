"""`sweep`: a parameter changed little by little, the motion carried from value to value."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._checks import count, fits_records, require
from .._interrupted import Interrupted
from .._numbers import concrete, number
from .._programs import compiled, is_outermost
from .._renamed import renamed
from .._types import State
from ..flow import (
    REASON_NAMES,
    RESULTS,
    MethodLike,
    batch_names,
    check_reals,
    check_start,
    chosen,
    in_names,
    machine_of,
    present,
    refuse_arrays,
    simulate,
    states,
    tidy,
)
from ..machine import (
    PLAIN,
    AbstractMachine,
    Stated,
    Summarized,
    check_again,
    check_leaf,
    name_in,
    stated,
    unit_of,
    with_leaf,
    with_unit,
    with_units,
)
from ..orbit import impacts_in_words
from .regime import CODES, REGIMES, flags, impacts_of, least_period

# A jump is so many times the change at the values beside it, and this part of 1 + |number|:
# choices.
_JUMP, _NOTED = 3.0, 0.01

# What is a number at each value of every sweep.
COLUMNS = "y_min", "y_max", "period", "impacts", "frequency_ratio", "impact_speed"

# Values of one call: few, so that an interrupt loses little, but more than a call costs.
_AT_ONCE = 16


class Sweep(Summarized):
    """What a sweep settled on at each value, in their order, in the machine's units (see
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

    def to_xarray(self, dims: Sequence[str] | None = None, *, along: str | None = None) -> Any:
        """This sweep, or a batch of them, as an `xarray.Dataset` over its values.

        The values are the coordinate that has the parameter's name, section states a variable for
        each component (`section_Y`), and `result` is the reason's name. Not to be traced.

        **Arguments:** names of the batch axes, by default `lane`; `along`, to keep only what is
        given along one dimension: `"value"`, or `"cycle"` (the sections).

        **Raises:** `ValueError` if these are not as many as there are batch axes, or there is no
        such dimension.
        """
        import xarray as xr  # slow to load

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
            or f"{periods.get(int(p), f'{2 * int(p)}π')} with {impacts_in_words(round(float(n)))}"
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


@renamed(scene="machine")
def sweep(
    machine: AbstractMachine,
    parameter: str,
    values: Any,
    *,
    start: State = None,
    settle: int = 200,
    cycles: int = 32,
    method: MethodLike = None,
    clock: str | None = None,
    tolerance: float | None = None,
    max_steps: int | None = None,
) -> Sweep:
    """Quasi-static sweep: run-up with rising values, close-down with falling ones.

    At each value the motion goes on from where it was at the one before (what the paper calls the
    continuation method), so that it keeps to its branch until that ends: up and down show
    hysteresis. Clean under `jit` and `vmap` (over other parameters, starts, or values).

    **Arguments:**

    - `machine`, `parameter`: the machine and the name of the number that is changed, such as
      `"drive.frequency_ratio"`.
    - `values`: its values in the order of the sweep.
    - `start`: state at the first value; by default at rest (a motor at its no-load speed).
    - `settle`, `cycles`: drive cycles at each value before observing, and observed; static.
    - `method`, `clock`: as for `simulate`; by default the `"standard"` preset.
    - `tolerance`: how closely sections must repeat for a period, as in `Regime`.
    - `max_steps`: steps at each value beyond which it counts as failed.

    **Returns:** a `Sweep`. A value that fails is NaN, and the next goes on from the one before it.

    **Raises:** `ValueError` or `TypeError` for an unknown name or values that are no numbers; on
    Ctrl-C `Interrupted`, whose `partial` is the sweep so far.
    """
    machine = machine_of(machine)
    check_leaf(machine, parameter)
    settle, cycles = count("settle", settle), count("cycles", cycles, least=2)
    values = number("values", values).astype(jnp.result_type(float))
    numbers = concrete(values)
    if max_steps is not None:
        max_steps = count("max_steps", max_steps, least=1)
    fits_records("cycles", values.size * cycles, 4)
    if tolerance is not None:
        require("tolerance", tolerance, low=0.0, open_low=True)
    if values.ndim != 1 or not values.size or not _finite(numbers):
        infinite = values.ndim == 1 and values.size
        raise ValueError(
            "Argument `values` must be finite numbers in one row, but has shape "
            f"{values.shape}{' and numbers that are not finite' if infinite else ''}."
        )
    rests = True
    if numbers is not None:
        ends = [with_leaf(machine, parameter, value) for value in {numbers.min(), numbers.max()}]
        for end in ends:
            check_again(end)
        rests = any(end.may_rest() for end in ends)
    if start is None:
        start = with_leaf(machine, parameter, values[0]).start()
    method = chosen(machine, method)
    if clock is not None:
        machine = machine.in_clock(clock)
    start = machine.adopt(start)
    refuse_arrays("start", "sweep", start)
    check_reals("start", start)
    start = jtu.tree_map(lambda x: jnp.asarray(x, values.dtype), start)
    if numbers is not None:
        check_start(with_leaf(machine, parameter, numbers[0]), start)
    options = (settle, cycles, method, rests, tolerance, max_steps)
    if not is_outermost(machine, values, start, tolerance):
        return _sweep(machine, parameter, values, start, *options)[1]
    return _in_parts(machine, parameter, values, start, *options)


def _in_parts(machine, parameter, values, start, *options) -> Sweep:
    """Some values at a time, all by one program, so that an interrupt loses few of them.

    **Arguments:** as `_sweep`.
    """
    if values.size <= _AT_ONCE:
        return _sweep(machine, parameter, values, start, *options)[1]
    missing = -values.size % _AT_ONCE  # filled up by what ends at once
    rows = np.append(np.asarray(values), np.full(missing, np.nan)).reshape(-1, _AT_ONCE)
    parts: list[Sweep] = []
    try:
        for row in rows:
            start, part = _sweep(machine, parameter, jnp.asarray(row), start, *options)
            parts.append(jax.block_until_ready(part))
    except KeyboardInterrupt:
        if not parts:
            raise
        raise Interrupted("sweep", _row(parts, values.size)) from None
    return _row(parts, values.size)


def _row(parts: list[Sweep], size: int) -> Sweep:
    """The first values of all parts, put together by NumPy: hundreds of them would be a program."""
    return jtu.tree_map(lambda *x: jnp.asarray(np.concatenate(x)[:size]), *parts)


def _finite(numbers: np.ndarray | None) -> bool:
    return numbers is None or bool(np.isfinite(numbers).all())


def taken_along(machine: AbstractMachine, state: State) -> State:
    """The state, the body taken along by a stop that has come nearer."""
    for stop in machine.stops:
        body = machine.coordinates[stop.coordinate]
        Y = body.position(state)
        beyond = stop.beyond(Y) > 0
        moved = body.placed(state, stop.place, jnp.zeros_like(Y))
        state = jtu.tree_map(lambda a, b, c=beyond: jnp.where(c, a, b), moved, state)
    return state


@compiled
def _sweep(
    machine, parameter, values, start, settle, cycles, method, rests, tolerance, max_steps
) -> tuple[State, Sweep]:
    """The state after the last value, and what was found at each.

    **Arguments:** as `sweep`, all of them checked.
    """

    def one(state, value):
        here = with_leaf(machine, parameter, value)
        state = taken_along(here, state)
        run = simulate(
            here, state, cycles, settle=settle, method=method, rests=rests, max_steps=max_steps
        )
        sections = jtu.tree_map(lambda x: x[1:], run.sections)
        state = jtu.tree_map(lambda a, b: jnp.where(run.successful, a, b), run.last, state)
        assert run.y_min is not None and run.y_max is not None
        assert run.impact_speed is not None and run.duration is not None
        period = least_period(
            sections, run.impacts, longest=cycles // 2, tolerance=tolerance, wander=method.wander
        )
        impacts = impacts_of(run.impacts.astype(value.dtype), period)
        return state, Sweep(
            parameter=parameter,
            values=value,
            y_min=jnp.min(run.y_min),
            y_max=jnp.max(run.y_max),
            period=jnp.where(run.successful, period, REGIMES.failed),
            impacts=jnp.where(run.successful, impacts, jnp.nan),
            frequency_ratio=here.frequency_ratio(jnp.mean(run.duration)),
            impact_speed=jnp.max(run.impact_speed),
            sections=sections,
            result=run.result,
            averages=run.mean_averages(),
            labels=machine.labels,
            units=stated(machine),
            periods=tuple(machine.period_of(n) for n in range(1, cycles // 2 + 1)),
        )

    return jax.lax.scan(one, start, values)
