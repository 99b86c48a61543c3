"""`continue_torus`: a quasi-periodic motion followed in one parameter of its machine."""

import dataclasses
from collections.abc import Iterator
from functools import cached_property
from math import ceil, floor, gcd
from typing import NamedTuple

import numpy as np

from .._checks import count, flag, host_side, interval
from .._messages import ReportProgress, at_work
from ..machine import check_leaf, in_unit, leaf, units_of
from .find import find_orbit
from .from_orbit import check_parameter, with_parameters
from .kinds import GRAZING, TORUS
from .locate import bracketed_zero
from .results import Orbit
from .tolerances import LOCATED, ROUGHLY, SAME
from .torus import MOST, REORDERED, Torus, first_mode, margins_of, torus_of
from .torus_equations import Curve, Equations, Solved, angles_of, derivative, interpolated
from .walk import BOUNDS, INTERRUPTED, SAME_CURVE, STALLED, check_walk

# Reasons to end: at a ratio p:q, where the motion locks; the nodes do not suffice; events change
# their order.
RESONANCE, COARSE, ORDER = "resonance", "coarse", "order"

# The largest denominator q of the ratios p:q that are looked for.
_LARGEST = 12

# A step with a larger tail has reached another solution of the equations. Steps are shortened to
# this share of the longest. Choices.
_SPURIOUS, _SHORTEST = 1e-3, 1e-2

# A ratio is close ahead within so many of the longest steps. Its window is found from a torus so
# many steps back, since those close to a window move unevenly. Choices.
_REACH, _BACK = 2.0, 16

# Angles at which the motions of a window are found, within the q-th part of a turn, odd. The high
# modes of the parameter must be below `LOCATED` of its range, or this rounding. Its extrema, the
# window's ends, are sought at so many places. Choices.
_ANGLES, _ROUNDING, _BETWEEN = 33, 1e-14, 8192


@dataclasses.dataclass(frozen=True, eq=False)
class Window:
    """An interval of the parameter in which the motion locks to the ratio p:q: it repeats after q
    periods, in which it turns p times."""

    p: int
    q: int
    low: float
    """Ends of the interval, folds of the periodic motions; NaN if these were not found. A width of
    some roundings of the parameter is not resolved."""
    high: float
    equations: Equations = dataclasses.field(repr=False)
    cycle: Curve | None = dataclasses.field(repr=False)
    """The motion in the middle: a row for each of its periods."""

    @cached_property
    def orbit(self) -> Orbit:
        """A periodic motion of the window, stable if the torus is."""
        if self.cycle is None:
            raise ValueError(f"No periodic motion of the window {self.p}:{self.q} was found.")
        problem = self.equations.motion(self.cycle.p)
        state = problem.unravel(self.equations.on_section(self.cycle, np.zeros(1))[0])
        cycles = self.q * problem.cycles
        return find_orbit(problem.machine, state, cycles, method=problem.method, impact_log=16)


class _End(NamedTuple):
    reason: str
    detail: str = ""


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class TorusBranch:
    """A family of tori in one parameter, in order, from `continue_torus`.

    It ends as a `Branch` does, at a "grazing" that is located to rounding; by "order" (two events,
    or an event and the section, change their order); by "resonance" (the motion locks to a ratio
    p:q in a window that a step did not cross); by "coarse" (more nodes are needed than allowed, as
    at a loss of smoothness); or by "neimark-sacker" (the curve shrinks to a periodic motion).
    """

    name: str
    """Name of the parameter."""
    tori: list[Torus]
    ends: tuple[str, str]
    details: tuple[str, str]
    """The ends in words."""
    windows: list[Window]
    """Windows of locking with q ≤ 12 that lie between two of the tori."""
    _walked: tuple[Equations, list[Solved], int]

    @property
    def parameter(self) -> np.ndarray:
        """Value of the parameter, (points,)."""
        return np.array([float(leaf(torus.machine, self.name)) for torus in self.tori])

    @property
    def rotation(self) -> np.ndarray:
        """Rotation numbers, (points,)."""
        return np.array([torus.rotation for torus in self.tori])

    @cached_property
    def exponents(self) -> np.ndarray:
        """Lyapunov exponents per cycle, (points, exponents)."""
        return np.stack([torus.exponents for torus in self.tori])

    def at(self, value: float) -> Torus:
        """Return the torus at a value of the parameter between two of the family."""
        equations, points, most = self._walked
        parameter = self.parameter
        inside = (parameter[:-1] - value) * (parameter[1:] - value) <= 0
        if not inside.any():
            raise ValueError(
                f"Argument `value` must lie between {parameter.min():.6g} and "
                f"{parameter.max():.6g}, but is {value:.6g}."
            )
        i = int(np.argmax(inside))
        share = (value - parameter[i]) / (parameter[i + 1] - parameter[i])
        guess = points[i].curve.towards(points[i + 1].curve, share)
        solved = equations.refined(equations.solve_near(guess, value), most)
        if solved is None:
            raise ValueError(f"No torus was found at {self.name} = {value:.10g}.")
        # The nodes are doubled across the family; the last correction is at the value itself.
        return torus_of(equations.solve_near(solved.curve, value) or solved, equations)

    def __repr__(self) -> str:
        units, values = units_of(self.tori[0].machine), self.parameter
        span = in_unit(f"[{values.min():.6g}, {values.max():.6g}]", units, self.name)
        turns = self.rotation
        lines = [
            f"Branch of {len(self.tori)} tori, {self.name} in {span}, rotation number in "
            f"[{turns.min():.6g}, {turns.max():.6g}]; ends: {', '.join(self.ends)}",
            *(f"  {detail}" for detail in self.details if detail),
            *(f"  window {w.p}:{w.q}: [{w.low:.11g}, {w.high:.11g}]" for w in self.windows),
        ]
        return "\n".join(lines)


