"""Measures: the results of a scan for each motion. One is the period in drive cycles. For motions
without a period there are means with errors, densities and escape times."""

import abc
import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping
from enum import IntEnum
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int

from .._checks import axes_of, count, given_number, instance_of, one_of, require, tuple_of_names
from .._types import Flag, Number, State, xr
from ..flow import AbstractMethod, Run, has_quantities, row_sizes
from ..machine import (
    AbstractMachine,
    angles_in,
    components,
    frequency_ratio,
    in_rows,
    nearest_images,
    without_modes,
)
from ._lyapunov import lyapunov

# The largest difference of sections a period apart; its factor for the least period, if some period
# fits; and the largest ratio of differences of two periods that fit. Choices.
_TOLERANCE, _SLACK, _WORSE = 1e-6, 100.0, 1e4

# The least tolerance of sections: multiples of their error by the method, and of rounding: choices.
_WANDERS, _ROUNDINGS = 10.0, 64.0


class REGIMES(IntEnum):
    """Negative values of `period` for motions without a period, and of the `label` of basins for
    starts that settle on no motion."""

    chaotic = -1, "chaotic"
    unsettled = -2, "unsettled"
    failed = -3, "failed"
    transient = -4, "transiently chaotic"

    meaning: str

    def __new__(cls, code: int, meaning: str):
        self = int.__new__(cls, code)
        self._value_, self.meaning = code, meaning
        return self


CODES = {regime.name: int(regime) for regime in sorted(REGIMES)}
"""The numbers of the regimes by name, the least first."""


def flags(codes: Mapping[str, int]) -> dict[str, Any]:
    """Return attributes of a variable with the meanings of its special numbers."""
    return {"flag_values": list(codes.values()), "flag_meanings": " ".join(codes)}


def least_period(
    sections: State,
    exact: Float[Array, "rows cycles"],
    *,
    longest: int,
    tolerance: Number | None = None,
    wander: Number = 0.0,
    sizes: Any = 1.0,
    angles: np.ndarray | None = None,
) -> Int[Array, ""]:
    """Return the fewest drive cycles after which a motion repeats, its impacts and modes too, or
    `REGIMES.unsettled`.

    A motion that still spirals in may repeat better after several turns of the spiral than after
    its period. So it counts as settled if some period fits within the tolerance. The least period
    that fits within a hundred times the tolerance is returned. But a period is left out if another
    fits ten thousand times better; in a spiral none does. A period fits only if the impacts of each
    cycle and the modes agree: near a grazing, sections hardly differ.

    **Arguments:** `sections`, more than `longest`; `exact`, numbers that repeat exactly, the
    impacts of the cycle before each section and the machine's own modes there; `tolerance`,
    relative to `sizes` (`row_sizes`) + |state|, by default the larger of 1e-6 and ten times
    `wander`, the error of sections under their method; `angles`, True for angles.
    """
    states = in_rows(sections).T
    if tolerance is None:
        tolerance = jnp.maximum(_TOLERANCE, _WANDERS * jnp.asarray(wander, states.dtype))
    rows, size = jnp.concatenate([states, exact.astype(states.dtype)]), len(states)
    count = states.shape[1] - longest
    last = rows[:, longest:]
    angles = None if angles is None else np.append(angles, np.zeros(len(exact), bool))
    scale = jnp.asarray(sizes)[..., None] + jnp.abs(last[:size])

    def compared(_, p):
        before = jax.lax.dynamic_slice_in_dim(rows, longest - p, count, axis=1)
        now = last if angles is None else nearest_images(angles, last.T, before.T).T
        difference = jnp.abs(now - before)
        others = jnp.any(difference[size:] > 0)
        return _, jnp.where(others, jnp.inf, jnp.max(difference[:size] / scale))

    periods = jnp.arange(1, longest + 1, dtype=jnp.int32)
    _, difference = jax.lax.scan(compared, None, periods)
    least = jnp.min(difference)
    noise = jnp.maximum(wander, _ROUNDINGS * float(jnp.finfo(states.dtype).eps))
    most = jnp.minimum(_SLACK * tolerance, _WORSE * jnp.maximum(least, noise))
    period = jnp.min(jnp.where(difference <= most, periods, longest))
    return jnp.where(least <= tolerance, period, REGIMES.unsettled)


