"""`sweep`: a slow change of one parameter, with the motion carried from value to value."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._checks import concrete, count, fits_records, flag, number
from .._messages import count_of, in_parts, warning_once
from .._programs import compiled, is_outermost
from .._types import State, xr
from ..flow import (
    RESULTS,
    MethodLike,
    batch_names,
    check_noise,
    check_reals,
    check_start,
    chosen,
    in_names,
    lane_key,
    machine_of,
    present,
    simulate,
    states,
    tidy,
    with_first_history,
)
from ..machine import (
    AbstractMachine,
    Stated,
    Summarized,
    begun,
    check_again,
    check_leaf,
    convert_start,
    cycles_in_words,
    drive_speed,
    frequency_ratio,
    in_clock,
    in_unit,
    may_rest,
    name_in,
    replaced,
    stated,
    stops_of,
    unit_of,
    with_leaf,
    with_unit,
    with_units,
    without_modes,
)
from .measures import CODES, REGIMES, AbstractMeasure, Regime, Usual, flags, legends
from .program import cycles_for, lane_noise_of, measures_of, samples_for

# A change is large from this many times the changes at neighbouring values, and this share of the
# largest position, or of ζ, on: choices. It may be a jump, or a steep change in a coarse sweep.
_TIMES_USUAL, _LEAST_CHANGE = 3.0, 0.01

# The variables with one number at each value of every sweep.
COLUMNS = (
    "y_min", "y_max", "period", "impacts", "frequency_ratio", "impact_speed", "impact_energy",
)  # fmt: skip


class Sweep(Summarized):
    """The motion at each value of a sweep, in their order, in the machine's units (see
    `AbstractMachine.units`). Under `vmap` batch axes come first."""

    parameter: str = eqx.field(static=True)
    """Name of the parameter."""
    values: Float[Array, "..."]
    """Its values."""
    y_min: Float[Array, "..."]
    """Smallest position (of the first coordinate) over the observed cycles."""
    y_max: Float[Array, "..."]
    """Largest position over the observed cycles."""
    period: Int[Array, "..."]
    """Period in drive cycles, or `REGIMES.unsettled` if none was found, or `REGIMES.failed`."""
    impacts: Float[Array, "..."]
    """Impacts in a period; without a period, the mean per cycle."""
    frequency_ratio: Float[Array, "..."] | None
    """ζ: mean speed of the drive; `None` for machines that are not driven."""
    impact_speed: Float[Array, "..."]
    """Greatest V⁻ over the observed cycles."""
    impact_energy: Float[Array, "..."]
    """Mean energy lost in impacts per observed cycle (see `Run.impact_energy`)."""
    sections: State
    """Section states of the observed cycles; leaves (values, cycles)."""
    result: RESULTS
    """The end of the run at each value: `successful` or a reason."""
    averages: dict[str, Float[Array, "..."]] = eqx.field(default_factory=dict)
    """The machine's own averages over the time of the observed cycles, by name (see
    `AbstractMachine.averages`)."""
    measured: dict[str, Float[Array, "..."]] = eqx.field(default_factory=dict)
    """The numbers of the argument `measure`, by name."""
    labels: tuple[str, str] = eqx.field(static=True, kw_only=True)
    """The machine's labels of position and velocity in pictures."""
    periods: tuple[str, ...] = eqx.field(static=True, kw_only=True)
    """The machine's names of the periods of 1, 2, ... cycles."""
    units: Stated = eqx.field(static=True, kw_only=True)
    """The units that the machine states."""

    @property
    def successful(self) -> Bool[Array, "..."]:
        """True at the values that were simulated to the end."""
        return self.result == RESULTS.successful

    def to_xarray(
        self, dims: Sequence[str] | None = None, *, along: str | None = None
    ) -> "xr.Dataset":
        """Return the sweep, or a batch of them, as an `xarray.Dataset` over its values, a
        coordinate with the parameter's name. Section states are a variable for each component
        (`section_Y`), and `result` is the reason's name. `dims` and `along` are as in
        `Run.to_xarray`; `along` is `"value"`, or `"cycle"` (the sections)."""
        each = (*batch_names(dims, self.values.ndim - 1), "value")
        variables = present({name: getattr(self, name) for name in COLUMNS}, each)
        variables |= present(self.averages | self.measured, each)
        variables |= states("section", self.sections, (*each, "cycle"))
        variables["result"] = each, in_names(self.result)
        data = xr.Dataset(variables, {self.parameter: (each, np.asarray(self.values))})
        data["period"].attrs |= flags(CODES)
        data.attrs |= legends(data)
        by_name = {name: name for name in (*self.averages, self.parameter)}
        return tidy(with_units(data, dict(self.units), by_name), along)

    def summary(self) -> str:
        """Return the motions in the order of the values as text, with the changes between them."""
        if self.values.ndim != 1:
            good = int(jnp.sum(self.successful))
            return (
                f"Sweeps of {self.parameter}, shape {self.values.shape} with the values last; "
                f"{good} of {self.values.size} successful"
            )
        units, lines = dict(self.units), []
        places = [in_unit(f"{x:.6g}", units, self.parameter) for x in np.asarray(self.values)]
        kinds, changes = self._motions_in_words(), self._large_changes()
        for i in range(len(places)):
            same = bool(i) and kinds[i] == kinds[i - 1]
            if same and not changes[i]:
                continue
            line = f"  {'still ' if same else ''}{kinds[i]} from {places[i]}"
            if changes[i]:
                line += f", large change since {places[i - 1]}: {', '.join(changes[i])}"
            lines.append(line)
        if len(lines) > 12:
            lines = [*lines[:12], f"  {len(lines) - 12} further changes"]
        return "\n".join([f"Sweep of {self.parameter}, {len(places)} values:", *lines])

    def _motions_in_words(self) -> list[str]:
        special = {int(REGIMES.unsettled): "no period, or unsettled"}
        reasons = np.broadcast_to(in_names(self.result), self.period.shape).tolist()
        reasons = (x if x == "ended" else f"failed: {x}" for x in reasons)
        return [
            special.get(int(p))
            or (f"{self.periods[p - 1]} with {count_of(round(n), 'impact')}" if p > 0 else reason)
            for p, n, reason in zip(
                self.period.tolist(), self.impacts.tolist(), reasons, strict=True
            )
        ]

    def _large_changes(self) -> list[list[str]]:
        """Return the changes at each value that are far larger than at neighbours, if periodic."""
        name, units = name_in(self.labels[0]), dict(self.units)
        unit = unit_of(units, "frequency_ratio")
        speed = drive_speed(units)
        numbers = {
            f"min {name}": (self.y_min, unit_of(units, "position")),
            f"max {name}": (self.y_max, unit_of(units, "position")),
            speed: (self.frequency_ratio, unit),
        }
        period, reach = np.asarray(self.period), np.maximum(abs(self.y_min), abs(self.y_max))
        found: list[list[str]] = [[] for _ in period]
        for name, (x, unit) in numbers.items():
            if x is None:
                continue
            x = np.asarray(x)
            steps = np.abs(np.diff(x))
            neighbours = np.nan_to_num(np.concatenate([[0.0], steps, [0.0]]))
            usual = np.maximum(neighbours[:-2], neighbours[2:])
            size = np.abs(x) if name == speed else np.asarray(reach)
            scale = np.maximum(size[1:], size[:-1])
            is_large = (steps > _TIMES_USUAL * usual) & (steps > _LEAST_CHANGE * scale)
            is_large &= (period[1:] > 0) | (period[:-1] > 0)
            for i in np.flatnonzero(is_large) + 1:
                found[i].append(with_unit(f"{name} {x[i - 1]:.6g} → {x[i]:.6g}", unit))
        return found


