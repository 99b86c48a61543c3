"""`continue_orbit`: a branch of periodic motions in one parameter, and why it changes."""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax.flatten_util import ravel_pytree
from scipy.optimize import brentq, newton

from .._checks import count, require
from ..flow.choice import MethodLike
from ..scene import AbstractScene, Scene
from ..scene.leaves import check_again, check_leaf, leaf, with_leaf
from .curve import Step, array_of, corrected, first_tangent, walk
from .results import ORBIT_RESULTS, Orbit, told_impacts
from .shooting import Shooting, carrier, steps_of

FOLD, DOUBLING, TORUS = "fold", "period-doubling", "neimark-sacker"
GRAZING, CROSSING = "grazing", "branch-point"

# An orbit found on the cycle map solves the equations from impact to impact closer than this; one
# that rests on a stop does not.
_SAME = 1e-3


@dataclasses.dataclass(frozen=True)
class SpecialPoint:
    """A point of a branch at which something happens."""

    kind: str
    """"fold", "period-doubling", "neimark-sacker", "branch-point" or "grazing"."""
    parameter: float
    orbit: Orbit
    detail: str
    """What happens there, in words."""
    problem: Shooting = dataclasses.field(repr=False)
    step: Step = dataclasses.field(repr=False)
    scale: np.ndarray = dataclasses.field(repr=False)
    impact: int | None = None
    """The impact that grazes; `None` where the body touches a stop that it did not hit before."""

    def switch(self, *, distance: float = 0.01) -> Orbit:
        """An orbit of the other branch that begins here, to be continued.

        At a period doubling, the motion of twice the period; at a grazing, the motion with that
        impact less or one more, on the side on which it is admissible.

        **Arguments:** how far from the point (in the norm of the scaled unknowns).

        **Raises:** `ValueError` for other kinds, or if there is no admissible motion beyond.
        """
        if self.kind == DOUBLING:
            return _doubled(self, distance)
        if self.kind == GRAZING:
            return _beyond_grazing(self, distance)
        raise ValueError(
            "`switch` needs a period doubling or a grazing, but this special point is a "
            f"{self.kind}."
        )

    def __str__(self) -> str:
        return f"{self.kind} at {self.parameter:.10g}: {self.detail}"


@dataclasses.dataclass(frozen=True)
class Branch:
    """A branch of periodic motions: host arrays with one row for each point, in their order."""

    name: str
    """Name of the parameter."""
    parameter: np.ndarray
    y_min: np.ndarray
    """Smallest Y (unit: a)."""
    y_max: np.ndarray
    """Largest Y (unit: a)."""
    multipliers: np.ndarray
    """Floquet multipliers over the period, the largest modulus first; (points, states)."""
    impact_phase: np.ndarray
    """Clock of each impact since the section (radians of crank angle); (points, impacts)."""
    impact_speed: np.ndarray
    """V⁻ of each impact (unit: a ω); (points, impacts)."""
    clearance: np.ndarray
    """Smallest distance to a stop at a turn that does not touch it (unit: a)."""
    frequency_ratio: np.ndarray
    """ζ: mean crank speed (unit: ω), NaN for scenes that are not driven."""
    cycles: int
    """Period in drive cycles."""
    special: list[SpecialPoint]
    ends: tuple[str, str]
    """Why the branch ends on each side: "bounds", "grazing" (an impact is lost or a stop touched),
    "period-doubling" (it springs there from a motion of half its period), "closed", "stalled",
    "max_points"."""
    problem: Shooting = dataclasses.field(repr=False)
    steps: list[Step] = dataclasses.field(repr=False)
    scale: np.ndarray = dataclasses.field(repr=False)

    @property
    def stable(self) -> np.ndarray:
        """Whether all multipliers lie inside the unit circle, at each point."""
        return np.abs(self.multipliers).max(axis=1) < 1

    @property
    def admissible(self) -> np.ndarray:
        """Whether the motion stays inside the gap and approaches each impact, at each point."""
        slow = self.impact_speed.min(axis=1, initial=np.inf)
        return (self.clearance > -1e-9) & (slow > -1e-9)

    def orbit(self, index: int) -> Orbit:
        """The motion at one point."""
        return orbit_of(self.problem, self.steps[index])

    def at(self, value: float) -> list[Orbit]:
        """The branch's motions at a value of the parameter, solved for; in the branch's order."""
        found = []
        for here, new in itertools.pairwise(self.steps):
            # Steps follow the branch's sense, except in its backward half, which is turned.
            if (here.x[-1] - value) * (new.x[-1] - value) > 0 or new.x[-1] == value:
                continue
            if float(np.dot(here.tangent, (new.x - here.x) / self.scale)) < 0:
                here, new = new, here
            step = _where(
                lambda s, here=here: _advance(self.problem, here.x, here.tangent, self.scale, s),
                here, new, self.scale, lambda step: float(step.x[-1]) - value,
            )  # fmt: skip
            if step is not None:
                found.append(orbit_of(self.problem, step))
        return found

    def to_xarray(self) -> xr.Dataset:
        """The branch as an `xarray.Dataset` over its points."""
        units = {"y_min": "a", "y_max": "a", "clearance": "a", "impact_speed": "a ω"}
        data = {
            name: ("point", getattr(self, name))
            for name in ("parameter", "y_min", "y_max", "clearance", "frequency_ratio", "stable")
        }
        data |= {
            "impact_phase": (("point", "impact"), self.impact_phase),
            "impact_speed": (("point", "impact"), self.impact_speed),
            "multipliers": (("point", "state"), self.multipliers),
        }
        found = xr.Dataset(data, attrs={"parameter": self.name, "period_in_cycles": self.cycles})
        for name, unit in units.items():
            found[name].attrs["units"] = unit
        return found

    def __str__(self) -> str:
        low, high = self.parameter.min(), self.parameter.max()
        lines = [
            f"Branch of {len(self.parameter)} motions of period {2 * self.cycles}π with "
            f"{told_impacts(self.impact_speed.shape[1])}, {self.name} in [{low:.6g}, {high:.6g}], "
            f"{int(self.stable.sum())} of them stable; ends: {self.ends[0]}, {self.ends[1]}",
            *(f"  {point}" for point in self.special),
        ]
        return "\n".join(lines)