Numbers = dict[str, Array]
About = Mapping[str, Mapping[str, Any]]


def _dtype(run: Run) -> Any:
    return jtu.tree_leaves(run.sections)[0].dtype


class AbstractMeasure(eqx.Module):
    """A measure: a function of the observed cycles of each lane, computed before the next lanes."""

    attributes: ClassVar[About] = {}
    """Attributes of the variables by name, such as `units` and `long_name`. `dims` are the names of
    an array's axes, and `unit_of` a quantity with the same unit, which the machine states (see
    `AbstractMachine.units`)."""

    record: ClassVar[str] = "motion"
    """The required record, as in `simulate`: `"motion"`, or only `"sections"` and the numbers of
    impacts and steps."""

    def described(self, start: State) -> About:
        """Return attributes of the variables, for states like `start`."""
        return self.attributes

    @property
    def cycles(self) -> int:
        """The least number of cycles that it needs."""
        return 1

    @property
    def instants(self) -> int:
        """The number of samples in a cycle that it needs (`Run.samples`), or 0."""
        return 0

    def under(self, method: AbstractMethod) -> "AbstractMeasure":
        """Return this measure for motions computed by a method; by default itself."""
        return self

    def begun(self, start: State) -> "AbstractMeasure":
        """Return this measure for a motion that begins in `start`; by default itself."""
        return self

    @abc.abstractmethod
    def __call__(self, machine: AbstractMachine, run: Run) -> Numbers:
        """Return named numbers (or short arrays) of one lane."""

    @property
    def passes(self) -> int:
        """The largest number of calls of `refine` for a lane."""
        return 1

    def needs_refinement(self, found: Numbers, pass_number: Any = 0) -> Flag | None:
        """Return whether a lane needs `refine` at pass `pass_number`; `None` for no lane ever."""
        return None

    def refine(
        self,
        machine: AbstractMachine,
        state: State,
        method: AbstractMethod,
        found: Numbers,
        pass_number: Any = 0,
        rests: bool | None = None,
    ) -> Numbers:
        """Return further numbers, only for lanes that need them, from the state after the observed
        cycles; they replace those found. `rests` is as for `simulate`."""
        return {}


class _Kind(NamedTuple):
    """The definition of a measure with a name."""

    record: str
    attributes: About
    numbers: Callable[[AbstractMachine, Any], Numbers]


def _frequency_ratio(machine: AbstractMachine, run: Any) -> Numbers:
    ratio = frequency_ratio(machine, jnp.mean(run.duration))
    if ratio is None:
        raise ValueError("Measure `frequency_ratio` needs a machine that is driven.")
    return {"frequency_ratio": ratio}


_KINDS = {
    "extremes": _Kind(
        "motion",
        {
            "y_min": {"unit_of": "position", "long_name": "smallest position"},
            "y_max": {"unit_of": "position", "long_name": "greatest position"},
            "impact_speed": {"unit_of": "velocity", "long_name": "greatest V⁻"},
        },
        lambda machine, run: {
            "y_min": jnp.min(run.y_min),
            "y_max": jnp.max(run.y_max),
            "impact_speed": jnp.max(run.impact_speed),
        },
    ),
    "frequency_ratio": _Kind(
        "motion",
        {"frequency_ratio": {"unit_of": "frequency_ratio", "long_name": "mean speed of the drive"}},
        _frequency_ratio,
    ),
    "power": _Kind(
        "motion",
        {"power": {"unit_of": "power", "long_name": "mean impact power"}},
        lambda machine, run: {"power": jnp.sum(run.impact_energy) / jnp.sum(run.duration)},
    ),
    "impact_rate": _Kind(
        "sections",
        {"impact_rate": {"units": "1/cycle", "long_name": "impacts per drive cycle"}},
        lambda machine, run: {"impact_rate": jnp.mean(run.impacts.astype(_dtype(run)))},
    ),
    "steps": _Kind(
        "sections",
        {"steps": {"long_name": "steps tried"}, "rejected": {"long_name": "steps rejected"}},
        lambda machine, run: {"steps": run.steps, "rejected": run.rejected},
    ),
}