@host_side
def continue_torus(
    torus: Torus, *, parameter: str, bounds: tuple[float, float], step: float = 0.02,
    max_step: float = 0.2, max_points: int = 200, max_nodes: int = MOST, progress: bool = True,
) -> TorusBranch:  # fmt: skip
    """Follow a quasi-periodic motion in one parameter of its machine, both ways.

    Pseudo-arclength on the equations of `find_torus`; the number of nodes is doubled when the
    highest modes of the curve ask for it. The family steps across narrow windows in which the
    motion locks to a ratio p:q; those with q ≤ 12 are located. The sequence of events is
    continued beyond a grazing, which is therefore located to rounding. Host-side: not to be traced.

    **Arguments:**

    - `torus`: from `find_torus`, or from `switch` at a Neimark–Sacker point.
    - `parameter`, `bounds`: a parameter of the machine and its interval, as for `continue_orbit`.
    - `step`, `max_step`: first and longest step, in the norm of the scaled unknowns (the mean over
      the curve, with half the interval as the scale of the parameter).
    - `max_points`: maximum number of tori in each direction.
    - `max_nodes`: maximum number of nodes.
    - `progress`: whether to count the tori found, in a terminal or a notebook.

    **Returns:** a `TorusBranch`.

    **Raises:** `ValueError` for a torus that was not found, an unknown name, or bounds that do not
    contain the torus. On Ctrl-C `Interrupted`, whose `partial` is the family so far.
    """
    settings = check_walk(step=step, max_step=max_step, max_points=max_points)
    most, progress = count("max_nodes", max_nodes, least=5), flag("progress", progress)
    if not isinstance(torus, Torus) or not torus.successful:
        reason = torus.reason if isinstance(torus, Torus) else f"It is a {type(torus).__name__}."
        raise ValueError(f"Argument `torus` must be a `Torus` that was found. {reason}")
    check_leaf(torus.machine, parameter)
    bounds = interval("bounds", bounds)
    value = float(leaf(torus.machine, parameter))
    check_parameter(torus.machine, parameter, value, bounds, "torus")
    problem = with_parameters(torus.problem, torus.curve.x[0], (parameter,), [bounds])
    equations = Equations(problem)
    start = equations.solve_near(torus.curve._replace(p=np.array([value])))
    if start is None:
        raise ValueError("Argument `torus` could not be refined in this parameter.")
    back = start._replace(tangent=start.tangent.plus(-2.0, start.tangent))
    walks = [_Walk(equations, bounds, begin, most) for begin in (start, back)]

    def result() -> TorusBranch:
        ahead, back = walks
        points = [*reversed(back.points[1:]), *ahead.points]
        tori = [torus_of(point, equations) for point in points]
        return TorusBranch(
            parameter, tori, (back.end.reason, ahead.end.reason),
            (back.end.detail, ahead.end.detail), [*reversed(back.windows), *ahead.windows],
            (equations, points, most),
        )  # fmt: skip

    with at_work("walk along the tori", result, progress=progress, unit="torus") as report:
        for walk in walks:
            walk.walk(report, **settings)
    return result()