def continue_orbit(
    orbit: Orbit,
    *,
    parameter: str,
    bounds: tuple[float, float],
    step: float = 0.01,
    max_step: float = 0.1,
    max_points: int = 1000,
    flow: MethodLike = None,
) -> Branch:
    """Follow a periodic motion in one number of its scene, both ways, through folds.

    Pseudo-arclength on the equations from impact to impact, which stay smooth at a grazing. Folds,
    period doublings, Neimark–Sacker bifurcations, crossings of branches and grazings are located
    to rounding. Where an impact is lost or a stop is touched, the motion ceases to be one: there
    the branch ends (`special[i].switch()` goes on with the other impacts). Host-side: not to be
    traced; one compiled program for each number of cycles and impacts.

    **Arguments:**

    - `orbit`: from `find_orbit`, or from another branch.
    - `parameter`: name of a number of the scene: `"drive.frequency_ratio"`, `"stops.0.gap"`,
      `"oscillator.damping_ratio"`, …
    - `bounds`: the interval of the parameter.
    - `step`, `max_step`: first and longest step along the branch, in the norm of the unknowns
      (positions in a, velocities in a ω, clocks in radians, the parameter in half its interval).
    - `max_points`: points in each direction at most.
    - `flow`: the method that carries the scene, of fixed steps: by default `ExactFlight()` where it
      applies, else 32 steps of `Dopri8` a cycle.

    **Returns:** a `Branch`.

    **Raises:** `ValueError` if the orbit is none, lies outside the bounds, or the name is unknown.
    """
    if not isinstance(orbit, Orbit) or orbit.residual.ndim:
        raise ValueError("Argument `orbit` must be one `Orbit`, not a batch or a state.")
    if not bool(orbit.successful):
        reason = ORBIT_RESULTS[orbit.result]
        raise ValueError(f"Argument `orbit` must be an orbit, but is: {reason}")
    check_leaf(orbit.scene, parameter)
    low, high = float(bounds[0]), float(bounds[1])
    value = float(leaf(orbit.scene, parameter))
    if not low <= value <= high or low == high:
        raise ValueError(
            f"Argument `bounds` must hold the orbit's {parameter} = {value:g}, but is "
            f"({low:g}, {high:g})."
        )
    for bound in (low, high):
        check_again(with_leaf(orbit.scene, parameter, bound))
    require("step", step, low=0.0, open_low=True)
    count("max_points", max_points, least=2)
    problem, x = _problem(orbit, (parameter,), [(low, high)], flow)
    scale = np.ones(problem.size)
    scale[-1] = 0.5 * (high - low)
    # Across the branch, not at a fixed parameter: the orbit may lie at a fold.
    start = _advance(problem, x, _tangent_at(problem, x, scale), scale, 0.0)
    moved = float(np.max(np.abs(start.x - x) / scale))
    if not bool(start.good) or moved > _SAME:
        raise ValueError(
            "Argument `orbit` could not be refined from impact to impact (last correction "
            f"{max(moved, float(start.size)):.2g}): branches cross there, it is no orbit of this "
            "scene, or its body comes to rest on a stop, which cannot be followed from impact to "
            "impact."
        )
    ahead = _Follower(problem, scale, (low, high))
    settings = {"step": step, "max_step": max_step, "max_points": max_points}
    forward = walk(ahead.advance, start, stop=ahead.stop, **settings)
    back = _Follower(problem, scale, (low, high))
    turned = start._replace(tangent=-start.tangent)
    if forward.end == "closed":
        backward_steps, ends = [], ("closed", "closed")
    else:
        backward = walk(back.advance, turned, stop=back.stop, **settings)
        backward_steps, ends = back.path(backward.steps[1:]), (backward.end, forward.end)
    special = [*reversed(back.special), *ahead.special]
    steps = [*reversed(backward_steps), *ahead.path(forward.steps)]
    return _branch(problem, parameter, steps, special, ends, scale)


