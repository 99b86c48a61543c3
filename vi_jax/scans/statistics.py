"""Measures of chosen quantities, for motions without a period: means with errors, densities and
escape times."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import axes_of, count, given_number, instance_of, one_of, require, tuple_of_names
from .._types import State, xr
from ..flow import Run, has_quantities
from ..machine import AbstractMachine, components
from .measures import COLUMNS, AbstractMeasure

# Columns that the loop has when a cycle ends.
_OF_CYCLE = COLUMNS[:5]

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
        columns = {} if self.samples else {n: getattr(run, n) for n in COLUMNS} | run.averages
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
