"""`continue_torus`: a quasi-periodic motion followed in one parameter of its machine."""

import dataclasses
import itertools
from collections.abc import Iterator
from functools import cached_property
from math import ceil, floor, gcd
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .._checks import count, flag, interval
from .._messages import Interrupted, ReportProgress, at_work
from ..machine import check_leaf, in_unit, leaf, units_of
from .find import find_orbit
from .from_orbit import check_parameter
from .kinds import GRAZING, TORUS
from .results import Orbit
from .torus import (
    MOST,
    POINT,
    RESOLVED,
    SETTLED,
    Torus,
    first_mode,
    margins_of,
    torus_of,
    with_parameter,
)
from .torus_equations import (
    Condition,
    Curve,
    Equations,
    Solved,
    cosine,
    derivative,
    interpolated,
    resampled,
    unit,
)
from .walk import BOUNDS, INTERRUPTED, SAME_CURVE, STALLED, check_walk

# Reasons to end: at a ratio p:q, where the motion locks; the nodes do not suffice; events change
# their order.
RESONANCE, COARSE, ORDER = "resonance", "coarse", "order"

# The largest denominator q of the ratios p:q that are looked for.
_LARGEST = 12

# A step with a larger tail has reached another solution of the equations. Steps are shortened to
# this share of the longest. Choices.
_SPURIOUS, _SHORTEST = 1e-3, 1e-3

# A ratio is close ahead within so many of the longest steps. It is crossed from one of these tori,
# counted backwards: one that is farther from the window than half its width. Choices.
_REACH, _EARLIER = 2.0, (1, 2, 4, 8, 16)

# Angles at which the motions of a window are found, within the q-th part of a turn: at least and at
# most. They are doubled until the high modes of the parameter are below this share of its range, or
# rounding. Its extrema, the window's ends, are sought at so many places between them. Choices.
_ANGLES, _MOST_ANGLES, _SMOOTH, _ROUNDING, _BETWEEN = 16, 128, 1e-7, 1e-14, 4096


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
        state = problem.unravel(jnp.asarray(self.equations.begin_of_cycle(self.cycle)))
        cycles = self.q * problem.cycles
        return find_orbit(problem.machine, state, cycles, method=problem.method, impact_log=16)