def _branch(problem, name, steps, special, ends, scale) -> Branch:
    xs = np.stack([step.x for step in steps])
    legs = len(problem.stops)

    def column(get: Callable[[Any], Any]) -> np.ndarray:
        return np.stack([np.asarray(get(step.seen)) for step in steps])

    duration = column(lambda seen: seen.duration)
    ratio = problem.scene.frequency_ratio(jnp.asarray(duration / problem.cycles))
    if ratio is not None and name == "drive.frequency_ratio":
        ratio = xs[:, -1]
    return Branch(
        name=name,
        parameter=xs[:, -1],
        y_min=column(lambda seen: seen.y_min),
        y_max=column(lambda seen: seen.y_max),
        multipliers=column(lambda seen: seen.multipliers),
        impact_phase=xs[:, :legs],
        impact_speed=column(lambda seen: seen.approach),
        clearance=column(lambda seen: seen.clearance),
        frequency_ratio=np.full(len(xs), np.nan) if ratio is None else np.asarray(ratio),
        cycles=problem.cycles,
        special=special,
        ends=ends,
        problem=problem,
        steps=steps,
        scale=scale,
    )


def _problem(
    orbit: Orbit,
    parameters: tuple[str, ...],
    ranges: list[tuple[float, float]],
    flow: MethodLike,
) -> tuple[Shooting, np.ndarray]:
    """The equations of an orbit from impact to impact, and the unknowns it gives."""
    scene = orbit.scene
    carried = carrier(flow or orbit.flow, scene)
    corners = [scene]
    for name, ends in zip(parameters, ranges, strict=True):
        corners = [with_leaf(x, name, end) for x in corners for end in ends]
    cycles = int(orbit.cycles)
    stops = tuple(int(i) for i in np.asarray(orbit.impact_stop) if i >= 0)
    if len(stops) != int(orbit.impacts):
        raise ValueError(
            f"Argument `orbit` must list all its {int(orbit.impacts)} impacts, but lists "
            f"{len(stops)}: find it with a larger `impact_log`."
        )
    steps = steps_of(carried, corners, orbit.state, cycles)
    problem = Shooting(scene, carried, orbit.state, cycles, stops, steps, parameters)
    section = 0.0
    if isinstance(scene, Scene) and scene.section_phase is not None:
        section = float(scene.section_phase)
    clock = np.asarray(orbit.impact_phase)[: len(stops)] - section
    u, s = ravel_pytree(orbit.state)[0], 0.0
    states = []
    for i, place in enumerate(clock):
        u = _carry(problem, s, place, u)
        states.append(u)
        u, s = _bounce(problem, i, u), place
    values = [leaf(scene, name) for name in parameters]
    x = problem.pack(clock, jnp.stack(states) if states else u, values)
    return problem, np.asarray(x)


