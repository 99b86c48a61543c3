"""Measures: the results of a scan for each motion, such as its period in drive cycles. Those of
chosen quantities are in `statistics.py`."""

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
from jaxtyping import Array, Int, Num

from .._checks import count, require
from .._types import Flag, Number, State
from ..flow import AbstractMethod, Run, row_sizes
from ..machine import (
    AbstractMachine,
    Shown,
    angles_in,
    components,
    frequency_ratio,
    in_rows,
    nearest_images,
    without_modes,
)
from ..orbit import QUASIPERIODIC, WANDERS, agreement, checked_rotation_number, without_angles
from ._lyapunov import lyapunov, observe_growth

# The largest difference of sections a period apart; its factor for the least period, if some period
# fits; and the largest ratio of differences of two periods that fit. Choices.
_TOLERANCE, _SLACK, _WORSE = 1e-6, 100.0, 1e4

# The least tolerance of sections: `WANDERS` times their error by the method, with so many roundings
# at least. A choice.
_ROUNDINGS = 64.0


# A motion is quasi-periodic if averages agree to more than `QUASIPERIODIC` digits and the logarithm
# of the growth of a perturbation over 2,048 cycles is below the first number. Locked lanes had 1
# and more, tori up to 0.01. A motion is chaotic with fewer digits than the second number and more
# growth than the third. Chaotic lanes had 8 and more, and those of a machine without losses up to
# 3: the weighted mean of the rate 1/t of a shear is 2.2. See the page of limits for other lanes.
_NEUTRAL, _FEW, _GROWS = 0.1, 3.5, 6.0


class REGIMES(IntEnum):
    """Negative values of `period` for motions without a period, and of the `label` of basins for
    starts that settle on no motion."""

    chaotic = -1, "chaotic"
    unsettled = -2, "unsettled"
    failed = -3, "failed"
    transient = -4, "transiently chaotic"
    quasiperiodic = -5, "quasi-periodic"

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


def legends(data: Any) -> dict[str, str]:
    """Return attributes of a data set with these meanings, as prints of it show no others."""
    found = {}
    for name, x in data.data_vars.items():
        codes = zip(
            x.attrs.get("flag_values", ()), x.attrs.get("flag_meanings", "").split(), strict=True
        )
        words = [f"{value} {meaning}" for value, meaning in sorted(codes, key=lambda c: abs(c[0]))]
        found |= {f"{name}_codes": ", ".join(words)} if words else {}
    return found