class Usual(AbstractMeasure):
    """Numbers of a run's cycles: extremes, mean speed of the drive, mean power of the impacts,
    impacts per cycle, steps tried and rejected."""

    name: str = eqx.field(static=True)

    @property
    def record(self):  # pyright: ignore
        return _KINDS[self.name].record

    def described(self, start):
        return _KINDS[self.name].attributes

    def __call__(self, machine, run):
        return _KINDS[self.name].numbers(machine, run)


class Average(AbstractMeasure):
    """One of the machine's own averages, over the time of the observed cycles (see
    `AbstractMachine.averages`). A name of an average may be given instead of this measure."""

    name: str = eqx.field(static=True)

    def described(self, start):
        return {self.name: {"unit_of": self.name, "long_name": f"mean {self.name}"}}

    def __call__(self, machine, run):
        found = run.mean_averages()
        if self.name not in found:
            raise ValueError(
                f"Measure `Average` must name one of the averages of a {type(machine).__name__} "
                f"({', '.join(found) or 'it has none'}), but got {self.name!r}."
            )
        return {self.name: found[self.name]}


class Sections(AbstractMeasure):
    """The section states of the last `number` cycles, a variable for each component."""

    number: int = eqx.field(static=True, default=16)
    record = "sections"

    def __check_init__(self):
        count("number", self.number, least=1)

    def described(self, start):
        return {
            name: {"unit_of": name, "long_name": f"{name} on the section", "dims": ("cycle",)}
            for name in components(start)
        }

    @property
    def cycles(self):
        return self.number

    def __call__(self, machine, run):
        return {name: x[-self.number :] for name, x in components(run.sections, 1).items()}


class Exponent(AbstractMeasure):
    """`exponent`, the greatest Lyapunov exponent, over `observed` further drive cycles."""

    observed: int = eqx.field(static=True, default=128)
    record = "sections"
    attributes: ClassVar[About] = {
        "exponent": {"unit_of": "rate", "long_name": "greatest Lyapunov exponent"}
    }

    def __check_init__(self):
        count("observed", self.observed, least=8)

    def __call__(self, machine, run):
        """Return NaN: the exponent is computed by `refine`."""
        return {"exponent": jnp.full((), jnp.nan, _dtype(run))}

    def needs_refinement(self, found, pass_number=0):
        return jnp.asarray(True)

    def refine(self, machine, state, method, found, pass_number=0, rests=None):
        spectrum = lyapunov(
            machine, state, self.observed, settle=0, number=1, method=method, rests=rests
        )
        return {"exponent": spectrum.exponents[0]}