@eqx.filter_jit
def _carry(problem: Shooting, s0, s1, u):
    return problem.flight(problem.scene, jnp.asarray(s0), jnp.asarray(s1), u)[0]


@eqx.filter_jit
def _bounce(problem: Shooting, leg, u):
    return problem.bounced(problem.scene, jnp.asarray(leg), u)


@eqx.filter_jit
def _compiled_advance(problem, x, tangent, scale, length) -> Step:
    def observe(x, tangent):
        return problem.observe(x)

    return corrected(problem.residual, observe, x, tangent, scale, length)


def _advance(problem: Shooting, x, tangent, scale, length) -> Step:
    arguments = (jnp.asarray(a) for a in (x, tangent, scale, length))
    return array_of(_compiled_advance(problem, *arguments))


@eqx.filter_jit
def _compiled_observe(problem, x):
    return problem.observe(x)


def _observe(problem: Shooting, x: np.ndarray) -> Any:
    return array_of(_compiled_observe(problem, jnp.asarray(x)))


@eqx.filter_jit
def _compiled_tangent(problem, x, scale):
    return first_tangent(problem.residual, x, scale)


def _tangent_at(problem: Shooting, x: np.ndarray, scale: np.ndarray) -> np.ndarray:
    return np.asarray(_compiled_tangent(problem, jnp.asarray(x), jnp.asarray(scale)))


@eqx.filter_jit
def _compiled_state(problem, x, leg, s):
    return problem.state_at(x, leg, s)


@eqx.filter_jit
def _compiled_sections(problem, x, legs, places):
    states = jax.vmap(lambda leg, s: problem.state_at(x, leg, s))(legs, places)
    return states, jnp.max(jnp.abs(problem.residual(x)))


def orbit_of(problem: Shooting, step: Step) -> Orbit:
    """The solution at a step as an `Orbit`."""
    x, seen = jnp.asarray(step.x), step.seen
    scene = problem.at(x)
    clock = np.asarray(step.x)[: len(problem.stops)]
    turn = float(scene.cycle)
    places = turn * np.arange(problem.cycles)
    legs = np.zeros(problem.cycles, int)
    # Along a branch an impact may move past the section: an orbit's clocks lie within its period.
    within = np.mod(clock, turn * problem.cycles)
    order = np.argsort(within)
    if len(clock):
        places = clock[0] + np.mod(places - clock[0], turn * problem.cycles)
        legs = np.searchsorted(clock, places, side="right") - 1
    sections, residual = _compiled_sections(problem, x, jnp.asarray(legs), jnp.asarray(places))
    admissible = seen.clearance >= -1e-9 and min(seen.approach, default=1.0) > -1e-9
    since = within[order]
    if isinstance(scene, Scene):
        since = scene.phase_at(since)
    duration = jnp.asarray(seen.duration)
    return Orbit(
        scene=scene,
        flow=problem.flow,
        state=jax.tree.map(lambda x: x[0], sections),
        sections=sections,
        cycles=jnp.asarray(problem.cycles, jnp.int32),
        duration=duration,
        frequency_ratio=scene.frequency_ratio(duration / problem.cycles),
        impact_phase=jnp.asarray(since),
        impact_speed=jnp.asarray(np.asarray(seen.approach)[order]),
        impact_stop=jnp.asarray(np.asarray(problem.stops, np.int32)[order]),
        impacts=jnp.asarray(len(problem.stops), jnp.int32),
        y_min=jnp.asarray(seen.y_min),
        y_max=jnp.asarray(seen.y_max),
        clearance=jnp.asarray(seen.clearance),
        monodromy=jnp.asarray(seen.monodromy),
        multipliers=jnp.asarray(seen.multipliers),
        residual=residual,
        error=jnp.asarray(step.size),
        iterations=jnp.asarray(step.iterations, jnp.int32),
        history=jnp.zeros((0,)),
        result=ORBIT_RESULTS.converged if admissible else ORBIT_RESULTS.inadmissible,
    )


def _tests(step: Step) -> dict[str, float]:
    """Functions that change sign at the bifurcations."""
    M, identity = step.seen.monodromy, np.eye(step.seen.monodromy.shape[0])
    values = step.seen.multipliers
    pairs = [
        1 - values[i] * values[j] for i in range(len(values)) for j in range(i + 1, len(values))
    ]
    return {
        FOLD: float(step.tangent[-1]),
        DOUBLING: float(np.linalg.det(M + identity)),
        CROSSING: float(np.linalg.det(M - identity)),
        TORUS: float(np.real(np.prod(pairs))),
    }