def least_period(
    sections: State,
    exact: Num[Array, "rows cycles"],
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
    `wander`, the error of sections under their method, or rounding; `angles`, True for angles.
    """
    states = in_rows(sections).T
    noise = _noise(wander, states.dtype)
    tolerance = jnp.maximum(_TOLERANCE, WANDERS * noise) if tolerance is None else tolerance
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
    most = jnp.minimum(_SLACK * tolerance, _WORSE * jnp.maximum(least, noise))
    period = jnp.min(jnp.where(difference <= most, periods, longest))
    return jnp.where(least <= tolerance, period, REGIMES.unsettled)


def _noise(wander: Number, dtype: Any) -> Array:
    """Return the error of sections by their method (`wander`) and by rounding."""
    return jnp.maximum(jnp.asarray(wander, dtype), _ROUNDINGS * float(jnp.finfo(dtype).eps))


Numbers = dict[str, Array]
About = Mapping[str, Mapping[str, Any]]


def _dtype(run: Run) -> Any:
    return jtu.tree_leaves(run.sections)[0].dtype


class AbstractMeasure(Shown):
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

    @property
    def listed(self) -> int:
        """The number of impacts in a cycle that it needs one by one (`Run.impact_log`), or 0."""
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
    """`exponent`, the greatest Lyapunov exponent per unit of time, over `observed` further drive
    cycles."""

    observed: int = eqx.field(static=True, default=128)
    record = "sections"
    attributes: ClassVar[About] = {
        "exponent": {
            "unit_of": "rate",
            "long_name": "greatest Lyapunov exponent",
            "comment": "per unit of time",
        }
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


class Rotation(AbstractMeasure):
    """`rotation`, the rotation number of a quasi-periodic motion, in turns per cycle; and `digits`,
    to which averages over both halves of the observed cycles agree.

    The averages are of each component on the section and its square, with weights that vanish at
    both ends. Over 1,024 cycles they agree to five digits and more on most quasi-periodic motions
    and to less than four on chaotic ones; the error of the rotation number is then some 1e-9. The
    number is that of turns around the mean of the sections, from 0 to 1/2, as ρ and 1 - ρ are the
    same curve. It is NaN for a fixed point, and where averages agree to less than 3.5 digits, as on
    chaotic motions. It is NaN also if for some q ≤ 12 every q-th section does not turn q times as
    far, to 0.02: on several closed curves that the sections visit in turn, as beyond a
    Neimark–Sacker point of a motion of period q; on a curve that does not wind once around its
    mean; and sometimes close to a resonance. `find_torus` with the number of `cycles` gives the
    rotation number of several curves. A motion that slowly settles on a periodic one has many
    digits: `Regime` examines its exponent too. Components that stand still, to the accuracy of the
    method, do not count.

    **Arguments:** `cycles`, the number of observed cycles; static.
    """

    cycles: int = eqx.field(static=True, default=1024)  # pyright: ignore
    wander: Any = eqx.field(default=0.0, kw_only=True)
    """The error of sections under the method; set by a scan."""
    record = "sections"
    attributes: ClassVar[About] = {
        "rotation": {
            "units": "turn/cycle",
            "long_name": "rotation number",
            "comment": f"NaN for a fixed point, with less than {_FEW} digits, or on several curves",
        },
        "digits": {"units": "1", "long_name": "digits to which averages of both halves agree"},
    }

    def __check_init__(self):
        count("cycles", self.cycles, least=16)

    def under(self, method):
        """Return this measure with the error of sections under this method."""
        return dataclasses.replace(self, wander=method.wander)

    def __call__(self, machine, run):
        first = jtu.tree_map(lambda x: x[0], run.sections)
        rows = in_rows(run.sections)[-self.cycles :]
        sizes = row_sizes(machine, first, rows)
        rows = without_angles(rows, sizes, angles_in(machine, first))
        digits = agreement(rows, self.wander)
        turns = checked_rotation_number(rows, self.wander)
        return {"rotation": jnp.where(digits < _FEW, jnp.nan, turns), "digits": digits}


class Regime(AbstractMeasure):
    """`period` in drive cycles and `impacts` in a period; motions without a period by kind.

    A motion has the least period p ≤ `longest` after which its sections repeat within `tolerance`,
    with as many impacts in each cycle. The tolerance is relative to the size of each component,
    which is 1 for the paper's scenes; by default it is 1e-6, or ten tolerances of a method with
    adaptive steps (8e-5 in single precision). See `least_period` for a motion that still spirals
    in. Other motions are observed for another `observed` cycles. If the greatest Lyapunov exponent
    exceeds `threshold` there (in the machine's unit of rates), the motion goes on for `lasting`
    cycles and is observed once more. It is chaotic if its exponent exceeds `threshold` again.
    Otherwise it is transiently chaotic: it has settled meanwhile, or is about to. `REGIMES` has the
    numbers for these kinds in `period`.

    The others are observed for another `averaged` cycles. They are quasi-periodic if averages over
    both halves agree to many digits (see `Rotation`), the exponent is zero to the accuracy of that
    time, and no section is the first one again; chaotic with few digits and a positive exponent;
    else unsettled, such as a motion with a period above `longest`. Quasi-periodic motions close to
    a resonance, or with more than two frequencies, and those of machines without losses are mostly
    called unsettled.

    A chaotic transient looks like chaos while it lasts, so a motion called chaotic may still settle
    later. A longer `lasting` makes this rarer and chaotic lanes costlier; 0 omits the second pass,
    and an `averaged` of 0 the last.
    """

    longest: int = eqx.field(static=True, default=64)
    observed: int = eqx.field(static=True, default=256)
    tolerance: float | None = eqx.field(default=None)
    threshold: Any = eqx.field(default=2e-3)
    lasting: int = eqx.field(static=True, default=4000)
    averaged: int = eqx.field(static=True, default=2048)
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
        if self.averaged:
            count("averaged", self.averaged, least=256)

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
        """A pass for motions that do not repeat, one for chaotic ones and one for others."""
        return 1 + bool(self.lasting) + bool(self.averaged)

    def _is_last(self, pass_number) -> Flag:
        return jnp.asarray(pass_number) == (self.passes - 1 if self.averaged else -1)

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
        is_outer = (jnp.asarray(pass_number) == 0) | self._is_last(pass_number)
        return found["period"] == jnp.where(is_outer, REGIMES.unsettled, REGIMES.chaotic)

    def refine(self, machine, state, method, found, pass_number=0, rests=None):
        """Return whether it is chaotic, at the second pass still chaotic; at the last one whether
        it is quasi-periodic."""
        before = jnp.asarray(found["period"])
        is_last, again = self._is_last(pass_number), jnp.asarray(pass_number) > 0
        observed = jnp.where(is_last, self.averaged // 4 * 4, self.observed)
        settle = jnp.where(again & ~is_last, self.observed + self.lasting, 0)
        seen = observe_growth(
            machine, state, observed, settle=settle, method=method, rests=rests, wander=self.wander
        )
        # A lane that cannot be continued is unchanged.
        otherwise = jnp.where(seen.successful & again, REGIMES.transient, before)
        chaos = jnp.where(seen.exponent > self.threshold, REGIMES.chaotic, otherwise)
        growth = seen.per_cycle * observed
        # Over few cycles the exponent of a torus may be as large: the last pass decides.
        is_weak = bool(self.averaged) & (chaos == REGIMES.chaotic) & (growth < _GROWS)
        chaos = jnp.where(is_weak, REGIMES.unsettled, chaos)
        # A motion without losses that repeats after many cycles has digits and no growth, too.
        noise = _noise(self.wander, seen.nearest.dtype)
        moves_on = seen.nearest > jnp.maximum(_TOLERANCE, WANDERS * noise)
        is_neutral = (seen.digits > QUASIPERIODIC) & (jnp.abs(growth) < _NEUTRAL)
        is_torus = seen.successful & is_neutral & moves_on
        torus = jnp.where(is_torus, REGIMES.quasiperiodic, before)
        is_chaos = seen.successful & (seen.digits < _FEW) & (growth > _GROWS)
        torus = jnp.where(is_chaos, REGIMES.chaotic, torus)
        return {"period": jnp.where(is_last, torus, chaos).astype(before.dtype)}


# Results of a run for each cycle, not for an instant.
COLUMNS = (
    "impacts", "y_min", "y_max", "impact_speed", "impact_energy", "rests", "reduced",
    "duration", "frequency_ratio",
)  # fmt: skip


MEASURES: Mapping[str, Callable[[], AbstractMeasure]] = {
    "extremes": functools.partial(Usual, "extremes"),  # the most common first
    "regime": Regime,
    "rotation": Rotation,
    "sections": Sections,
    "exponent": Exponent,
    **{name: functools.partial(Usual, name) for name in _KINDS if name != "extremes"},
}
