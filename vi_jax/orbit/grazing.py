"""`grazing`: the attractor beyond a grazing, from its local map and from the machine itself.

The local map is iterated over decades of the parameter, and its attractor is named; the machine is
simulated at some of these values.
"""

import dataclasses
import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Complex, Float, Int

from .._checks import count, flag, instance_of
from .._messages import Interrupted, at_work, count_of
from ..flow import NamedEnumeration, simulate
from ..machine import Stated, Summarized, in_rows, in_unit, stated, stops_of
from .corrector import on_host
from .equations import Shooting
from .flight import Event
from .local_map import LocalGrazing, LocalMap, graze_at
from .results import multipliers_in_words
from .special import Point

# Longest period that is sought, and the number of iterates in which it is sought.
LONGEST, SOUGHT = 64, 192

# A motion is periodic if it repeats within this share of one kick: a choice, far above the rest of
# the transient (`_REMAINING`) and far below the differences of chaos.
_REPEATS = 1e-3

# A motion beyond so many kicks does not return: a choice.
_LOST = 1e9

# Share of the slowest transient that remains after settling; bounds of the iterates for it.
_REMAINING, _FEWEST, _MOST = 1e-7, 400, 6000

# An attractor shrinks towards the grazing if its depth is at most this multiple of a first impact's
# (in trials a chain of impacts within a small attractor reached half of it). Its test uses so many
# depths in this interval, relative to the largest relevant one. Choices.
_LOCAL, _TINY, _PROBES = 4.0, (1e-14, 1e-12), 24

# Largest share of aperiodic values for adjacent windows, and smallest share for chaos alone.
# Measured for the root map of one multiplier λ: at most 1.5 % at λ = 0.24; 2.6 % at 0.26; 6 % at
# 0.3; 36 % at 0.5; 91 % at 0.66; 96.8 % at 0.67; all above 0.7.
_FEW, _ALL = 0.02, 0.96

# Number of iterates in which the greatest entry is sought, which scales the parameter.
_ENTRIES = 24


class SCENARIOS(NamedEnumeration):
    """Scenarios beyond a grazing, on the side of the parameter on which impacts appear."""

    persistence = "the motion continues and stays stable, now with the impact"
    nonsmooth_fold = (
        "it meets an unstable motion with the impact, and both end: the next motion is far away"
    )
    period_adding = (
        "period adding: windows of motions with one impact in n periods lie next to each other, n "
        "growing towards the grazing"
    )
    period_adding_with_chaos = (
        "period adding with chaos between: windows of motions with one impact in n periods, n "
        "growing towards the grazing, and chaos between them"
    )
    chaos = "chaos at once, its size growing as the root of the parameter"
    periodic = "other periodic motions with impacts, near the old one"
    windows_and_chaos = "other periodic motions and chaos in turn, near the old one"
    jump = "no attractor is near: the next motion is far away"


class Attractors(NamedTuple):
    """Attractors of the map near the grazing, lane by lane."""

    period: np.ndarray
    """In periods of the motion that grazes; 0 if none up to `LONGEST`, -1 if it goes away."""
    impacts: np.ndarray
    """Impacts at the touches in a period; the mean over one without a period."""
    places: np.ndarray
    """States after the first touch, less the smooth motion there, in the sizes of the state;
    (lanes, SOUGHT, states)."""
    depth: np.ndarray
    """The deepest penetration √(-h), without an impact."""