class _End(NamedTuple):
    reason: str
    detail: str = ""


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class TorusBranch:
    """A family of tori in one parameter, in order, from `continue_torus`.

    It ends on each side at the "bounds"; by "grazing" (located: a stop is touched or an impact
    lost); by "order" (two events, or an event and the section, change their order); by "resonance"
    (the motion locks to a ratio p:q in a window too wide to step across); by "coarse" (more nodes
    are needed than allowed, as at a loss of smoothness); by "neimark-sacker" (the curve shrinks to
    a periodic motion); by "stalled", "max_points" or "interrupted".
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
        guess = _between(points[i].curve, points[i + 1].curve, share)
        solved = equations.solve_near(guess, value)
        solved = None if solved is None else equations.refined(solved, SETTLED, most)
        if solved is None:
            raise ValueError(f"No torus was found at {self.name} = {value:.10g}.")
        # The nodes are doubled across the family; the last correction is at the value itself.
        solved = equations.solve_near(solved.curve, value) or solved
        return torus_of(solved, equations, self.tori[i].like)

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


def _between(one: Curve, other: Curve, share: float) -> Curve:
    nodes = max(len(one.x), len(other.x))
    parts: Any = zip(_with_nodes(one, nodes), _with_nodes(other, nodes), strict=True)
    return Curve(*((1 - share) * a + share * b for a, b in parts))


def _with_nodes(curve: Curve, nodes: int) -> Curve:
    return curve if len(curve.x) == nodes else curve._replace(x=resampled(curve.x, nodes))


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
    equations = Equations(with_parameter(torus.problem, parameter, bounds))
    start = equations.solve_near(torus.curve._replace(p=np.array([value])))
    if start is None:
        raise ValueError("Argument `torus` could not be refined in this parameter.")
    walks = [_Walk(equations, bounds, start, sense, most) for sense in (1.0, -1.0)]

    def result() -> TorusBranch:
        ahead, back = walks
        points = [*reversed(back.points[1:]), *ahead.points]
        tori = [torus_of(point, equations, torus.like) for point in points]
        return TorusBranch(
            parameter, tori, (back.end.reason, ahead.end.reason),
            (back.end.detail, ahead.end.detail), [*reversed(back.windows), *ahead.windows],
            (equations, points, most),
        )  # fmt: skip

    def interrupted() -> Interrupted:
        return Interrupted("walk along the tori", result())

    with at_work("tori", interrupted, progress=progress, unit="torus") as report:
        for walk in walks:
            walk.walk(report, **settings)
    return result()


class _Walk:
    def __init__(
        self, equations: Equations, bounds: tuple[float, float], start: Solved, sense: float,
        most: int,
    ):  # fmt: skip
        self.equations, self.bounds, self.most = equations, bounds, most
        self.points, self.windows = [start._replace(tangent=unit(start.tangent, sense))], []
        self.end = _End(INTERRUPTED)

    def walk(
        self, report: ReportProgress, *, step: float, max_step: float, max_points: int
    ) -> None:
        length = step
        self.end = _End("max_points")
        while len(self.points) < max_points:
            here, window = self.points[-1], None
            new = self._advance(here, length)
            if new == TORUS:
                self.end = _End(TORUS, "the curve shrinks to a periodic motion")
                return
            reason = new
            if isinstance(new, str):
                new, window = self._cross(here, max_step)
            if new is None:
                length *= 0.4
                if length < _SHORTEST * max_step:
                    self.end = self._stalled(here, max_step, str(reason))
                    return
                continue
            assert isinstance(new, Solved)
            end, last = self._ending(here, new)
            if last is not None:
                self.windows += self._windows(here.curve, last.curve, window)
                self.points.append(last)
            if end is not None:
                self.end = end
                return
            report(1)
            grows = window is None and new.iterations <= 5
            length = step if window else min(1.4 * length if grows else length, max_step)

    def _advance(self, here: Solved, length: float) -> Solved | str:
        """Return the torus at a distance from one, or the reason why there is none."""
        equations, tangent = self.equations, here.tangent
        x = here.curve.x.copy()
        x[:, equations.first] += length * tangent.rows * equations.scale[equations.first]
        guess = Curve(
            x, here.curve.rotation + length * tangent.rotation,
            here.curve.p + length * tangent.p * equations.widths,
        )  # fmt: skip
        held = [equations.phase(here.curve), equations.across(here.curve, tangent, length)]
        new = equations.solve(guess, held)
        if new is None or equations.tail(new.curve) > _SPURIOUS:
            return STALLED if new is None else COARSE
        before, after = first_mode(equations, here.curve), first_mode(equations, new.curve)
        if np.vdot(before, after).real <= 0 or np.abs(after).max() < POINT:
            return TORUS
        if cosine(unit(new.tangent), tangent) < SAME_CURVE:
            return STALLED
        finer = equations.refined(new, SETTLED, self.most)
        if finer is None or equations.tail(finer.curve) > RESOLVED:
            return COARSE
        return finer._replace(tangent=unit(finer.tangent))

    def _ending(self, here: Solved, new: Solved) -> tuple[_End | None, Solved | None]:
        """Return how the family ends before a torus, if it does, and its last torus."""
        value = float(new.curve.p[-1])
        before = float(here.curve.p[-1])
        bound = next((b for b in self.bounds if (value - b) * (before - b) < 0), None)
        end = None
        if bound is not None:
            share = (bound - before) / (value - before)
            at = self.equations.solve_near(_between(here.curve, new.curve, share), bound)
            if at is None:
                return _End(STALLED), None
            end, new = _End(BOUNDS), at
        crossed = margins_of(self.equations, new.curve).crossed
        if crossed is None:
            return end, new
        at = self._locate(here, new, crossed)
        if at is None:
            return _End(STALLED, "an event changes, at a place that was not located"), None
        problem = self.equations.motion(at.curve.p)
        words = margins_of(self.equations, at.curve).in_words(problem, crossed)
        return _End(ORDER if crossed in (1, 2, 3) else GRAZING, words), at

    def _locate(self, here: Solved, new: Solved, number: int) -> Solved | None:
        """Return the torus between two at which a margin is zero."""
        found: dict[float, Solved] = {}
        nodes = max(len(here.curve.x), len(new.curve.x))
        one, other = (_with_nodes(point.curve, nodes) for point in (here, new))

        def margin(share: float) -> float:
            p = (1 - share) * one.p + share * other.p
            guess = _between(one, other, share)
            solved = self.equations.solve_near(guess, float(p[-1]))
            if solved is None:
                raise ArithmeticError
            found[share] = solved
            return float(margins_of(self.equations, solved.curve).values[number])

        from scipy.optimize import brentq  # slow to load

        try:
            share = float(brentq(margin, 0.0, 1.0, xtol=1e-12))  # pyright: ignore[reportArgumentType]
        except (ArithmeticError, ValueError):
            return None
        return found[share] if share in found else None

    def _stalled(self, here: Solved, longest: float, reason: str) -> _End:
        sense, value = np.sign(here.tangent.p[-1]), float(here.curve.p[-1])
        base = self.points[-min(_EARLIER[-1], len(self.points))].curve
        for p, q in self._ahead(here, longest):
            window = self._window(base, p, q)
            near = window.low if sense > 0 else window.high
            if 0 <= sense * (near - value) <= window.high - window.low:
                self.windows.append(window)
                return _End(RESONANCE, f"the motion locks to {p}:{q}")
        return _End(reason)

    def _ahead(self, here: Solved, longest: float) -> list[tuple[int, int]]:
        """Return the ratios in reach ahead, that of the strongest locking first."""
        turn = here.curve.rotation
        return list(_ratios(turn, turn + _REACH * longest * here.tangent.rotation))

    def _cross(self, here: Solved, longest: float) -> tuple[Solved | None, Window | None]:
        """Return a torus beyond a window of locking close ahead, and the window. Its guess is a
        torus that is as far from the window on this side: beyond, the motion passes the same places
        in the opposite sense of rotation against p:q."""
        equations, sense = self.equations, np.sign(here.tangent.p[-1])
        for (p, q), k in itertools.product(self._ahead(here, longest), _EARLIER):
            if k > len(self.points):
                break
            base = self.points[-k].curve
            window, value = self._window(base, p, q), float(base.p[-1])
            near, far = (window.low, window.high) if sense > 0 else (window.high, window.low)
            if not sense * (near - value) > 0.5 * (window.high - window.low):
                continue
            beyond = far + (near - value)
            if not self.bounds[0] <= beyond <= self.bounds[1]:
                continue
            guess = base._replace(rotation=2 * p / q - base.rotation)
            found = equations.solve_near(guess, beyond)
            found = None if found is None else equations.refined(found, SETTLED, self.most)
            if found is None or equations.tail(found.curve) > RESOLVED:
                continue
            if (found.curve.rotation - p / q) * (p / q - base.rotation) > 0:
                side = sense * np.sign(found.tangent.p[-1])
                return found._replace(tangent=unit(found.tangent, float(side))), window
        return None, None

    def _windows(self, one: Curve, other: Curve, known: Window | None) -> list[Window]:
        """Return the windows between two tori, the known one included."""
        found = [] if known is None else [known]
        for p, q in _ratios(one.rotation, other.rotation):
            if known is None or (known.p, known.q) != (p, q):
                share = (p / q - one.rotation) / (other.rotation - one.rotation)
                found.append(self._window(_between(one, other, share), p, q))
        return found

    def _window(self, curve: Curve, p: int, q: int) -> Window:
        """Return the interval of the parameter of motions that lock to p:q, near a curve."""
        angles, known = _ANGLES, {}
        while True:
            for k in range(angles):
                place = k / (angles * q)
                known[place] = known.get(place) or self._locked(curve, p, q, place)
                if known[place] is None:
                    return Window(p, q, np.nan, np.nan, self.equations, None)
            cycles = [known[place] for place in sorted(known)]
            values = np.array([cycle.p[-1] for cycle in cycles])
            high = np.abs(np.fft.rfft(values)[angles // 3 :]).max() / angles
            if high <= _SMOOTH * np.ptp(values) + _ROUNDING * np.abs(values).max():
                break
            if angles == _MOST_ANGLES:
                return Window(p, q, np.nan, np.nan, self.equations, None)
            angles *= 2
        mean = values.mean()
        between = interpolated_even(values - mean, _BETWEEN)
        middle = 0.5 * (between.min() + between.max())
        near = np.argsort(np.abs(values - mean - middle))[: angles // 2]
        cycle = min((cycles[i] for i in near), key=self.equations.growth)
        low, high = (float(mean + end) for end in (between.min(), between.max()))
        return Window(p, q, low, high, self.equations, cycle)

    def _locked(self, curve: Curve, p: int, q: int, angle: float) -> Curve | None:
        """Return the motion that repeats after q periods and has this angle on a curve."""
        equations, angles = self.equations, angle + np.arange(q) * p / q
        x, scale = interpolated(curve.x, angles), equations.scale
        rows = interpolated(derivative(curve.x / scale), angles)[:, equations.first]
        rows = rows / np.linalg.norm(rows)
        value = float(np.sum(rows * equations.scaled(x)))
        held = Condition(rows, 0.0, np.zeros(1), value)
        cycle = equations.solve(Curve(x, 0.0, curve.p), [held], is_cycle=True)
        return None if cycle is None else cycle.curve


def interpolated_even(values: np.ndarray, number: int) -> np.ndarray:
    """Return an even number of periodic values, at more places."""
    spectrum = np.fft.rfft(values)
    spectrum[-1] *= 0.5
    return np.fft.irfft(spectrum, number) * (number / len(values))


def _ratios(one: float, other: float) -> Iterator[tuple[int, int]]:
    """Yield the ratios p:q between two numbers in lowest terms, in order of q."""
    low, high = sorted((one, other))
    for q in range(1, _LARGEST + 1):
        for p in range(ceil(low * q), floor(high * q) + 1):
            if gcd(p, q) == 1:
                yield p, q
