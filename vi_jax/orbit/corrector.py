"""Solutions of an orbit's equations along a curve: the corrector and its compiled programs, the
location of zeros of tests, and a solution as data.

A curve is the set of solutions of n - 1 equations in n unknowns (pseudo-arclength).
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._programs import compiled
from .._types import Flag, Scalar, State
from ..flow import simulate
from ..machine import frequency_ratio, own_modes, phase_at, with_modes
from .equations import Shooting, Unknowns
from .results import ORBIT_RESULTS, Orbit
from .root_finders import smallest_solution
from .tolerances import CORRECTED, LISTED, ROUGHLY

Vector = Float[Array, " n"]

# On a curve of double folds the equations do not change to first order in one direction: singular
# values below this share of the greatest are zero. A choice.
_DOUBLE = 1e-6


class Step(NamedTuple):
    """A point of the curve, as the corrector returns it."""

    x: Any
    """The unknowns, the curve's parameter last."""
    tangent: Any
    """Unit tangent in scaled unknowns, in the direction of the step."""
    size: Scalar
    """Largest component of the last correction (scaled)."""
    iterations: Int[Array, ""]
    """Number of corrections."""
    good: Flag
    """True if the corrector converged."""
    observed: Any
    """Observations of the solution, an `Observed` of host arrays."""


def distance_along(problem: Shooting, here: Step, at: Step) -> float:
    """Return the distance from the first step to the second along the first's tangent, scaled."""
    return float(np.dot(here.tangent, (at.x - here.x) / problem.scale))