class Regime(AbstractMeasure):
    """`period` in drive cycles and `impacts` in a period; motions without a period by kind.

    A motion has the least period p ≤ `longest` after which its sections repeat within `tolerance`,
    with as many impacts in each cycle. The tolerance is relative to the size of each component,
    which is 1 for the paper's scenes; by default it is 1e-6, or ten tolerances of a method with
    adaptive steps. See `least_period` for a motion that still spirals in. Other motions are
    observed for another `observed` cycles. Unless its greatest Lyapunov exponent exceeds
    `threshold` there (in the machine's unit of rates), a motion is unsettled or quasi-periodic. If
    it does, the motion is continued for `lasting` cycles and observed once more. It is chaotic if
    its exponent exceeds `threshold` again. Otherwise it is transiently chaotic: it has settled
    meanwhile, or is about to. `REGIMES` has the numbers for these kinds in `period`.

    A chaotic transient looks like chaos while it lasts, so a motion called chaotic may still settle
    later. A longer `lasting` makes this rarer and chaotic lanes costlier; 0 omits the second pass.
    """

    longest: int = eqx.field(static=True, default=64)
    observed: int = eqx.field(static=True, default=256)
    tolerance: float | None = eqx.field(default=None)
    threshold: Any = eqx.field(default=2e-3)
    lasting: int = eqx.field(static=True, default=4000)
    wander: Any = eqx.field(default=0.0, kw_only=True)
    """The error of sections under the method; set by a scan."""
    start: Any = eqx.field(default=(), kw_only=True)
    """The initial state of each lane, from which its size follows; set by a scan."""
    record = "sections"
    attributes: ClassVar[About] = {
        "period": {"units": "cycles", "long_name": "least period", **flags(CODES)},
        "impacts": {
            "units": "1",
            "long_name": "impacts in a period (per cycle, on average, where there is none)",
        },
    }

    def __check_init__(self):
        count("longest", self.longest, least=1)
        count("observed", self.observed, least=8)
        if self.tolerance is not None:
            require("tolerance", self.tolerance, low=0.0, open_low=True)
        require("threshold", self.threshold)
        count("lasting", self.lasting)

    def under(self, method):
        """Return this measure with the error of sections under this method."""
        return dataclasses.replace(self, wander=method.wander)

    def begun(self, start):
        return dataclasses.replace(self, start=without_modes(start))

    @property
    def cycles(self):
        """Twice the longest period, so that each repeats."""
        return 2 * self.longest

    @property
    def passes(self):
        """A pass for motions that do not repeat, and one for chaotic ones."""
        return 2 if self.lasting else 1

    def __call__(self, machine, run):
        """Return period and impacts of one lane, without a check of chaos."""
        sections = jtu.tree_map(lambda x: x[1:], run.sections)
        first = jtu.tree_map(lambda x: x[0], run.sections)
        begin = self.start if jtu.tree_leaves(self.start) else first
        exact = jnp.stack([run.impacts, *(x[1:] for x in run.modes)])
        period = least_period(
            sections, exact, longest=self.longest, tolerance=self.tolerance,
            wander=self.wander, sizes=row_sizes(machine, begin, in_rows(sections)),
            angles=angles_in(machine, first),
        )  # fmt: skip
        impacts = run.impacts.astype(_dtype(run))
        last = jnp.arange(impacts.size) >= impacts.size - period
        total = jnp.sum(jnp.where(last, impacts, 0.0))
        return {
            "period": jnp.where(run.successful, period, REGIMES.failed).astype(jnp.int16),
            "impacts": jnp.where(period > 0, total, jnp.mean(impacts)),
        }

    def needs_refinement(self, found, pass_number=0):
        """Return whether it does not repeat; at the second pass, whether it is chaotic."""
        return found["period"] == jnp.where(
            jnp.asarray(pass_number) == 0, REGIMES.unsettled, REGIMES.chaotic
        )

    def refine(self, machine, state, method, found, pass_number=0, rests=None):
        """Return whether it is chaotic, or at the second pass still chaotic."""
        settle = pass_number * (self.observed + self.lasting)
        spectrum = lyapunov(
            machine, state, self.observed, settle=settle, number=1, method=method, rests=rests
        )
        chaotic = spectrum.exponents[0] > self.threshold
        # A lane that cannot be continued is unchanged.
        continued, before = spectrum.successful & (pass_number > 0), found["period"]
        otherwise = jnp.where(continued, REGIMES.transient, before)
        return {"period": jnp.where(chaotic, REGIMES.chaotic, otherwise).astype(before.dtype)}


# Results of a run for each cycle, not for an instant.
_COLUMNS = (
    "impacts", "y_min", "y_max", "impact_speed", "impact_energy", "rests", "duration",
    "frequency_ratio",
)  # fmt: skip

# Columns that the loop has when a cycle ends.
_OF_CYCLE = _COLUMNS[:5]

Of = str | Callable[..., Any]


class _Observed(AbstractMeasure):
    """A measure of one quantity on sections, at sampled instants or cycle by cycle."""

    of: eqx.AbstractVar[Any]
    samples: eqx.AbstractVar[int]

    @property
    def record(self):  # pyright: ignore
        """The required record: sections are enough for states and impacts."""
        of_states = self.samples or isinstance(self.of, tuple)
        return "sections" if of_states or self.of == "impacts" else "motion"

    @property
    def instants(self):
        return self.samples

    def row(self, machine: AbstractMachine, run: Run, name: Of) -> tuple[Array, Array]:
        """Return the quantity at all instants, and at those after the first; or in all cycles,
        twice. **Raises:** `ValueError` for an unknown name."""
        if not isinstance(name, str):
            found = jnp.asarray(name(machine, run))
            if found.ndim != 1:
                raise ValueError(
                    f"Argument `of` must be a function of machine and run that returns one row, "
                    f"but returned shape {found.shape}."
                )
            return found, found
        states, quantities = run.sections, run.quantities
        if self.samples:
            assert run.samples is not None
            states, quantities = run.samples.state, run.samples.quantities
        found = {**components(states, 1), **quantities}.get(name)
        if found is not None:
            return found, found[1:]
        columns = {} if self.samples else {n: getattr(run, n) for n in _COLUMNS} | run.averages
        found = columns.get(name)
        if found is None:
            names = [*components(run.sections, 1), *run.quantities]
            names += [n for n, x in columns.items() if x is not None]
            raise ValueError(f"Argument `of` must be one of {', '.join(names)}, but got {name!r}.")
        found = found.astype(jnp.result_type(float))
        return found, found


