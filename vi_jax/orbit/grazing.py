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

from .._checks import count, flag, host_side, instance_of
from .._messages import at_work, count_of
from ..flow import simulate
from ..machine import Stated, Summarized, in_rows, in_unit, stated, stops_of
from .corrector import host_program, method_of_runs
from .equations import Shooting
from .flight import Event
from .forecast import (
    LONGEST,
    SCENARIOS,
    SOUGHT,
    Attractors,
    Windows,
    find_attractors,
    impacts_in,
    kick_sizes,
    local_depths,
    natural_depth,
    periods_in,
    scenario_of,
    transient_length,
    windows,
)
from .local_map import LocalGrazing, graze_at
from .results import multipliers_in_words
from .special import Point
from .tolerances import ALIKE, CORRECTED


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


@host_program
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
    of_runs = dataclasses.replace(problem, method=method_of_runs(problem, [graze.x]))
    rows, impacts, is_finite = _simulate_lanes(
        of_runs, value + offsets, smooth, problem.cycles * SOUGHT,
        transient_length(local) * problem.cycles,
    )  # fmt: skip
    displacements = rows[:, problem.cycles - 1 :: problem.cycles] - smooth[:, None]
    displacements, smooth = displacements / graze.sizes, smooth / graze.sizes
    hits = impacts.reshape(len(rows), SOUGHT, problem.cycles).sum(axis=2) - len(problem.impacts)
    size = kick_sizes(local, offsets)
    unit = np.abs(local.kicks).max()
    reach = np.abs(section.matrix @ local.kicks.T).max() / unit * size
    rounding = CORRECTED * np.abs(smooth).max()
    period = periods_in(displacements, hits, reach + rounding)
    deepest = local_depths(local, offsets) ** (2 * local.orders.min())
    # Farther off than by the sum of so many kicks a motion has left: of earlier ones in stable
    # directions, of later ones, which must bring it back, in unstable ones.
    kick_sum = max(
        np.abs(local.kicked(LONGEST, i)[1:] @ section.matrix.T).sum(axis=0).max()
        for i in range(len(local.kicks))
    )
    is_away = np.abs(displacements).max(axis=(1, 2)) > kick_sum * deepest + rounding
    is_finite = is_finite & np.isfinite(displacements).all(axis=(1, 2))
    span = np.abs(displacements).max(axis=(1, 2), initial=0.0, where=np.isfinite(displacements))
    far = np.where(is_finite & is_away, periods_in(displacements, hits, ALIKE * span), 0)
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


@host_program
def _position_of(problem: Shooting, states):
    position = lambda u: problem.machine.position(problem.unravel(u))
    return jax.vmap(position)(states.reshape(-1, problem.states)).reshape(states.shape[:-1])


def positions(graze: LocalGrazing, offsets: np.ndarray, displacements: np.ndarray) -> np.ndarray:
    """Return the first coordinate at displacements, in the sizes of the state, from the smooth
    section state, less its own."""
    smooth = graze.section.state + np.outer(offsets, graze.section.slope)
    with np.errstate(invalid="ignore", over="ignore"):  # a motion that leaves may overflow
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
            low, high = np.abs(self.machine.offset[[0, -1]])
            lines.append(
                f"  checked by the machine: in no half decade from {low:.3g} to {high:.3g} are "
                f"{100 * _AGREES:g} % of the values alike on both sides"
            )
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


@host_side
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
        "check of the grazing", lambda: unchecked,
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
    """Name the scenario from those values only at which the machine agrees."""
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