def periods_in(rows: np.ndarray, hits: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the least period of each lane up to `LONGEST`, or 0. `rows` (lanes, length,
    components) must repeat to a share of a kick's `size`, `hits` (impacts per iterate) exactly."""
    found = np.zeros(len(rows), int)
    for p in range(LONGEST, 0, -1):
        differences = np.abs(rows[:, p:] - rows[:, :-p]).max(axis=(1, 2))
        same_hits = (hits[:, p:] == hits[:, :-p]).all(axis=1)
        found = np.where(same_hits & (differences <= _REPEATS * size), p, found)
    return found


def transient_length(local: LocalMap) -> int:
    """Return the number of iterates of the transient, from the slowest multiplier."""
    slowest = np.abs(np.linalg.eigvals(local.matrix)).max()
    if slowest <= 0 or slowest >= 1:
        return _FEWEST if slowest <= 0 else _MOST
    return int(np.clip(np.log(_REMAINING) / np.log(slowest), _FEWEST, _MOST))


def kick_sizes(local: LocalMap, offsets: np.ndarray) -> np.ndarray:
    """Return the largest change of a state by the first impact, at each offset of the parameter."""
    depth = np.abs(np.outer(offsets, local.slopes))
    return (depth**local.orders * np.abs(local.kicks).max(axis=1)).max(axis=1)


def find_attractors(local: LocalMap, offsets: np.ndarray) -> Attractors:
    found = _iterate(local, offsets)
    near = found.depth <= local_depths(local, offsets)
    return found._replace(period=np.where(near, found.period, -1))


def _iterate(local: LocalMap, offsets: np.ndarray) -> Attractors:
    z = np.zeros((len(offsets), local.matrices.shape[1]))
    settle = transient_length(local)
    places = np.zeros((len(offsets), SOUGHT, z.shape[1]))
    hits = np.zeros((len(offsets), SOUGHT))
    deepest, size = np.zeros(len(offsets)), kick_sizes(local, offsets)
    with np.errstate(over="ignore", invalid="ignore"):
        for n in range(settle + SOUGHT):
            i = n - settle
            for k, N in enumerate(local.matrices):
                depth = np.maximum(-(local.slopes[k] * offsets + z @ local.gradients[k]), 0.0)
                kicked = z + depth[:, None] ** local.orders[k] * local.kicks[k]
                z = kicked @ N.T
                if i >= 0:
                    hits[:, i] += depth > 0
                    deepest = np.maximum(deepest, np.sqrt(depth))
                    if k == 0:
                        places[:, i] = kicked
        period = periods_in(places, hits, size)
    is_lost = ~(np.abs(z).max(axis=1) <= _LOST * size)
    period = np.where(is_lost, -1, period)
    return Attractors(period, impacts_in(hits, period), places, deepest)


def impacts_in(hits: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Return the impacts in a period of each lane; without a period the mean in an iterate."""
    last = np.arange(hits.shape[1]) >= hits.shape[1] - period[:, None]
    return np.where(period > 0, (hits * last).sum(axis=1), hits.mean(axis=1))


def local_depths(local: LocalMap, offsets: np.ndarray) -> np.ndarray:
    """Return the greatest depth of an attractor that begins at the grazing, at each offset.

    Its depth is a multiple of that of a first impact, √ε. It is of the order of ε^(1/4) if an
    impact causes a second touch that is deeper than ε, as for some motions between two stops.
    Iterates far below all offsets decide between the two.
    """
    first = np.sqrt(np.abs(np.outer(offsets, local.slopes)).max(axis=1))
    if local.orders[0] != 0.5:
        return _LOCAL * first
    scale = np.sqrt(natural_depth(local))
    sense = -np.sign(local.slopes[0])
    tiny_offsets = sense * np.geomspace(*_TINY, _PROBES) * scale**2 / np.abs(local.slopes[0])
    shallow = np.sqrt(np.abs(np.outer(tiny_offsets, local.slopes)).max(axis=1))
    found = _iterate(local, tiny_offsets)
    if (found.depth <= _LOCAL * shallow).mean() > 0.5:
        return _LOCAL * first
    is_near = (found.depth <= _LOCAL * np.sqrt(scale * shallow)) & (found.period >= 0)
    return _LOCAL * np.sqrt(scale * first) if is_near.mean() > 0.5 else _LOCAL * first


def natural_depth(local: LocalMap) -> float:
    """Return the depth (in the distance h) at which a kick of order 1/2 changes a later distance by
    this depth. Beyond it there are no windows."""
    entries = np.abs(local.entries(_ENTRIES)) if local.orders[0] == 0.5 else np.array([np.inf])
    return float(entries.max() ** 2)


def scenario_of(local: LocalMap, offsets: np.ndarray, found: Attractors) -> tuple[str, float]:
    """Return the scenario's name in `SCENARIOS`, and the share of offsets without a period. The
    half of the offsets nearer to zero decides whether an attractor is near, and whether it is the
    motion itself. The offsets lie on the side of the impacts, evenly spaced by their logarithm."""
    is_near = found.period >= 0
    is_close = np.abs(offsets) <= np.median(np.abs(offsets))
    if is_near[is_close].mean() < 0.5:
        folds = local.orders[0] == 0.5 and len(local.kicks) == 1 and _sum_of_entries(local) < 0
        return ("nonsmooth_fold" if folds else "jump"), 0.0
    if (found.period[is_near & is_close] == 1).mean() > _ALL:
        return "persistence", 0.0
    period, impacts = found.period[is_near], found.impacts[is_near]
    aperiodic = float((period == 0).mean())
    if aperiodic > _ALL:
        return "chaos", aperiodic
    # A motion with one impact in n periods, or its period doublings.
    single = (period > 1) & (impacts > 0) & (period == impacts * (period // np.maximum(impacts, 1)))
    adding = single.sum() > 0.5 * (period > 0).sum() and _are_adjacent(
        offsets[is_near], np.where(single & (impacts == 1), period, 0)
    )
    if aperiodic < _FEW:
        return ("period_adding" if adding else "periodic"), aperiodic
    return ("period_adding_with_chaos" if adding else "windows_and_chaos"), aperiodic


def _are_adjacent(offsets: np.ndarray, period: np.ndarray) -> bool:
    """Return whether the periods of motions with one impact (0 elsewhere) grow towards the grazing,
    with some n next to n + 1. 5 and 7 without 6, as between two stops, are no period adding."""
    kinds = np.unique(period[period > 0])
    places = [np.median(np.log(np.abs(offsets[period == n]))) for n in kinds]
    return bool((np.diff(places) < 0).all() and (np.diff(kinds) == 1).any())


def _sum_of_entries(local: LocalMap) -> float:
    """Return Σ eₙ; its sign gives the side of the motion with an impact in each period."""
    N, u = local.matrix, local.kicks[0]
    return float(local.gradients[0] @ np.linalg.solve(np.eye(len(N)) - N, N @ u))


class Windows(NamedTuple):
    """Intervals of motions with one impact in n periods, n = 1, 2, …; by the local map."""

    period: np.ndarray
    """n of each row, in periods of the motion that grazes."""
    exists: np.ndarray
    """Offsets of the parameter between which it exists, the nearer first, or NaN; (n, 2)."""
    stable: np.ndarray
    """Offsets between which it is stable; (n, 2)."""


def windows(local: LocalMap, reach: float, count: int) -> Windows:
    """Return motions with one impact in n = 1 … count periods, by the root map of one touch.

    The smooth motion is a distance ε beyond the stop. The depth y of the impact solves y² + Eₙ y =
    ε with Eₙ = ∂h (I - Nⁿ)⁻¹ Nⁿ kick. At the other passages the distance must be positive. The
    matrix of the motion is Nⁿ (I - kick ∂h/2y).
    """
    N, h, kick = local.matrix, local.gradients[0], local.kicks[0]
    identity = np.eye(len(N))
    depths = np.sqrt(reach) * np.geomspace(1e-6, 1, 1200)
    existing, stable = [], []
    for n in range(1, count + 1):
        power = np.linalg.matrix_power(N, n)
        after_n = np.linalg.solve(identity - power, power @ kick)  # state after n periods, over y
        residual = depths**2 + (h @ after_n) * depths
        offset = -residual / local.slopes[0]
        passages = local.later_distances(after_n + kick, n - 1)
        exists = (-residual + passages[:, None] * depths > 0).all(axis=0)
        kick_slopes = np.einsum("y,i,j->yij", -0.5 / depths, kick, h)
        values = np.linalg.eigvals(power @ (identity + kick_slopes))
        existing.append(_interval(offset[exists]))
        stable.append(_interval(offset[exists & (np.abs(values).max(axis=1) < 1)]))
    return Windows(np.arange(1, count + 1), np.array(existing), np.array(stable))


def _interval(offset: np.ndarray) -> tuple[float, float]:
    """Return the ends of an interval, the one nearer to zero first."""
    if not offset.size:
        return np.nan, np.nan
    low, high = float(offset.min()), float(offset.max())
    return (low, high) if abs(low) <= abs(high) else (high, low)


# Differences below this share of the motion are rounding: a choice.
_ROUNDING = 1e-11

# A distant motion is periodic if it repeats within 1e-6 of its distance: a choice.
_FAR = 1e-3

# A motion on the section farther off than so many of the deepest kicks has left: a choice.
_KICKS_SUMMED = 64


class SimulatedAttractors(NamedTuple):
    period: np.ndarray
    """As `Attractors.period`; -1 also for a lane that left the neighbourhood or failed."""
    impacts: np.ndarray
    """As `Attractors.impacts`; NaN if a touch is not one of a rigid stop."""
    places: np.ndarray
    """States on the section, less the smooth motion, in the sizes of the state; (lanes, SOUGHT,
    states)."""
    far: np.ndarray
    """As `period`, for lanes that left; 0 for others."""
    hits: np.ndarray
    """All impacts in `far` periods of the motion that grazes; in one of them if `far` is 0."""


@on_host
def _simulate_lanes(problem: Shooting, values, states, cycles: int, settle: int):
    """Return sections and impacts of the last cycles, (lanes, cycles)."""

    def simulate_one(value, u):
        run = simulate(
            problem.at(value[None]), problem.unravel(u), cycles, settle=settle,
            method=problem.method, record="sections",
        )  # fmt: skip
        rows = in_rows(run.sections)
        return rows[1:], run.impacts, run.successful

    return jax.vmap(simulate_one)(values, states)


def simulate_attractors(graze: LocalGrazing, offsets: np.ndarray) -> SimulatedAttractors:
    problem, section, local = graze.problem, graze.section, graze.map
    value = float(graze.x[-1])
    smooth = section.state + np.outer(offsets, section.slope)
    rows, impacts, is_finite = _simulate_lanes(
        problem, value + offsets, smooth, problem.cycles * SOUGHT,
        transient_length(local) * problem.cycles,
    )  # fmt: skip
    displacements = rows[:, problem.cycles - 1 :: problem.cycles] - smooth[:, None]
    displacements, smooth = displacements / graze.sizes, smooth / graze.sizes
    hits = impacts.reshape(len(rows), SOUGHT, problem.cycles).sum(axis=2) - len(problem.impacts)
    size = kick_sizes(local, offsets)
    u, kick_sum = local.kicks.T, np.zeros(len(section.state))
    for _ in range(_KICKS_SUMMED):
        kick_sum += np.abs(section.matrix @ u).max(axis=1)
        u = local.matrix @ u
    unit = np.abs(local.kicks).max()
    reach = np.abs(section.matrix @ local.kicks.T).max() / unit * size
    rounding = _ROUNDING * np.abs(smooth).max()
    period = periods_in(displacements, hits, reach + rounding)
    deepest = local_depths(local, offsets) ** (2 * local.orders.min())
    is_away = np.abs(displacements).max(axis=(1, 2)) > kick_sum.max() * deepest + rounding
    is_finite = is_finite & np.isfinite(displacements).all(axis=(1, 2))
    span = np.abs(displacements).max(axis=(1, 2), initial=0.0, where=np.isfinite(displacements))
    far = np.where(is_finite & is_away, periods_in(displacements, hits, _FAR * span), 0)
    period = np.where(is_finite & ~is_away, period, -1)
    rigid = all(touch.number < len(stops_of(problem.machine)) for touch in graze.touches)
    touch_impacts = impacts_in(hits, period) if rigid else np.full(len(period), np.nan)
    total = impacts_in(hits, np.where(far > 0, far, 1)) + np.maximum(far, 1) * len(problem.impacts)
    return SimulatedAttractors(period, touch_impacts, displacements, far, total)


def agree_at(forecast: Attractors, machine: SimulatedAttractors) -> np.ndarray:
    same_impacts = np.isnan(machine.impacts) | (forecast.impacts == machine.impacts)
    return (forecast.period == machine.period) & (same_impacts | (forecast.period <= 0))


# Decades below the greatest depth that are examined: a choice.
DECADES = 4

# The machine is simulated at every 6th value, and on the other side at every 4th of these.
SIMULATE_EVERY, _SPARSE = 6, 4

# The machine agrees over a range of the parameter if it does at this share of the values in each
# half decade. The local map is of first order and does not decide at the edges of windows.
_AGREES = 0.75


class Motions(NamedTuple):
    """Attractors at several values of the parameter, of the local map or of the machine."""

    offset: Float[np.ndarray, " values"]
    """The parameter, less its value at the grazing."""
    period: Int[np.ndarray, " values"]
    """In periods of the motion that grazes; 0 without a period, -1 if the attractor is far away."""
    impacts: Float[np.ndarray, " values"]
    """Impacts at the touch in a period; the mean over one without a period."""
    position: Float[np.ndarray, "values sought"]
    """The first coordinate on the section, less that of the smooth motion."""


@on_host
def _position_of(problem: Shooting, states):
    position = lambda u: problem.machine.position(problem.unravel(u))
    return jax.vmap(position)(states.reshape(-1, problem.states)).reshape(states.shape[:-1])


def positions(graze: LocalGrazing, offsets: np.ndarray, displacements: np.ndarray) -> np.ndarray:
    """Return the first coordinate at displacements, in the sizes of the state, from the smooth
    section state, less its own."""
    smooth = graze.section.state + np.outer(offsets, graze.section.slope)
    moved = _position_of(graze.problem, smooth[:, None] + displacements * graze.sizes)
    return moved - _position_of(graze.problem, smooth)[:, None]


def compare_with_machine(
    graze: LocalGrazing, offsets: np.ndarray, found: Attractors
) -> tuple[Motions, tuple[np.ndarray, np.ndarray], tuple[int, int] | None]:
    """Return the machine's attractors at offsets with the local attractors `found`; whether they
    agree, at the offsets and at some on the other side; period and impacts far away, or `None`."""
    sparse, n = offsets[::_SPARSE], len(offsets)
    machine = simulate_attractors(graze, np.concatenate([offsets, -sparse]))
    ahead, behind = (jax.tree.map(lambda a: a[:n], machine), jax.tree.map(lambda a: a[n:], machine))
    agreement = agree_at(found, ahead), agree_at(find_attractors(graze.map, -sparse), behind)
    beyond = Motions(offsets, ahead.period, ahead.impacts, positions(graze, offsets, ahead.places))
    return beyond, agreement, _distant_attractor(ahead, graze.problem.cycles)


def _distant_attractor(attractors: SimulatedAttractors, cycles: int) -> tuple[int, int] | None:
    """Return period and impacts of the attractor of most lanes that left."""
    has_left = attractors.period < 0
    if has_left.mean() < 0.5:
        return None
    pairs = zip(attractors.far[has_left], attractors.hits[has_left], strict=True)
    kinds = [(int(p) * cycles, round(float(n)) if p else 0) for p, n in pairs]
    return max(set(kinds), key=kinds.count)


def agreeing_range(
    size: np.ndarray, ahead: np.ndarray, behind: np.ndarray
) -> tuple[tuple[float, float] | None, float]:
    """Return the longest range of rising sizes of offsets, in half decades, in which forecast and
    machine agree on both sides (`ahead`, `behind`); and the share of equal values in it."""
    parts = 2 * DECADES
    part = np.minimum((np.arange(len(size)) * parts) // (len(size) - 1), parts - 1)
    agrees = [
        ahead[part == i].mean() >= _AGREES and behind[part[::_SPARSE] == i].all()
        for i in range(parts)
    ]
    runs = (run for run in itertools.combinations(range(parts + 1), 2) if all(agrees[slice(*run)]))
    begin, end = max(runs, key=lambda run: run[1] - run[0], default=(0, 0))
    inside = (part >= begin) & (part < end)
    if not inside.any():
        return None, np.nan
    share = np.concatenate([ahead[inside], behind[inside[::_SPARSE]]]).mean()
    return (float(size[inside][0]), float(size[inside][-1])), float(share)


# The greatest depth is this share of the depth at which windows end, or of a touch that lasts the
# second share of a cycle. The third number is that of values in each decade below it. Choices.
_DEEPEST, _BRIEF, _EACH = 0.1, 0.05, 144

# The effect of an impact is lost if it changes later distances by less than this share: a choice,
# far above rounding (1e-28 for a van der Pol oscillator) and below all machines that were tried.
_VANISHES = 1e-14


class Grazing(Summarized):
    """The attractor beyond a grazing, from `grazing`. NumPy arrays in the machine's units, for m
    touches in a period (usually one) and n states."""

    parameter: str = eqx.field(static=True)
    """Name of the branch's parameter."""
    value: float
    """The parameter at the grazing."""
    touched: str = eqx.field(static=True)
    """Name of the stop or switch that is touched."""
    cycles: int = eqx.field(static=True)
    """Period of the motion that grazes, in cycles: the unit of all periods here."""
    matrix: Float[np.ndarray, "n n"]
    """N, the derivative of the motion's section map without the impact, from touch to touch at a
    fixed reading of the clock."""
    multipliers: Complex[np.ndarray, " n"]
    """Eigenvalues of N, the largest modulus first."""
    rate: Float[np.ndarray, " m"]
    """a, the second derivative of the distance to the stop by the clock, at each touch."""
    gradient: Float[np.ndarray, "m n"]
    """∂h, the derivative of that distance with respect to the state."""
    kick: Float[np.ndarray, "m n"]
    """Change of the state by an impact, over the depth to the power of `order`; -√(2a) W for a
    rigid stop, whose impact adds W·dh/ds."""
    order: Float[np.ndarray, " m"]
    """1/2 for rigid and prestressed stops, 3/2 for a spring without prestress."""
    slope: Float[np.ndarray, " m"]
    """Derivative of the least distance in the parameter, along the motion without impact."""
    entries: Float[np.ndarray, " 12"]
    """eₙ = ∂h Nⁿ kick, n = 1, 2, …: the change of the distance n periods after an impact of depth
    one. A motion with one impact in n periods needs eⱼ > 0 for 0 < j < n."""
    side: int
    """1 if impacts appear as the parameter rises, -1 if as it falls."""
    outcome: SCENARIOS
    """The scenario on that side, at the values in `checked`, or without a check at all values."""
    aperiodic: float
    """Share of these values, evenly spaced by their logarithm, without a period."""
    windows: Windows | None
    """Motions with one impact in n periods; `None` for several touches or an order ≠ 1/2."""
    forecast: Motions
    """The attractors of the local map."""
    machine: Motions | None
    """The attractors of the machine at some of these values; `None` without a check."""
    checked: tuple[float, float] | None
    """Distances from the grazing, in the parameter, between which the machine agrees with the
    forecast on both sides, except at edges of windows; `None` if nowhere, or without a check."""
    agreement: float
    """Share of the values there at which period and impacts are the same, or NaN."""
    far: tuple[int, int] | None
    """Period in cycles and number of rigid impacts of the machine's attractor, at most values, if
    no attractor is near. The period is 0 if none was found up to 64 periods of the motion that
    grazes. `None` if the machine stays near, or without a check."""
    labels: tuple[str, str] = eqx.field(static=True)
    """Labels of position and velocity in pictures, from the machine."""
    units: Stated = eqx.field(static=True)
    """The units of its quantities, from the machine."""

    def summary(self) -> str:
        """Describe the stop, the local map, its attractor, and the agreement of the machine."""
        at = in_unit(f"{self.value:.10g}", dict(self.units), self.parameter)
        values = ", ".join(multipliers_in_words(self.multipliers, 6, 1e-9))
        entries = ", ".join(f"{e:.4g}" for e in self.entries[:6])
        orders = ", ".join(f"{x:g}" for x in self.order)
        lines = [
            f"Grazing at {self.parameter} = {at}: touches the {self.touched}",
            f"  what follows: {SCENARIOS[self.outcome]}",
            *(
                []
                if self.far is None
                else [f"  far away: the machine settles on {self.distant_in_words}"]
            ),
            f"  impacts appear: as {self.parameter} {'rises' if self.side > 0 else 'falls'}",
            f"  multipliers without impact: {values}",
            f"  second derivative of the distance: {', '.join(f'{a:.6g}' for a in self.rate)}",
            f"  power of the depth: {orders}",
            f"  entries: {entries}, …",
            f"  values without a period: {100 * self.aperiodic:.3g} %",
            *self._windows_in_words(),
        ]
        if self.checked is not None:
            low, high = (f"{x:.3g}" for x in self.checked)
            lines.append(
                f"  checked by the machine: from {low} to {high} on both sides, "
                f"{100 * self.agreement:.3g} % of the values alike"
            )
        elif self.machine is not None:
            lines.append("  checked by the machine: it does not agree at these values")
        return "\n".join(lines)

    @property
    def distant_in_words(self) -> str:
        """The machine's attractor if none is near, `far` in words; "" if `None`."""
        if self.far is None:
            return ""
        period, impacts = self.far
        if not period:
            return "no short period"
        return f"a motion of {count_of(period, 'cycle')} with {count_of(impacts, 'impact')}"

    def _windows_in_words(self) -> list[str]:
        if self.windows is None:
            return []
        lines, least = [], np.abs(self.forecast.offset).min()
        for n, (near, far) in zip(self.windows.period, self.windows.stable, strict=True):
            if np.isfinite(near) and abs(far) > least:  # others are too close to distinguish
                place = in_unit(f"{near:+.3g} … {far:+.3g}", dict(self.units), self.parameter)
                each = f"{n} periods" if n > 1 else "each period"
                lines.append(f"  one impact in {each}: stable at {place} from there")
        return lines


def grazing(
    point: Point, *, check: bool = True, periods: int = 12, progress: bool = True
) -> Grazing:
    """Predict the attractor beyond a grazing of a branch from its local map.

    The motion that grazes has a smooth section map without the impact. The discontinuity mapping
    corrects a neighbour that would pass the stop (Nordmark 1991; di Bernardo, Budd, Champneys and
    Kowalczyk 2008), by the root of the depth at a rigid stop. Both are derivatives of the machine's
    functions, for rigid, soft and prestressed stops and for autonomous machines. The map is
    iterated over decades of the parameter and its attractor is named. The machine itself is
    simulated at some of these values, on both sides. Host-side: not to be traced.

    **Arguments:**

    - `point`: a special point of a branch of the kind "grazing" (`Branch.special`).
    - `check`: whether to simulate the machine for comparison, which takes most of the time.
    - `periods`: largest n of the listed motions with one impact in n periods.
    - `progress`: whether to show a bar during the simulation, in a terminal or a notebook.

    **Returns:** a `Grazing`.

    **Raises:** `TypeError` if `point` is no special point. `ValueError` if it is of another kind or
    nothing is touched; if the touched event's jump does not vanish with the speed; at a fold of the
    motion without the impact. On Ctrl-C `Interrupted`; its `partial` is the result of
    `check=False`.
    """
    instance_of("point", point, Point, "a `Point`, from `Branch.special`")
    check, periods = flag("check", check), count("periods", periods, least=1)
    progress = flag("progress", progress)
    graze = graze_at(point)
    unchecked, attractors = _forecast(graze, periods)
    if not check:
        return unchecked
    offsets = unchecked.forecast.offset[::SIMULATE_EVERY]
    with at_work(
        "grazing", lambda: Interrupted("check of the grazing", unchecked),
        progress=progress, unit="value", total=len(offsets),
    ) as report:  # fmt: skip
        subset = jax.tree.map(lambda a: a[::SIMULATE_EVERY], attractors)
        by_machine, agree, far = compare_with_machine(graze, offsets, subset)
        checked, agreement = agreeing_range(np.abs(offsets), *agree)
        report(len(offsets))
    found = dataclasses.replace(
        unchecked, machine=by_machine, checked=checked, agreement=agreement, far=far
    )
    return found if checked is None else _limit_to_checked(found, graze, attractors, checked)


def _limit_to_checked(
    found: Grazing, graze: LocalGrazing, attractors: Attractors, checked: tuple[float, float]
) -> Grazing:
    """Name the scenario from those values only at which the machine agrees: elsewhere the local map
    may have other attractors than the machine."""
    size = np.abs(found.forecast.offset)
    is_checked = (size >= checked[0]) & (size <= checked[1])
    subset = jax.tree.map(lambda a: a[is_checked], attractors)
    outcome, aperiodic = scenario_of(graze.map, found.forecast.offset[is_checked], subset)
    return dataclasses.replace(found, outcome=getattr(SCENARIOS, outcome), aperiodic=aperiodic)


def _forecast(graze: LocalGrazing, periods: int) -> tuple[Grazing, Attractors]:
    local, machine = graze.map, graze.problem.machine
    first = graze.touches[0]
    half = 0.5 * _BRIEF * float(graze.problem.period(graze.x)) / graze.problem.cycles
    root_depth, brief_depth = natural_depth(local), 0.5 * first.rate * half**2
    if root_depth < _VANISHES * brief_depth:
        raise ValueError(
            "Argument `point` must be a grazing whose impacts come back to the stop, but here what "
            "they do is forgotten within a period to first order, as of an autonomous machine with "
            "one degree of freedom, where they only shift the time."
        )
    deepest = _DEEPEST * min(root_depth, brief_depth)
    side = -1 if first.slope > 0 else 1
    offsets = side * deepest / abs(first.slope) * np.logspace(-DECADES, 0, DECADES * _EACH + 1)
    found = find_attractors(local, offsets)
    outcome, aperiodic = scenario_of(local, offsets, found)
    single = len(graze.touches) == 1 and first.kick.order == 0.5
    values = np.linalg.eigvals(local.matrix)
    names = sorted({Event(touch.number).name_on(machine) for touch in graze.touches})
    unchecked = Grazing(
        parameter=graze.problem.parameters[0],
        value=float(graze.x[-1]),
        touched=" and the ".join(names),
        cycles=graze.problem.cycles,
        matrix=local.matrix * graze.sizes[:, None] / graze.sizes,
        multipliers=values[np.argsort(-np.abs(values))].astype(complex),
        rate=np.array([t.rate for t in graze.touches]),
        gradient=np.array([t.gradient for t in graze.touches]),
        kick=np.array([t.kick.vector for t in graze.touches]),
        order=local.orders,
        slope=local.slopes,
        entries=local.entries(12),
        side=side,
        outcome=getattr(SCENARIOS, outcome),
        aperiodic=aperiodic,
        windows=windows(local, deepest, periods) if single else None,
        forecast=Motions(
            offsets, found.period, found.impacts,
            positions(graze, offsets, found.places @ graze.section.matrix.T),
        ),
        machine=None,
        checked=None,
        agreement=np.nan,
        far=None,
        labels=machine.labels,
        units=stated(machine),
    )  # fmt: skip
    return unchecked, found