def _where(
    advance: Callable[[float], Step],
    here: Step,
    new: Step,
    scale: np.ndarray,
    test: Callable[[Step], float],
) -> Step | None:
    """The point between two at which a test is zero; `advance` goes along `here`'s tangent."""
    length = float(np.dot(here.tangent, (new.x - here.x) / scale))
    at: dict[float, Step] = {0.0: here, length: new}

    def value(s: float) -> float:
        if s not in at:
            at[s] = advance(s)
        return test(at[s])

    if not value(0.0) * value(length) <= 0:
        return None
    root = float(brentq(value, 0.0, length, xtol=1e-14, rtol=1e-14, maxiter=80))  # pyright: ignore
    value(root)
    # Where branches cross the corrector has no answer; a point beside it will do.
    good = [step for step in at.values() if bool(step.good)]
    return min(good, key=lambda step: abs(test(step)), default=None)


class _Follower:
    """Looks at each step of a walk: locates what happens in it and says when to end."""

    def __init__(self, problem: Shooting, scale: np.ndarray, bounds: tuple[float, float]):
        self.problem, self.scale, self.bounds = problem, scale, bounds
        self.special: list[SpecialPoint] = []
        self.between: dict[int, list[Step]] = {}
        self.start: Step | None = None
        self.away = False

    def advance(self, x, tangent, length) -> Step:
        return _advance(self.problem, x, tangent, self.scale, length)

    def stop(self, here: Step, new: Step) -> tuple[Step, str] | None:
        reason, last = None, new
        low, high = self.bounds
        if not low <= new.x[-1] <= high:
            bound = low if new.x[-1] < low else high
            last = self._where(here, new, lambda step: float(step.x[-1]) - bound) or here
            reason = "bounds"
        grazing = self._grazing(here, last)
        if grazing is not None:
            last, reason = grazing.step, "grazing"
        origin = self._bifurcations(here, last)
        if origin is not None:
            return origin, "period-doubling"
        if grazing is not None:
            self.special.append(grazing)
        elif reason is None and self._closed(here, new):
            return here, "closed"
        return None if reason is None else (last, reason)

    def _closed(self, here: Step, new: Step) -> bool:
        self.start = here if self.start is None else self.start
        apart = float(np.linalg.norm((new.x - self.start.x) / self.scale))
        length = float(np.linalg.norm((new.x - here.x) / self.scale))
        self.away = self.away or apart > 3 * length
        return self.away and apart < 0.5 * length

    def _where(self, here: Step, new: Step, test: Callable[[Step], float]) -> Step | None:
        """The point between two at which a test is zero."""
        return _where(lambda s: self.advance(here.x, here.tangent, s), here, new, self.scale, test)

    def _point(self, kind: str, step: Step, detail: str, impact: int | None = None) -> SpecialPoint:
        return SpecialPoint(
            kind, float(step.x[-1]), orbit_of(self.problem, step), detail, self.problem, step,
            self.scale, impact,
        )  # fmt: skip

    def _grazing(self, here: Step, new: Step) -> SpecialPoint | None:
        """The first of the impacts lost and the stops touched between two points."""
        found = []

        def room(step: Step) -> float:
            return float(np.clip(step.seen.clearance, -1.0, 1.0))

        for i in range(len(self.problem.stops)):
            if new.seen.approach[i] <= 0 < here.seen.approach[i]:
                at = self._where(here, new, lambda step, i=i: float(step.seen.approach[i]))
                if at is not None:
                    found.append((at, i))
        if room(new) < 0 < room(here):
            at = self._where(here, new, room)
            if at is not None:
                found.append((at, None))
        if not found:
            return None
        at, impact = min(found, key=lambda f: float(np.dot(here.tangent, f[0].x - here.x)))
        if impact is None:
            told = f"touches a stop at clock {float(at.seen.touch):.6g}"
        else:
            told = f"impact {impact} is lost"
        return self._point(GRAZING, at, told, impact)

    def _bifurcations(self, here: Step, last: Step) -> Step | None:
        """Record what happens between two points; the point where the branch springs, if met.

        There the two halves of the period become alike, and beyond it the same motions come again,
        observed half a period later.
        """
        apart = self._halves(here)
        if apart.size and np.dot(apart, self._halves(last)) < 0:
            at = self._where(here, last, lambda step: float(np.dot(apart, self._halves(step))))
            if at is not None:
                at = self._origin(at)
                told = "the branch springs from a motion of half the period"
                self.special.append(self._point(DOUBLING, at, told))
                return at
        before, after = _tests(here), _tests(last)
        changed = {kind for kind in before if before[kind] * after[kind] < 0}
        if FOLD in changed:
            changed.discard(CROSSING)
        found = []
        for kind in changed:
            at = self._where(here, last, lambda step, kind=kind: _tests(step)[kind])
            if at is None:
                continue
            values = at.seen.multipliers
            told = {
                FOLD: "a multiplier passes 1 and the branch turns back",
                DOUBLING: "a multiplier passes -1",
                CROSSING: "a multiplier passes 1 and another branch crosses",
                TORUS: "a complex pair of multipliers leaves the unit circle",
            }[kind]
            on_circle = {
                FOLD: np.abs(values - 1).min(),
                DOUBLING: np.abs(values + 1).min(),
                CROSSING: np.abs(values - 1).min(),
                TORUS: np.abs(np.abs(values[np.abs(values.imag) > 1e-9]) - 1).min(initial=np.inf),
            }[kind]
            if on_circle < 1e-5:  # or else a pole of the determinant, or a real pair μ, 1/μ
                found.append((float(np.dot(here.tangent, at.x - here.x)), kind, at, told))
        found.sort(key=lambda f: f[0])
        for _, kind, at, told in found:
            self.special.append(self._point(kind, at, told))
        self.between[id(last)] = [at for _, _, at, _ in found]
        return None

    def path(self, steps: list[Step]) -> list[Step]:
        """The steps of a walk with the bifurcations located between them."""
        return [step for new in steps for step in [*self.between.get(id(new), ()), new]]

    def _origin(self, at: Step) -> Step:
        """The point where the branch springs, located on the motion of half the period.

        Both branches cross there, so that the equations of this one cannot be solved close by. The
        mean of the two halves is a motion of half the period but for a term of second order.
        """
        problem, count = self.problem, len(self.problem.parameters)
        legs, x = len(problem.stops) // 2, jnp.asarray(at.x)
        turn = float(problem.scene.cycle) * problem.cycles / 2
        half = dataclasses.replace(
            problem, cycles=problem.cycles // 2, stops=problem.stops[:legs],
            steps=problem.steps // 2,
        )  # fmt: skip
        clock, states = (np.asarray(a) for a in problem.parts(x))
        if legs:
            clock = 0.5 * (clock[:legs] + clock[legs:] - turn)
            states = 0.5 * (states[:legs] + states[legs:])
        else:
            states = states + 0.5 * self._halves(at)
        mean = np.asarray(half.pack(clock, states, at.x[-count:]))
        scale = np.append(np.ones(mean.size - count), self.scale[-count:])
        along = np.append(np.zeros(mean.size - 1), 1.0)

        def missing(shift: float) -> float:
            step = _advance(half, mean, along, scale, shift)
            M = step.seen.monodromy
            return float(np.linalg.det(M + np.eye(len(M)))) if bool(step.good) else np.nan

        shift, report = newton(  # pyright: ignore[reportAssignmentType]
            missing, 0.0, x1=1e-6, tol=1e-14, full_output=True, disp=False
        )
        if not report.converged or not abs(shift) < 1e-2:
            return at
        found = _advance(half, mean, along, scale, float(shift))
        clock, states = (np.asarray(a) for a in half.parts(jnp.asarray(found.x)))
        if legs:
            clock, states = np.append(clock, clock + turn), np.concatenate([states, states])
        x = np.asarray(problem.pack(clock, states, found.x[-count:]))
        return at._replace(x=x, size=found.size, seen=_observe(problem, x))

    def _halves(self, step: Step) -> np.ndarray:
        """How the second half of the period differs from the first; empty if it cannot be alike."""
        legs, cycles = len(self.problem.stops), self.problem.cycles
        if cycles % 2 or legs % 2:
            return np.zeros(0)
        turn = float(self.problem.scene.cycle) * cycles / 2
        x = jnp.asarray(step.x)
        if not legs:
            middle = _compiled_state(self.problem, x, jnp.asarray(0), jnp.asarray(turn))
            return np.asarray(ravel_pytree(middle)[0]) - step.x[: self.problem.states]
        clock, states = (np.asarray(a) for a in self.problem.parts(x))
        half = legs // 2
        late = clock[half:] - clock[:half] - turn
        return np.append(late, (states[half:] - states[:half]).ravel())