def _check_of(name: object) -> None:
    if not callable(name):
        instance_of("of", name, str, "the name of a quantity, or a function of machine and run")


def _name_of(of: Of) -> str:
    return of if isinstance(of, str) else of.__name__


class Statistics(_Observed):
    """Mean and spread of a quantity over the observed cycles, each with its standard error.

    For `"V"` they are `V_mean`, `V_error`, `V_spread` (the standard deviation) and
    `V_spread_error`. Neighbouring cycles are not independent. The errors are therefore those of
    means over `batches` parts of the row (batch means). They are right if a part is long compared
    with the memory of the motion, else too small. The scatter of the means of lanes with other
    paths is an error without this condition.

    **Arguments:**

    - `of`: a component of the state (`"V"`) or a quantity of the machine, on sections; for each
      cycle `"impacts"`, `"y_min"`, `"y_max"`, `"impact_speed"`, `"impact_energy"`, `"rests"`,
      `"duration"`, or one of the machine's averages; or a function of a lane's machine and `Run`
      that returns one row; its name is used.
    - `batches`: parts of the row, at least 2; static.
    - `samples`: instants in a cycle at which the state is evaluated, instead of sections; static.

    **Raises:** `TypeError` or `ValueError` for arguments of other kinds.
    """

    of: Of = eqx.field(static=True)
    batches: int = eqx.field(static=True, default=16)
    samples: int = eqx.field(static=True, default=0, kw_only=True)

    def __check_init__(self):
        _check_of(self.of)
        count("batches", self.batches, least=2)
        count("samples", self.samples)

    @property
    def cycles(self):
        return self.batches

    def described(self, start):
        name = _name_of(self.of)
        words = {
            "mean": f"mean of {name}", "error": f"standard error of the mean of {name}",
            "spread": f"standard deviation of {name}",
            "spread_error": f"standard error of the standard deviation of {name}",
        }  # fmt: skip
        return {f"{name}_{k}": {"unit_of": name, "long_name": x} for k, x in words.items()}

    def __call__(self, machine, run):
        _, row = self.row(machine, run, self.of)
        if row.size < self.batches:
            raise ValueError(
                f"Argument `batches` must be at most the {row.size} values of `of`, but is "
                f"{self.batches}."
            )
        mean = jnp.mean(row)
        square = (row - mean) ** 2
        spread = jnp.sqrt(jnp.mean(square))
        # The error of the variance gives that of its root, by 1/(2 spread).
        halved = 2 * jnp.where(spread > 0, spread, 1.0)
        numbers = {
            "mean": mean,
            "error": self._error(row),
            "spread": spread,
            "spread_error": self._error(square) / halved,
        }
        return {f"{_name_of(self.of)}_{k}": x for k, x in numbers.items()}

    def _error(self, row: Float[Array, " instants"]) -> Float[Array, ""]:
        """Return the standard error of a row's mean, from its end that has equal parts."""
        length = row.size // self.batches
        parts = row[row.size - length * self.batches :].reshape(self.batches, length)
        return jnp.std(jnp.mean(parts, axis=1), ddof=1) / self.batches**0.5


