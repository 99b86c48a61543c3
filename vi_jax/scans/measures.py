"""Measures: what a scan keeps of each motion, its period in drive cycles among it."""

import abc
import dataclasses
import functools
from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int

from .._checks import count, require
from .._types import Flag, Scalar, State
from ..flow import AbstractMethod, Run, row_sizes
from ..machine import (
    AbstractMachine,
    angles_in,
    bare,
    by_default,
    components,
    frequency_ratio,
    in_rows,
    nearest_images,
)
from ._lyapunov import lyapunov

Number = Scalar | float

# How far sections a period apart may differ; so many times that, if a longer period fits within it;
# and so many times what the longer one differs by. Choices.
_TOLERANCE, _SLACK, _WORSE = 1e-6, 100.0, 1e4

# The least that sections are held to: so many times what they wander by, and so many roundings.
# Choices.
_WANDERS, _ROUNDINGS = 10.0, 64.0


class REGIMES(IntEnum):
    """Negative values of `period` for motions without one, and of the `label` of basins for starts
    that settle on no motion."""

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
    """Attributes of a variable that say what its special numbers mean."""
    return {"flag_values": list(codes.values()), "flag_meanings": " ".join(codes)}


def least_period(
    sections: State,
    impacts: Int[Array, " cycles"],
    *,
    longest: int,
    tolerance: Number | None = None,
    wander: Number = 0.0,
    sizes: Any = 1.0,
    angles: np.ndarray | None = None,
) -> Int[Array, ""]:
    """The fewest drive cycles after which a motion repeats, its impacts too, or
    `REGIMES.unsettled`.

    A motion that still spirals in may repeat better after several turns of the spiral than after
    its period. So it counts as settled if some period fits within the tolerance, and of the periods
    that fit within a hundred times the tolerance the least is taken; but none that fits ten
    thousand times worse than another, for no spiral does so. A period fits only if as many impacts
    come in each cycle: beside a grazing these tell apart what sections hardly do.

    **Arguments:** `sections`, more than `longest` of them; the `impacts` of the cycle that ends at
    each; `tolerance`, relative to `sizes` (`row_sizes`) + |state|, by default 1e-6 or, if that is
    more, ten times what they `wander` by under their method; which of their numbers are `angles`.
    """
    states = in_rows(sections).T
    if tolerance is None:
        tolerance = jnp.maximum(_TOLERANCE, _WANDERS * jnp.asarray(wander, states.dtype))
    rows = jnp.concatenate([states, impacts[None].astype(states.dtype)])
    count = states.shape[1] - longest
    last = rows[:, longest:]
    angles = None if angles is None else np.append(angles, False)
    scale = jnp.asarray(sizes)[..., None] + jnp.abs(last[:-1])

    def compared(_, p):
        before = jax.lax.dynamic_slice_in_dim(rows, longest - p, count, axis=1)
        now = last if angles is None else nearest_images(angles, last.T, before.T).T
        apart = jnp.abs(now - before)
        return _, jnp.where(jnp.any(apart[-1] > 0), jnp.inf, jnp.max(apart[:-1] / scale))

    periods = jnp.arange(1, longest + 1, dtype=jnp.int32)
    _, apart = jax.lax.scan(compared, None, periods)
    least = jnp.min(apart)
    noise = jnp.maximum(wander, _ROUNDINGS * float(jnp.finfo(states.dtype).eps))
    most = jnp.minimum(_SLACK * tolerance, _WORSE * jnp.maximum(least, noise))
    period = jnp.min(jnp.where(apart <= most, periods, longest))
    return jnp.where(least <= tolerance, period, REGIMES.unsettled)


def impacts_of(impacts: Float[Array, " cycles"], period: Int[Array, ""]) -> Scalar:
    """Impacts in a period of a motion; in a cycle, on average, where it has none."""
    last = jnp.arange(impacts.size) >= impacts.size - period
    total = jnp.sum(jnp.where(last, impacts, 0.0))
    return jnp.where(period > 0, total, jnp.mean(impacts))


Numbers = dict[str, Array]
About = Mapping[str, Mapping[str, Any]]


def _dtype(run: Run) -> Any:
    return jtu.tree_leaves(run.sections)[0].dtype


class AbstractMeasure(eqx.Module):
    """A measure: a function of the observed cycles of each lane, computed before the next lanes."""

    attributes: ClassVar[About] = {}
    """Attributes of the variables by name, such as `units` and `long_name`; `dims` names the axes
    of one that is an array, and `unit_of` a quantity in whose unit a variable is, which the machine
    states (see `AbstractMachine.units`)."""

    record: ClassVar[str] = "motion"
    """The record that it needs, as in `simulate`: `"motion"`, or only `"sections"` and the numbers
    of impacts and steps."""

    def described(self, start: State) -> About:
        """Attributes of the variables, for states like `start`."""
        return self.attributes

    @property
    def cycles(self) -> int:
        """The least number of cycles that it needs."""
        return 1

    @property
    def instants(self) -> int:
        """The samples in a cycle that it needs (`Run.samples`); 0 for none."""
        return 0

    def under(self, method: AbstractMethod) -> "AbstractMeasure":
        """This measure for motions computed by a method; by default itself."""
        return self

    def begun(self, start: State) -> "AbstractMeasure":
        """This measure for a motion that begins in `start`; by default itself."""
        return self

    @abc.abstractmethod
    def __call__(self, machine: AbstractMachine, run: Run) -> Numbers:
        """Named numbers (or short arrays) of one lane."""

    @property
    def passes(self) -> int:
        """How often a lane may need `refine` at most."""
        return 1

    def needs_refinement(self, found: Numbers, pass_number: Any = 0) -> Flag | None:
        """Whether a lane needs `refine`, at pass number `pass_number`; `None` if none ever does."""
        return None

    @by_default
    def refine(
        self,
        machine: AbstractMachine,
        state: State,
        method: AbstractMethod,
        found: Numbers,
        pass_number: Any = 0,
        rests: bool | None = None,
    ) -> Numbers:
        """Costlier numbers, only for lanes that need them, from the state after the cycles
        observed; they replace those found. `rests` is as for `simulate`."""
        return {}