def _doubled(point: SpecialPoint, distance: float) -> Orbit:
    """A motion of twice the period, along what the multiplier -1 makes possible."""
    old = point.problem
    x = np.asarray(point.step.x)
    clock, states = (np.asarray(a) for a in old.parts(jnp.asarray(x)))
    turn = float(old.scene.cycle) * old.cycles
    if old.stops:
        clock, states = np.concatenate([clock, clock + turn]), np.concatenate([states, states])
        stops = old.stops * 2
    else:
        stops = ()
    new = dataclasses.replace(old, cycles=2 * old.cycles, stops=stops, steps=2 * old.steps)
    count = len(old.parameters)
    twice = np.asarray(new.pack(clock, states, x[-count:]))
    scale = np.concatenate([np.ones(len(twice) - count), point.scale[-count:]])
    jacobian = np.asarray(_jacobian(new, jnp.asarray(twice))) * scale
    # Without the parameter's column the equations have one null vector here: that of -1.
    tangent = np.zeros(len(twice))
    tangent[:-count] = np.linalg.svd(jacobian[:, :-count])[2][-1]
    step = _advance(new, twice, tangent, scale, distance)
    if not bool(step.good):
        raise ValueError(
            f"No motion of twice the period was found at distance {distance:g}; try another."
        )
    return orbit_of(new, step)