class Density(_Observed):
    """Probability density of one or two components of the state: `density` by bins, and `outside`,
    the share of instants outside of all bins.

    The density times the size of a bin is the share of the instants in it, relative to all
    instants, also those outside. The bins' edges are attributes of `density`, by the component's
    name. The scatter of lanes with their own paths gives its error.

    **Arguments:**

    - `of`: the edges of the bins in rising order by the name of the component, as in
      `{"Y": jnp.linspace(-2, 2, 41)}`; with two names it is the joint density.
    - `samples`: the number of evenly spaced instants in a cycle; 0 for sections only; static.

    **Raises:** `TypeError` or `ValueError` for edges that do not rise, and for more than two names.
    """

    of: tuple[str, ...] = eqx.field(static=True)
    edges: tuple[Array, ...]
    samples: int = eqx.field(static=True, default=0, kw_only=True)

    def __init__(self, of: Mapping[str, Any], *, samples: int = 0):
        edges = axes_of(of, "of")
        if len(edges) > 2:
            raise ValueError(f"Argument `of` must have one name or two, but has {len(edges)}.")
        for name, row in edges.items():
            if row.size < 2 or not np.all(np.diff(row) > 0):
                raise ValueError(
                    f"Argument `of` must have at least two edges for {name!r}, in rising order, "
                    f"but got {row}."
                )
        self.of = tuple(edges)
        self.edges = tuple(jnp.asarray(x, jnp.result_type(float)) for x in edges.values())
        self.samples = count("samples", samples)

    def described(self, start):
        rows = zip(self.of, self.edges, strict=True)
        edges = {f"{name}_edges": np.asarray(x).tolist() for name, x in rows}
        words = " and ".join(self.of)
        return {
            "density": {
                "long_name": f"probability density of {words}",
                "dims": tuple(f"{name}_bin" for name in self.of),
                **edges,
            },
            "outside": {"long_name": "share of the instants outside of all bins", "units": "1"},
        }

    def __call__(self, machine, run):
        rows = [self.row(machine, run, name)[1] for name in self.of]
        sizes = [edges.size - 1 for edges in self.edges]
        cell, inside, area = jnp.zeros_like(rows[0], dtype=int), True, jnp.ones(())
        for row, edges, size in zip(rows, self.edges, sizes, strict=True):
            bin_number = jnp.searchsorted(edges, row, side="right") - 1
            # The last bin includes its upper edge, on which a body may rest.
            bin_number = jnp.where(row == edges[-1], size - 1, bin_number)
            inside = inside & (bin_number >= 0) & (bin_number < size)
            cell = cell * size + jnp.clip(bin_number, 0, size - 1)
            area = area[..., None] * jnp.diff(edges)
        shares = jnp.where(inside, 1.0, 0.0) / rows[0].size
        flat = jnp.zeros(int(np.prod(sizes))).at[cell].add(shares)
        return {"density": flat.reshape(sizes) / area, "outside": 1.0 - jnp.sum(shares)}


class Escape(_Observed):
    """The first time at which a quantity leaves an interval: `escape_cycle`, counted in cycles from
    the beginning of the observation, and `escaped`, 1 or 0.

    For a lane without escape, `escape_cycle` is the observed time: its escape time is censored,
    known to be longer. Means of `escape_cycle` alone are too small; see `escape_rate`. A lane that
    lies outside at the beginning has 0. A passage is detected at the observed instants only. If the
    motion may return between them, use `"y_min"` and `"y_max"` of each cycle, which are exact.

    **Arguments:**

    - `of`: as for `Statistics`; a result for a cycle counts at the cycle's end.
    - `low`, `high`: ends of the interval; by default infinite.
    - `samples`: instants in a cycle at which the state is evaluated, instead of sections; static.

    **Raises:** `TypeError` or `ValueError` for arguments of other kinds, or an interval that is
    empty or without ends.
    """

    of: Of = eqx.field(static=True)
    low: Any = -jnp.inf
    high: Any = jnp.inf
    samples: int = eqx.field(static=True, default=0, kw_only=True)

    def __check_init__(self):
        _check_of(self.of)
        for name in ("low", "high"):
            if not np.isinf(getattr(self, name)):
                given_number(name, getattr(self, name))
        if not self.low < self.high or (np.isinf(self.low) and np.isinf(self.high)):
            raise ValueError(
                "Arguments `low` and `high` must be the ends of an interval, one of them finite, "
                f"but got {self.low} and {self.high}."
            )
        count("samples", self.samples)

    def described(self, start):
        words, step = "cycles until it escapes, or of observation", 1.0 / max(1, self.samples)
        return {
            "escape_cycle": {"units": "cycle", "long_name": words, "step": step},
            "escaped": {"units": "1", "long_name": "whether it escapes"},
        }

    def leaves(self, machine: AbstractMachine, state: State, record: Any, first: Any) -> Any:
        """Return whether a lane has left at a record point (the `first` begins the recording), so
        that the loop may end; `None` if this needs the whole record."""
        parts, name = components(state), self.of
        if not isinstance(name, str) or has_quantities(machine):
            return None
        if name in parts:
            return self._outside(parts[name])
        if self.samples or name not in _OF_CYCLE:
            return None
        value = getattr(record, name)
        return None if value is None else self._outside(value) & ~first

    def _outside(self, value: Any) -> Any:
        return (value < self.low) | (value > self.high)

    def __call__(self, machine, run):
        row, later = self.row(machine, run, self.of)
        # Results for cycles begin at the end of the first cycle.
        row = row if row.size > later.size else jnp.concatenate([jnp.zeros(1) + jnp.nan, row])
        outside = self._outside(row)
        escaped = jnp.any(outside)
        first = jnp.where(escaped, jnp.argmax(outside), row.size - 1)
        step = jnp.asarray(1.0 / max(1, self.samples), jnp.result_type(float))
        return {"escape_cycle": first * step, "escaped": escaped.astype(jnp.int8)}