class _Walk:
    def __init__(self, equations: Equations, bounds: tuple[float, float], start: Solved, most: int):
        self.equations, self.bounds, self.most = equations, bounds, most
        self.points, self.windows, self.end = [start], [], _End(INTERRUPTED)

    def walk(
        self, report: ReportProgress, *, step: float, max_step: float, max_points: int
    ) -> None:
        length, end = step, None
        while end is None and len(self.points) < max_points:
            new = self._advance(length)
            if new == TORUS:
                end = _End(TORUS, "the curve shrinks to a periodic motion")
            elif isinstance(new, str):
                length *= 0.4
                end = self._stalled(max_step, new) if length < _SHORTEST * max_step else None
            else:
                end = self._append(new)
                report(1)
                length = min(1.4 * length if new.iterations <= 5 else length, max_step)
        self.end = end or _End("max_points")

    def _advance(self, length: float) -> Solved | str:
        """Return the next torus at a distance ahead, or the word for the end of the family."""
        equations, here, ahead = self.equations, self.points[-1].curve, self.points[-1].tangent
        held = [equations.phase(here), equations.across(here, ahead, length)]
        new = equations.solve(here.plus(length, ahead), held)
        if new is None or equations.tail(new.curve) > _SPURIOUS:
            return STALLED if new is None else COARSE
        (before, _), (after, size) = (first_mode(equations, c) for c in (here, new.curve))
        if np.vdot(before, after).real <= 0 or size < SAME:
            return TORUS
        if equations.pack(new.tangent) @ equations.pack(ahead) < SAME_CURVE:
            return STALLED
        finer = equations.refined(new, self.most)
        if finer is None or equations.tail(finer.curve) > ROUGHLY:
            return COARSE
        return finer

    def _append(self, new: Solved) -> _End | None:
        """Append a torus, or the end of the family before it, which is returned."""
        equations, here, end = self.equations, self.points[-1].curve, None
        before, value = float(here.p[-1]), float(new.curve.p[-1])
        for bound in self.bounds:
            if (value - bound) * (before - bound) < 0:
                share, end = (bound - before) / (value - before), _End(BOUNDS)
                at = equations.solve_near(here.towards(new.curve, share), bound)
                if at is None:
                    return _End(STALLED)
                new = at
        margins = margins_of(equations, new.curve)
        number = int(np.argmin([margin.share for margin in margins]))
        if margins[number].crossed:
            at = self._locate(new, number)
            if at is None:
                return _End(STALLED, "an event changes, at a place that was not located")
            met, new = margins_of(equations, at.curve)[number], at
            end = _End(ORDER if met.change in REORDERED else GRAZING, str(met))
        for p, q in _ratios(here.rotation, new.curve.rotation):
            share = (p / q - here.rotation) / (new.curve.rotation - here.rotation)
            self.windows.append(self._window(here.towards(new.curve, share), p, q))
        self.points.append(new)
        return end

    def _locate(self, new: Solved, number: int) -> Solved | None:
        """Return the torus at which a margin is zero, between the last one and another."""
        equations, here = self.equations, self.points[-1].curve
        solved_at = lambda share: equations.solve_near(here.towards(new.curve, share))

        def margin(share: float) -> float:
            solved = solved_at(share)
            if solved is None:
                raise ArithmeticError
            return margins_of(equations, solved.curve)[number].value

        try:
            return solved_at(bracketed_zero(margin, 0.0, 1.0, tolerance=1e-12))
        except ArithmeticError:
            return None

    def _stalled(self, longest: float, reason: str) -> _End:
        """Return the end where no shorter step helps: at a window of locking close ahead, or for
        the reason of the last step."""
        here, base = self.points[-1].curve, self.points[-min(_BACK, len(self.points))].curve
        ahead = self.points[-1].tangent
        sense, value = np.sign(ahead.p[-1]), float(here.p[-1])
        for p, q in _ratios(here.rotation, here.rotation + _REACH * longest * ahead.rotation):
            window = self._window(base, p, q)
            near = window.low if sense > 0 else window.high
            if 0 <= sense * (near - value) <= window.high - window.low:
                self.windows.append(window)
                return _End(RESONANCE, f"the motion locks to {p}:{q}")
        return _End(reason)

    def _window(self, curve: Curve, p: int, q: int) -> Window:
        """Return the interval of the parameter of motions that lock to p:q, near a curve."""
        unknown, cycles = Window(p, q, np.nan, np.nan, self.equations, None), []
        for place in angles_of(_ANGLES) / q:
            cycle = self._locked(curve, p, q, place)
            if cycle is None:
                return unknown
            cycles.append(cycle)
        values = np.array([cycle.p[-1] for cycle in cycles])
        middle = values.mean()
        high = np.abs(np.fft.rfft(values))[_ANGLES // 3 :].max() / _ANGLES
        if high > LOCATED * np.ptp(values) + _ROUNDING * abs(middle):
            return unknown
        between = interpolated((values - middle)[:, None], angles_of(_BETWEEN))
        low, high = middle + between.min(), middle + between.max()
        near = np.argsort(np.abs(values - 0.5 * (low + high)))[: _ANGLES // 2]
        cycle = min((cycles[i] for i in near), key=self.equations.growth)
        return Window(p, q, float(low), float(high), self.equations, cycle)

    def _locked(self, curve: Curve, p: int, q: int, angle: float) -> Curve | None:
        """Return the motion that repeats after q periods and has this angle on a curve."""
        angles = angle + np.arange(q) * p / q
        x = interpolated(curve.x, angles)
        held = self.equations.along(interpolated(derivative(curve.x), angles), x)
        cycle = self.equations.solve(Curve(x, 0.0, curve.p), [held], is_cycle=True)
        return None if cycle is None else cycle.curve


def _ratios(one: float, other: float) -> Iterator[tuple[int, int]]:
    """Yield the ratios p:q between two numbers in lowest terms, in order of q."""
    low, high = sorted((one, other))
    for q in range(1, _LARGEST + 1):
        for p in range(ceil(low * q), floor(high * q) + 1):
            if gcd(p, q) == 1:
                yield p, q