@eqx.filter_jit
def _jacobian(problem: Shooting, x):
    return jax.jacfwd(problem.residual)(x)


def _beyond_grazing(point: SpecialPoint, distance: float) -> Orbit:
    """The motion with the grazing impact less, or with the touch as an impact more."""
    old, step = point.problem, point.step
    x = jnp.asarray(step.x)
    scene = old.at(x)
    clock, states = (np.asarray(a) for a in old.parts(x))
    stops, value = list(old.stops), np.asarray(step.x)[-1:]
    if point.impact is not None:
        del stops[point.impact]
        if stops:
            clock, states = (np.delete(a, point.impact, axis=0) for a in (clock, states))
        else:
            end = jnp.asarray(float(scene.cycle) * old.cycles)
            section = _compiled_state(old, x, jnp.asarray(0), end)
            clock, states = np.zeros(0), np.asarray(ravel_pytree(section)[0])[None]
    else:
        touch = float(step.seen.touch)
        leg = max(0, int(np.searchsorted(clock, touch, side="right")) - 1) if stops else 0
        there = _compiled_state(old, x, jnp.asarray(leg), jnp.asarray(touch))
        Y = float(scene.position(there))
        hit = min(range(len(scene.stops)), key=lambda i: abs(_room(scene, i, Y)))
        u = np.asarray(ravel_pytree(there)[0])[None]
        period = float(scene.cycle) * old.cycles
        if not stops:
            clock, states, stops = np.array([touch]), u, [hit]
        else:
            clock, states = np.append(clock, touch), np.append(states, u, axis=0)
            order = np.argsort(np.mod(clock, period))
            clock, states = np.mod(clock, period)[order], states[order]
            stops = [[*stops, hit][i] for i in order]
    new = dataclasses.replace(old, stops=tuple(stops))
    start = np.asarray(new.pack(clock, states, value))
    scale = np.concatenate([np.ones(len(start) - 1), point.scale[-1:]])
    tangent = _tangent_at(new, start, scale)
    for sense in (1.0, -1.0):
        found = _advance(new, start, sense * tangent, scale, distance)
        if not bool(found.good):
            continue
        if found.seen.clearance > 0 and min(found.seen.approach, default=1.0) > 0:
            return orbit_of(new, found)
    raise ValueError(
        "Beyond this grazing there is no admissible motion with "
        f"{len(stops)} impacts at distance {distance:g}."
    )


def _room(scene: AbstractScene, i: int, Y: float) -> float:
    stop = scene.stops[i]
    return float(stop.gap) - stop.sign * Y