def escape_rate(
    data: "xr.Dataset",
    over: str | Iterable[str] | None = None,
    *,
    after: Any = 0.0,
    confidence: Any = 0.95,
) -> "xr.Dataset":
    """Estimate the rate at which lanes escape, per cycle, with its confidence interval.

    The rate is the number of escapes over the observed time of all lanes, also of those without
    escape (maximum likelihood for escapes at a constant rate). Its interval is that of a Poisson
    number (Garwood 1936), with a lower end of 0 without escapes. Escapes are observed at instants,
    `step` apart; the estimate allows for their time between two. Host-side: not to be traced.

    **Arguments:**

    - `data`: the result of `scan` with the measure `Escape`.
    - `over`: the dimensions over which lanes are combined; by default all.
    - `after`: cycles that are left out, with the lanes that escape in them, since the rate is
      constant only after transients. Compare the results of two values.
    - `confidence` of the interval.

    **Returns:** an `xarray.Dataset` over the other dimensions: `rate`, `rate_low` and `rate_high`
    (1/cycle), `escapes`, `censored` (lanes that did not escape) and `cycles` (time of all lanes).

    **Raises:** `ValueError` or `TypeError` for data without escapes or dimensions they do not have.
    """
    from scipy.stats import chi2

    after = given_number("after", after, low=0.0)
    require("confidence", confidence, low=0.0, high=1.0, open_low=True, open_high=True)
    if not {"escape_cycle", "escaped"} <= set(getattr(data, "data_vars", ())):
        raise ValueError(
            "Argument `data` must be from `scan` with the measure `Escape`, but has no "
            "`escape_cycle` and `escaped`."
        )
    time = data["escape_cycle"]
    dims = [str(name) for name in time.dims]
    names = tuple_of_names("over", dims if over is None else over)
    for name in names:
        one_of("over", name, tuple(dims))
    step = float(time.attrs.get("step", 1.0))
    observed = time > after  # false for failed lanes, which are NaN
    escaped = observed & (data["escaped"] == 1)
    escapes = escaped.sum(names)
    observations = ((time - after) / step).where(observed, 0.0).sum(names)
    tail = 0.5 * (1.0 - confidence)

    def rate(number: Any) -> Any:
        """Return the rate for a number of escapes, which share the lanes left at each instant."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return -np.log1p(-np.minimum(number / observations, 1.0)) / step

    low = xr.apply_ufunc(lambda n: np.where(n > 0, 0.5 * chi2.ppf(tail, 2 * n), 0.0), escapes)
    high = xr.apply_ufunc(lambda n: 0.5 * chi2.ppf(1 - tail, 2 * n + 2), escapes)
    found = xr.Dataset(
        {
            "rate": rate(escapes),
            "rate_low": rate(low),
            "rate_high": rate(high),
            "escapes": escapes,
            "censored": (observed & ~escaped).sum(names),
            "cycles": observations * step,
        }
    )
    for name in ("rate", "rate_low", "rate_high"):
        found[name].attrs["units"] = "1/cycle"
    found["cycles"].attrs["units"] = "cycle"
    found.attrs["confidence"] = float(confidence)
    return found


MEASURES: Mapping[str, Callable[[], AbstractMeasure]] = {
    "extremes": functools.partial(Usual, "extremes"),  # the most common first
    "regime": Regime,
    "sections": Sections,
    "exponent": Exponent,
    **{name: functools.partial(Usual, name) for name in _KINDS if name != "extremes"},
}