# Values of one call: few, so that an interrupt loses little, but enough to outweigh a call's cost.
_AT_ONCE = 16


@warning_once
def sweep(
    machine: AbstractMachine,
    parameter: str,
    values: Any,
    *,
    start: State = None,
    settle: int = 200,
    cycles: int | None = None,
    measure: Any = (),
    method: MethodLike = None,
    clock: str | None = None,
    tolerance: float | None = None,
    max_steps: int | None = None,
    noise: Any = None,
    key: Any = None,
    progress: bool = True,
) -> Sweep:
    """Sweep one parameter slowly: run-up with rising values, close-down with falling ones.

    At each value the motion continues from its state at the previous one (the paper's continuation
    method). It stays on its branch until that ends, so sweeps up and down show hysteresis. A body
    that a moved stop has overtaken begins on that stop, with its velocity. Works under `jit` and
    `vmap` (over other parameters, starts, or values).

    **Arguments:**

    - `machine`, `parameter`: the machine and the name of the number that varies, such as
      `"drive.frequency_ratio"`.
    - `values`: its values in the order of the sweep.
    - `start`: state at the first value; by default the machine's `start()`.
    - `settle`, `cycles`: drive cycles at each value before observation, and observed (by default
      32 or as many as the measures need); static.
    - `measure`: measures as for `scan`, such as `vi.Rotation()` or `vi.ContactForces()`, that
      return one number a motion from its cycles.
    - `method`, `clock`: as for `simulate`; by default the `"standard"` preset.
    - `tolerance`: the largest difference of sections that repeat, as in `Regime`.
    - `max_steps`: the largest number of steps at each value; with more, it counts as failed.
    - `noise`, `key`: a `WhiteNoise`, by default none, and with it one JAX key; value number n has
      the key `jax.random.fold_in(key, n)`. With noise, use extremes and sections, not periods.
    - `progress`: show a bar, in a terminal or a notebook; not within `jit` or `vmap`.

    **Returns:** a `Sweep`. A value that fails is NaN; the next one continues from the value before.

    **Raises:** `ValueError` or `TypeError` for an unknown name or values that are not numbers; on
    Ctrl-C `Interrupted`, whose `partial` is the sweep so far.
    """
    machine = machine_of(machine)
    check_leaf(machine, parameter)
    measures = _measures_of_cycles(measure)
    settle, cycles = count("settle", settle), count("cycles", cycles_for(measures, cycles), least=2)
    progress = flag("progress", progress)
    values, numbers = _values(values)
    if max_steps is not None:
        max_steps = count("max_steps", max_steps, least=1)
    fits_records("cycles", values.size * cycles, 4)
    rests = numbers is None or _may_rest_between(machine, parameter, numbers)
    if start is None:
        start = with_leaf(machine, parameter, values[0]).start()
    method = chosen(machine, method)
    regime = Regime(cycles // 2, tolerance=tolerance).under(method)
    if clock is not None:
        machine = in_clock(machine, clock)
    start = _first_state(machine, parameter, values, numbers, start)
    lane_noise, first = lane_noise_of(noise, key), without_modes(start)
    if lane_noise is not None:
        check_noise(machine, first, noise)

    def step(carry, row):
        return _sweep(
            machine, parameter, row, carry, settle, cycles, method, rests, regime, measures,
            max_steps, lane_noise, first,
        )  # fmt: skip

    carry = start, jnp.uint32(0)
    if values.size <= _AT_ONCE or not is_outermost(machine, values, start, regime, lane_noise):
        return step(carry, values)[1]
    return _in_pieces(step, carry, np.asarray(values), progress)


def _measures_of_cycles(measure: Any) -> tuple[AbstractMeasure, ...]:
    measures = measures_of(measure)
    for each in measures:
        if type(each).refine is not AbstractMeasure.refine:
            raise ValueError(
                "Argument `measure` must be of measures of the observed cycles alone, but a "
                f"{type(each).__name__} needs more of each motion: use `scan`."
            )
    return measures


def _may_rest_between(machine: AbstractMachine, parameter: str, values: np.ndarray) -> bool:
    """Return whether a body may rest at the least or the greatest value, both of them checked."""
    ends = [with_leaf(machine, parameter, value) for value in {values.min(), values.max()}]
    for end in ends:
        check_again(end)
    return any(may_rest(end) for end in ends)


def _first_state(
    machine: AbstractMachine, parameter: str, values: jax.Array, numbers: np.ndarray | None,
    start: State,
) -> State:  # fmt: skip
    """Return the start of a sweep with its modes, checked at the first value."""
    start = replaced(start, convert_start(machine, without_modes(start)))
    check_reals("start", start)
    start = with_first_history(with_leaf(machine, parameter, values[0]), begun(machine, start))
    start = jtu.tree_map(lambda x: jnp.asarray(x, values.dtype), start)
    if numbers is not None:
        check_start(with_leaf(machine, parameter, numbers[0]), without_modes(start))
    return start


def _in_pieces(
    step: Callable[[Any, jax.Array], Any], carry: Any, values: np.ndarray, progress: bool
) -> Sweep:
    """Run a sweep of many values in parts, which an interrupt leaves complete. One program serves
    all parts: the last part is filled up with NaN, which ends at once."""
    size, missing = values.size, -values.size % _AT_ONCE
    rows = np.append(values, np.full(missing, np.nan)).reshape(-1, _AT_ONCE)
    pieces = ((min(_AT_ONCE, size - _AT_ONCE * i), jnp.asarray(row)) for i, row in enumerate(rows))

    def joined(_, parts: list[Sweep]) -> Sweep:
        # In NumPy: for hundreds of arrays JAX would compile a program.
        return jtu.tree_map(lambda *x: jnp.asarray(np.concatenate(x)[:size]), *parts)

    return in_parts(
        "sweep", step, carry, pieces, joined, progress=progress, unit="value", total=size
    )


def _values(values: Any) -> tuple[jax.Array, np.ndarray | None]:
    """Return values as an array, also in NumPy if known. **Raises:** `ValueError` for others."""
    values = number("values", values).astype(jnp.result_type(float))
    numbers = concrete(values)
    finite = numbers is None or bool(np.isfinite(numbers).all())
    if values.ndim != 1 or not values.size or not finite:
        infinite = values.ndim == 1 and values.size
        raise ValueError(
            "Argument `values` must be finite numbers in one row, but has shape "
            f"{values.shape}{' and numbers that are not finite' if infinite else ''}."
        )
    return values, numbers


def moved_by_stops(machine: AbstractMachine, state: State) -> State:
    """Return the state with each body that a stop has overtaken moved onto that stop. It keeps its
    velocity, with which it flies on, hits the stop at once, or rests on it."""
    new = without_modes(state)
    for stop in stops_of(machine):
        body = machine.coordinates[stop.coordinate]
        Y = body.position(new)
        beyond = stop.beyond(Y) > 0
        moved = body.placed(new, stop.place, body.velocity(new))
        new = jtu.tree_map(lambda a, b, c=beyond: jnp.where(c, a, b), moved, new)
    return replaced(state, new)


@compiled
def _sweep(
    machine, parameter, values, start, settle, cycles, method, rests, regime, measures,
    max_steps, lane_noise, first,
) -> tuple[tuple[State, Array], Sweep]:  # fmt: skip
    """Return the state after the last value and the next index, and the results at each; `start` is
    such a pair, as with noise each value has its own path; `first`, the state at the very first."""

    def run_value(carry, value):
        (state, number), current, noise = carry, with_leaf(machine, parameter, value), {}
        if lane_noise is not None:
            noise = {"noise": lane_noise.noise, "key": lane_key(lane_noise.key, number)}
        state = moved_by_stops(current, state)
        run = simulate(
            current, state, cycles, settle=settle, method=method, rests=rests, max_steps=max_steps,
            samples=samples_for(measures), impact_log=max((m.listed for m in measures), default=0),
            **noise,
        )  # fmt: skip
        state = jtu.tree_map(lambda a, b: jnp.where(run.successful, a, b), run.last, state)
        assert run.duration is not None and run.impact_energy is not None
        found = Usual("extremes")(current, run) | regime.begun(first)(current, run)
        measured = {name: x for each in measures for name, x in each(current, run).items()}
        rows = [repr(name) for name, x in measured.items() if jnp.ndim(x)]
        if rows:
            raise ValueError(
                "Argument `measure` must be of one number a motion, but arrays are "
                f"{', '.join(rows)}: use `scan`."
            )
        return (state, number + jnp.uint32(1)), Sweep(
            parameter=parameter,
            values=value,
            y_min=found["y_min"],
            y_max=found["y_max"],
            period=found["period"].astype(jnp.int32),
            impacts=jnp.where(run.successful, found["impacts"], jnp.nan),
            frequency_ratio=frequency_ratio(current, jnp.mean(run.duration)),
            impact_speed=found["impact_speed"],
            impact_energy=jnp.mean(run.impact_energy),
            sections=jtu.tree_map(lambda x: x[1:], run.sections),
            result=run.result,
            averages=run.mean_averages(),
            measured=measured,
            labels=machine.labels,
            units=stated(machine),
            periods=tuple(cycles_in_words(machine, n) for n in range(1, cycles // 2 + 1)),
        )

    return jax.lax.scan(run_value, start, values)