class _Kind(NamedTuple):
    """What a measure is that scans know by its name."""

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
    """Numbers that a run has of its cycles: extremes, mean speed of the drive, mean power of the
    impacts, impacts in a cycle, steps tried and rejected."""

    name: str = eqx.field(static=True)

    @property
    def record(self):  # pyright: ignore
        return _KINDS[self.name].record

    def described(self, start):
        return _KINDS[self.name].attributes

    def __call__(self, machine, run):
        return _KINDS[self.name].numbers(machine, run)


class Average(AbstractMeasure):
    """One of the machine's own averages, over the time of the cycles observed (see
    `AbstractMachine.averages`). Every verb that takes names of measures takes its name alone."""

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
    """The section states of the last `number` cycles, one variable for each part of the state."""

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
        """NaN: the exponent is found by `refine`."""
        return {"exponent": jnp.full((), jnp.nan, _dtype(run))}

    def needs_refinement(self, found, pass_number=0):
        return jnp.asarray(True)

    def refine(self, machine, state, method, found, pass_number=0, rests=None):
        found_out = lyapunov(
            machine, state, self.observed, settle=0, number=1, method=method, rests=rests
        )
        return {"exponent": found_out.exponents[0]}


class Regime(AbstractMeasure):
    """`period` in drive cycles and `impacts` in a period; motions without a period by kind.

    A motion has the least period p ≤ `longest` after which its sections repeat within `tolerance`
    (relative to the size of each number of the state, which is 1 for the paper's scenes; by default
    1e-6, or ten tolerances of a method that sizes its steps by one) with as many impacts in each
    cycle; see `least_period` for one that still spirals in. Other motions are observed for another
    `observed` cycles. Unless its greatest Lyapunov exponent exceeds `threshold` there (in the
    machine's own unit of rates), a motion is unsettled or quasi-periodic. If it does, the motion is
    continued for `lasting` cycles and observed once more: it is chaotic if its exponent exceeds
    `threshold` again, else transiently chaotic: it has settled meanwhile, or is about to. `REGIMES`
    has the numbers that stand for these in `period`.

    A chaotic transient looks like chaos while it lasts, so a motion called chaotic may still settle
    later. A longer `lasting` makes this rarer and chaotic lanes more expensive; 0 leaves the second
    pass out.
    """

    longest: int = eqx.field(static=True, default=64)
    observed: int = eqx.field(static=True, default=256)
    tolerance: float | None = eqx.field(default=None)
    threshold: Any = eqx.field(default=2e-3)
    lasting: int = eqx.field(static=True, default=4000)
    wander: Any = eqx.field(default=0.0, kw_only=True)
    """What sections wander by under the method; a scan puts its own method's here."""
    start: Any = eqx.field(default=(), kw_only=True)
    """Where the motion begins, by which its size is judged; a scan puts each lane's here."""
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
        """This measure, for sections that differ by as much as they do under this method."""
        return dataclasses.replace(self, wander=method.wander)

    def begun(self, start):
        return dataclasses.replace(self, start=bare(start))

    @property
    def cycles(self):
        """Twice the longest period, so that each is seen to repeat."""
        return 2 * self.longest

    @property
    def passes(self):
        """One at what does not repeat, and one at what is chaotic."""
        return 2 if self.lasting else 1

    def __call__(self, machine, run):
        """Period and impacts of one lane; whether it is chaotic is left to `refine`."""
        sections = jtu.tree_map(lambda x: x[1:], run.sections)
        first = jtu.tree_map(lambda x: x[0], run.sections)
        begin = self.start if jtu.tree_leaves(self.start) else first
        period = least_period(
            sections, run.impacts, longest=self.longest, tolerance=self.tolerance,
            wander=self.wander, sizes=row_sizes(machine, begin, in_rows(sections)),
            angles=angles_in(machine, first),
        )  # fmt: skip
        return {
            "period": jnp.where(run.successful, period, REGIMES.failed).astype(jnp.int16),
            "impacts": impacts_of(run.impacts.astype(_dtype(run)), period),
        }

    def needs_refinement(self, found, pass_number=0):
        """True if it does not repeat; at the second pass, if it is chaotic."""
        return found["period"] == jnp.where(
            jnp.asarray(pass_number) == 0, REGIMES.unsettled, REGIMES.chaotic
        )

    def refine(self, machine, state, method, found, pass_number=0, rests=None):
        """Chaotic or not; at the second pass, still or not."""
        settle = pass_number * (self.observed + self.lasting)
        out = lyapunov(
            machine, state, self.observed, settle=settle, number=1, method=method, rests=rests
        )
        chaotic = out.exponents[0] > self.threshold
        # What cannot be continued is left as it was.
        went_on, before = out.successful & (pass_number > 0), found["period"]
        otherwise = jnp.where(went_on, REGIMES.transient, before)
        return {"period": jnp.where(chaotic, REGIMES.chaotic, otherwise).astype(before.dtype)}


MEASURES: Mapping[str, Callable[[], AbstractMeasure]] = {
    "extremes": functools.partial(Usual, "extremes"),  # first what most users ask for
    "regime": Regime,
    "sections": Sections,
    "exponent": Exponent,
    **{name: functools.partial(Usual, name) for name in _KINDS if name != "extremes"},
}