def on_host(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function whose arguments and results are arrays and floats of the host, so that
    operations on the results cost no dispatch."""
    program = compiled(function)

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        numbers = (float, np.ndarray, np.generic)
        args = tuple(np.asarray(a) if isinstance(a, numbers) else a for a in args)
        return jax.tree.map(lambda x: np.asarray(x) if eqx.is_array(x) else x, program(*args))

    return call


def scaled_jacobian(function: Callable[..., Any], x: Array) -> tuple[Array, Array, Array]:
    """Return derivative and value, both divided by the largest derivative in each row, and those.
    With loops `jax.jacfwd` gives no common value of its columns."""

    def along(direction):
        return jax.jvp(function, (x,), (direction,))

    values, columns = jax.vmap(along)(jnp.eye(x.size, dtype=x.dtype))
    rows = jnp.max(jnp.abs(columns), axis=0)
    rows = jnp.where(rows > 0, rows, 1.0)
    return columns.T / rows[:, None], values[0] / rows, rows


@on_host
def _advance(problem: Shooting, x: Vector, tangent: Vector, scale: Vector, length: Scalar) -> Step:
    """Advance as `advance` does, without observations, by Newton's method on the equations and the
    plane. The parameter is one of the unknowns, so the Jacobian is not close to singular at a fold.
    """

    def equations(y):
        return jnp.concatenate([problem.residual(y * scale), jnp.dot(tangent, y - y0)[None]])

    def newton(carry):
        y, before, count, *_ = carry
        jacobian, residual, _ = scaled_jacobian(equations, y)
        right_sides = jnp.stack([residual, jnp.zeros_like(y).at[-1].set(1.0)], axis=-1)
        if problem.is_double:
            move, along = smallest_solution(jacobian, right_sides, _DOUBLE).T
        else:
            move, along = jnp.linalg.solve(jacobian, right_sides).T
        size = jnp.max(jnp.abs(move))
        # One correction more than needed, so that the tangent is that of the solution. On a steep
        # curve rounding may keep all corrections above the tolerance.
        done = (before <= CORRECTED) | ((before <= ROUGHLY) & (size >= before))
        return y - move, size, count + 1, along, done

    def continues(carry):
        _, size, count, _, done = carry
        return ~done & (size < 10.0) & (count < 13)

    y0 = x / scale + length * tangent
    start = (y0, jnp.ones((), x.dtype), jnp.zeros((), jnp.int32), y0, jnp.zeros((), bool))
    y, size, count, along, _ = jax.lax.while_loop(continues, newton, start)
    along = along / jnp.linalg.norm(along)
    good = (size <= ROUGHLY) & jnp.all(jnp.isfinite(along))
    return Step(y * scale, along, size, count, good, None)


def advance(problem: Shooting, x: Unknowns, tangent: Unknowns, length: float) -> Step:
    """Return the solution on the plane across a unit tangent, at `length` from `x` (scaled)."""
    step = _advance(problem, x, tangent, problem.scale, float(length))
    return step._replace(observed=observe(problem, step.x))


# These programs take the equations of the motion alone, so that a branch and all its curves share
# them.


@on_host
def _observe(motion: Shooting, x):
    return motion.observe(x)


def observe(problem: Shooting, x: Unknowns) -> Any:
    """Return the observations of a solution (`Observed`), host-side."""
    return _observe(*problem.motion_at(x))


@on_host
def _residual(motion: Shooting, x, steps):
    ends = motion.motion_residual(x, steps)[: motion.legs * motion.states]
    return ends.reshape(-1, motion.states) / motion.sizes[1:]


def step_error(problem: Shooting, x: Unknowns) -> float:
    """Return the relative change of the ends of the flights by doubling the steps."""
    # With `steps` as an argument, equations that differ in their number share one program.
    motion, x = problem.motion_at(x)
    shared, steps = dataclasses.replace(motion, steps=1), float(motion.steps)
    return float(np.max(np.abs(_residual(shared, x, 2 * steps) - _residual(shared, x, steps))))


def tangent_at(problem: Shooting, x: np.ndarray) -> np.ndarray:
    """Return the scaled unit tangent of the solutions through `x`, last component positive."""
    null = np.linalg.svd(jacobian_at(problem, x))[2]
    tangent = null[-1]
    if problem.is_double:  # one direction of the plane moves the parameters
        tangent = np.linalg.svd(null[-2:, -2:])[0][:, 0] @ null[-2:]
    return tangent * np.copysign(1.0, tangent[-1])


@on_host
def state_at(problem: Shooting, x, leg, s):
    return ravel_pytree(problem.state_at(x, leg, s))[0]


@on_host
def _jacobian_at(problem: Shooting, x, scale):
    jacobian, _, rows = scaled_jacobian(lambda y: problem.residual(y * scale), x / scale)
    return jacobian, rows


def jacobian_and_rows(problem: Shooting, x: Unknowns) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobian of `jacobian_at`, and the numbers by which its rows are divided."""
    return _jacobian_at(problem, x, problem.scale)


def jacobian_at(problem: Shooting, x: Unknowns) -> np.ndarray:
    """Return the Jacobian with respect to all scaled unknowns. Each row is divided by its largest
    entry, so that no unit matters."""
    return jacobian_and_rows(problem, x)[0]


# Distances, as shares of the step, to retry before a place without a solution: choices.
_RETRIES = (1e-6, 1e-5, 1e-4, 1e-3)

# A test is zero below this share of its largest value. A place is accurate to the second number in
# scaled unknowns, or to the last correction. Choices: closer, rounding would be resolved.
_ZERO, _PLACED = 1e-13, 1e-13

# The search stops after this number of places without a solution: around a singularity of the
# equations only the corrector's rounding would be resolved. A choice.
_TRIALS = 5

# Distance of samples from a point where branches cross, in scaled unknowns: a choice.
SPACING = 1e-3

# At most so many times that distance on each side.
MOST_SAMPLES = 8

# A neighbour lies on the crossing curve if its tangent deviates from the median by more than this
# multiple of the median deviation. A choice: equal distances give 3 at most.
_OUTLIER = 10.0

# A zero near a solution is at most this far from it (in the parameter's scale): a choice.
_CLOSE = 1e-2


class NoValueError(ArithmeticError):
    """A test has no value, because the corrector did not converge."""


class _TooCloseError(ArithmeticError):
    """The corrector has failed so often that no closer place can be reached."""


def locate_zero(
    problem: Shooting, here: Step, new: Step, test: Callable[[Step], float],
    known: dict[float, Step] | None = None,
) -> Step | None:  # fmt: skip
    """Return the point between two, along the first one's tangent, at which a test that changes its
    sign between them is zero, or `None`. `new` may lie on either side of `here`. Points between
    them, by their distance from `here`, are taken from `known` and added to it."""
    length = distance_along(problem, here, new)
    points = {} if known is None else known
    points |= {0.0: here, length: new}
    failed: list[float] = []
    tested: dict[float, float] = {}
    bracket: dict[bool, float] = {}

    def solve_at(s: float) -> Step:
        """Return the solution there; if none, as at crossing branches, the one just before it."""
        step = advance(problem, here.x, here.tangent, s)
        for share in _RETRIES:
            if bool(step.good):
                break
            if share == _RETRIES[0]:
                failed.append(s)
            step = advance(problem, here.x, here.tangent, s - share * length)
        return step

    def value(s: float) -> float:
        if s not in points:
            if len(failed) >= _TRIALS:
                raise _TooCloseError
            points[s] = solve_at(s)
        if s not in tested:
            tested[s] = test(points[s])
        found = tested[s]
        if np.isnan(found):
            raise NoValueError
        bracket[found > 0] = s
        resolution = max(min(ROUGHLY, float(points[end].size)) for end in bracket.values())
        close = len(bracket) == 2 and abs(bracket[True] - bracket[False]) <= resolution
        return 0.0 if close or abs(found) <= _ZERO * max(map(abs, tested.values())) else found

    from scipy.optimize import brentq  # slow to load

    # If the test jumps or has no value, use the closest point.
    options: Any = {"xtol": _PLACED, "rtol": 1e-14, "maxiter": 80}
    try:
        if not value(0.0) * value(length) <= 0:
            return None
        ends = _known_bracket([s for s, step in points.items() if bool(step.good)], length, value)
        root = float(brentq(value, *ends, full_output=True, disp=False, **options)[0])
        value(root)
    except NoValueError:
        return None
    except _TooCloseError:
        root = failed[-1]
    # At crossing branches, or if a motion shrinks to rest, use a point just before it.
    for share in _RETRIES:
        if any(bool(points[s].good) for s in tested if abs(s - root) <= share * abs(length)):
            break
        with contextlib.suppress(NoValueError, _TooCloseError):
            value(root - share * length)

    def rank(s: float) -> tuple[float, bool, float]:
        """Rank a point by its distance from zero; if the test jumps, prefer the last one before."""
        return abs(tested[s]), bool(tested[s] * tested[0.0] < 0), abs(s - root)

    good = [s for s in tested if bool(points[s].good)]
    return points[min(good, key=rank)] if good else None


def _known_bracket(
    places: list[float], length: float, value: Callable[[float], float]
) -> tuple[float, float]:
    places = sorted({0.0, *places, length}, key=abs)
    low, high, begin = 0, len(places) - 1, value(0.0)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if value(places[middle]) * begin > 0 else (low, middle)
    return places[low], places[high]


# A dip of a test within a step falls to this share of its values at the ends, by a parabola, or
# beyond zero: a choice.
_DIPS = 0.1


def dip_of(places: list[float], values: list[float]) -> float | None:
    """Return the place of the extremum of the parabola through three points, if their values have
    one sign and the parabola comes near zero, or beyond, between the last two; else `None`."""
    steps, heights = np.diff(places), np.sign(values[1]) * np.array(values)
    if not (np.isfinite(heights).all() and heights.min() > 0 and steps.min() > 0):
        return None
    before, after = np.diff(heights) / steps
    curvature = (after - before) / steps.sum()
    slope = before + curvature * steps[0]
    if not curvature > 0:
        return None
    shift = -0.5 * slope / curvature
    is_low = heights[1] + 0.5 * slope * shift < _DIPS * heights[1:].min()
    return float(places[1] + shift) if 0 < shift < steps[1] and is_low else None


def find_zero_near(problem: Shooting, x: np.ndarray, test: Callable[[Step], float]) -> Step | None:
    """Return the solution near one at which a test is zero, by the secant method, or `None`."""
    found: list[Step] = []

    def value(shift: float) -> float:
        step = advance(problem, x, np.eye(x.size)[-1], shift)
        found.append(step)
        if not bool(step.good):
            raise NoValueError  # else the secant method continues with NaN, fifty times
        return test(step)

    from scipy.optimize import newton  # slow to load

    try:
        shift, report = newton(  # pyright: ignore[reportAssignmentType]
            value, 0.0, x1=1e-6, tol=1e-12, full_output=True, disp=False
        )
        is_near = report.converged and abs(shift) < _CLOSE and not np.isnan(value(float(shift)))
    except NoValueError:
        return None
    return found[-1] if is_near else None


def crossing(
    problem: Shooting, advance: Callable[[Any, Any, float], Step], here: Step, root: float,
    test: Callable[[Step], float], admits: Callable[[Step, float], bool] = lambda *_: True,
) -> Step | None:  # fmt: skip
    """Return the point of a curve at which a test is zero and the equations are singular: where
    branches cross, or where an impact grazes. `None` with too few points or without a zero.

    The equations cannot be solved close to it, but the curve passes through it smoothly. A
    polynomial through its neighbours gives the place and the motion there. If the curve is found on
    the near side only, more neighbours of that side are taken.

    **Arguments:** `root`, the approximate distance of the place along the tangent; `admits`, a
    function of a point and its distance that returns whether the point belongs to this curve.
    """
    found: dict[float, Step] = {}

    def solve_at(length: float) -> Step | None:
        step = advance(here.x, here.tangent, length)
        return step if bool(step.good) and admits(step, length) else None

    for side, wanted in ((-SPACING, 3), (SPACING, 6), (-SPACING, 6)):
        for n in range(1, MOST_SAMPLES + 1):
            if len(found) == wanted:
                break
            step = None if n * side in found else solve_at(root + n * side)
            if step is not None:
                found[n * side] = step
    if len(found) < 6:
        return None
    tangents = np.stack([step.tangent for step in found.values()])
    deviations = np.linalg.norm(tangents - np.median(tangents, axis=0), axis=1)
    on_curve = deviations <= _OUTLIER * np.median(deviations) + 1e-9
    found = {x: step for (x, step), keep in zip(found.items(), on_curve, strict=True) if keep}
    places, neighbours = np.array(list(found)), list(found.values())

    def polynomial(values: Any) -> np.polynomial.Polynomial:
        return np.polynomial.Polynomial.fit(places, values, len(places) - 1)

    zeros = polynomial([np.asarray(test(step)) for step in neighbours]).roots()
    zeros = zeros[np.abs(zeros.imag) < 1e-12].real
    if not zeros.size or np.abs(zeros).min() > SPACING:
        return None
    place = zeros[np.argmin(np.abs(zeros))]

    def interpolated(get: Callable[[Step], Any]) -> np.ndarray:
        return np.stack([polynomial(x)(place) for x in zip(*map(get, neighbours), strict=True)])

    x, tangent = interpolated(lambda step: step.x), interpolated(lambda step: step.tangent)
    return here._replace(
        x=x, tangent=tangent / np.linalg.norm(tangent), observed=observe(problem, x)
    )


class Hits(NamedTuple):
    """The impacts of a motion; for one that rests those of a simulation, hops included."""

    clock: np.ndarray
    """Clock of each listed impact, since the section."""
    speed: np.ndarray
    """V⁻ of each listed impact."""
    stop: np.ndarray
    """Number of the rigid stop of each listed impact."""
    number: int
    """Number of impacts in the period."""


@compiled
def _sections(motion: Shooting, x: Array):
    sections = motion.sections(x)
    residual = jnp.max(jnp.abs(motion.motion_residual(x)))
    return motion.on_sections(x, sections), sections, residual


def sections_at(problem: Shooting, x: Unknowns) -> tuple[State, tuple[Array, Array], Scalar]:
    """Return the states on the sections, leaves (cycles,); the leg and the clock of each; and the
    largest residual component."""
    motion, x = problem.motion_at(x)
    return _sections(motion, jnp.asarray(x))


def since_section(problem: Shooting, x: Unknowns, clock: Any) -> Any:
    """Return clocks counted from the first section, within the period."""
    begin = float(sections_at(problem, x)[1][1][0]) if problem.omits_sections else 0.0
    return np.mod(clock - begin, float(problem.period(x)))


def _first_state(problem: Shooting, x: Unknowns) -> State:
    """Return the state on the first section of a solution, with the machine's own modes."""
    sections, (legs, _), _ = sections_at(problem, x)
    modes = problem.modes_in(int(legs[0])) if problem.modes[0] else ()
    state = jax.tree.map(lambda x: x[0], sections)
    return with_modes(state, own_modes(problem.machine, modes))


def hits_of(problem: Shooting, step: Step, state: State | None = None) -> Hits:
    """Return the impacts of a solution; `state`, if known, is its state on the section."""
    if problem.landings:
        state = _first_state(problem, step.x) if state is None else state
        count, *listed = map(np.asarray, _simulate_impacts(problem, jnp.asarray(step.x), state))
        clock, speed, stop = (a[listed[2] >= 0] for a in listed)
        return Hits(clock, speed, stop.astype(np.int32), int(count))
    # Along a branch an impact may move past the section; an orbit's clocks lie within its period.
    impacts, clock = np.asarray(problem.impacts, int), problem.values(step.x)[0]
    stops = np.asarray([problem.events[i].number for i in impacts], np.int32)
    speed = np.asarray(step.observed.approach)[impacts]
    return Hits(since_section(problem, step.x, clock[impacts]), speed, stops, len(impacts))


@compiled
def _simulate_impacts(problem: Shooting, x: Array, state: State) -> tuple[Array, ...]:
    """Return the number of impacts, and their clocks, V⁻ and stops."""
    machine, cycles = problem.at(x), problem.cycles
    run = simulate(machine, state, cycles, method=problem.method, impact_log=LISTED, rests=True)
    log = run.impact_log
    assert log is not None
    begins = jnp.asarray(machine.cycle, x.dtype) * jnp.arange(cycles)
    if problem.autonomous:
        assert run.duration is not None
        begins = jnp.cumsum(run.duration) - run.duration
    clock = (log.phase + begins[:, None]).ravel()
    return jnp.sum(run.impacts), clock, log.speed.ravel(), log.stop.ravel()


def energies_of(problem: Shooting, steps: Sequence[Step]) -> np.ndarray:
    """Return the energy that impacts take in a cycle, averaged over the period, at each step."""
    xs = [jnp.asarray(step.x) for step in steps]
    states = jax.tree.map(lambda *x: jnp.stack(x), *(_first_state(problem, x) for x in xs))
    return np.asarray(_impact_energies(problem, jnp.stack(xs), states))


@compiled
def _impact_energies(problem: Shooting, xs: Array, states: State) -> Array:
    def energy(x, state):
        run = simulate(problem.at(x), state, problem.cycles, method=problem.method)
        assert run.impact_energy is not None
        return jnp.mean(run.impact_energy)

    return jax.vmap(energy)(xs, states)


def orbit_of(problem: Shooting, step: Step) -> Orbit:
    observed, machine = step.observed, problem.at(step.x)
    sections, (legs, _), residual = sections_at(problem, step.x)
    modes = [own_modes(machine, problem.modes_in(int(leg))) for leg in legs if problem.modes[0]]
    modes = tuple(map(jnp.asarray, zip(*modes, strict=True)))
    state = with_modes(jax.tree.map(lambda x: x[0], sections), tuple(x[0] for x in modes))
    admissible = observed.admissible(range(len(problem.events)))
    hits = hits_of(problem, step, state)
    order = np.argsort(hits.clock)
    duration = jnp.asarray(observed.duration)
    return Orbit(
        machine=machine,
        method=problem.method,
        state=state,
        sections=sections,
        modes=modes,
        cycles=jnp.asarray(problem.cycles, jnp.int32),
        duration=duration,
        frequency_ratio=frequency_ratio(machine, duration / problem.cycles),
        impact_phase=jnp.asarray(phase_at(machine, hits.clock[order])),
        impact_speed=jnp.asarray(hits.speed[order]),
        impact_stop=jnp.asarray(hits.stop[order]),
        impacts=jnp.asarray(hits.number, jnp.int32),
        rests=jnp.asarray(len(problem.landings), jnp.int32),
        y_min=jnp.asarray(observed.y_min),
        y_max=jnp.asarray(observed.y_max),
        clearance=jnp.asarray(observed.nearest.margin),
        monodromy=jnp.asarray(observed.monodromy),
        multipliers=jnp.asarray(observed.multipliers),
        residual=residual,
        error=jnp.asarray(step.size),
        iterations=jnp.asarray(step.iterations, jnp.int32),
        history=jnp.zeros((0,)),
        result=ORBIT_RESULTS.successful if admissible else ORBIT_RESULTS.inadmissible,
        averages={name: jnp.asarray(x) for name, x in observed.averages.items()},
    )
