"""Solutions of an orbit's equations along a curve: the corrector, the programs that it needs, the
places at which a test is zero, and a solution as data.

A curve is the solutions of n - 1 equations in n unknowns (pseudo-arclength).
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
from ._shooting import Shooting, Unknowns
from .results import ORBIT_RESULTS, Orbit
from .root_finders import smallest_solution

Vector = Float[Array, " n"]

# The largest component of a last correction, in scaled unknowns.
_TOLERANCE = 1e-11

# Along a curve of double folds one direction changes nothing in the equations to first order: a
# singular value is zero within this share of the greatest. A choice.
_DOUBLE = 1e-6


class Step(NamedTuple):
    """A point of the curve, as one corrector finds it."""

    x: Any
    """The unknowns, the curve's parameter last."""
    tangent: Any
    """Unit tangent in scaled unknowns, in the sense of the step."""
    size: Scalar
    """Largest component of the last correction (scaled)."""
    iterations: Int[Array, ""]
    """Corrections that it took."""
    good: Flag
    """Whether the corrector converged."""
    seen: Any
    """What is observed there, an `Observed` of arrays of the host."""


def distance_along(problem: Shooting, here: Step, at: Step) -> float:
    """How far along the first one's tangent the second lies, in scaled unknowns."""
    return float(np.dot(here.tangent, (at.x - here.x) / problem.scale))


def on_host(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator: the function compiled, with arrays and floats of the host as arguments and arrays
    of the host as results, so that what follows costs no dispatch."""
    program = compiled(function)

    @functools.wraps(function)
    def called(*args: Any) -> Any:
        numbers = (float, np.ndarray, np.generic)
        args = tuple(jnp.asarray(np.asarray(a)) if isinstance(a, numbers) else a for a in args)
        return jax.tree.map(lambda x: np.asarray(x) if eqx.is_array(x) else x, program(*args))

    return called


def _jacobian(function: Callable[..., Any], x: Array) -> tuple[Array, Array]:
    """Derivative and value; unlike `jax.jacfwd`, where loops do not give one value for all."""

    def along(direction):
        return jax.jvp(function, (x,), (direction,))

    values, columns = jax.vmap(along)(jnp.eye(x.size, dtype=x.dtype))
    return columns.T, values[0]


@on_host
def _advanced(problem: Shooting, x: Vector, tangent: Vector, scale: Vector, length: Scalar) -> Step:
    """As `advance`. Newton's method on the equations and the plane: nothing is close to singular at
    a fold, since the parameter is one of the unknowns."""

    def equations(y):
        return jnp.concatenate([problem.residual(y * scale), jnp.dot(tangent, y - y0)[None]])

    def newton(carry):
        y, before, count, *_ = carry
        jacobian, missing = _jacobian(equations, y)
        both = jnp.stack([missing, jnp.zeros_like(y).at[-1].set(1.0)], axis=-1)
        if problem.is_double:
            move, along = smallest_solution(jacobian, both, _DOUBLE).T
        else:
            move, along = jnp.linalg.solve(jacobian, both).T
        return y - move, jnp.max(jnp.abs(move)), count + 1, along, before <= _TOLERANCE

    def going(carry):
        _, size, count, _, done = carry
        return ~done & (size < 10.0) & (count < 13)

    y0 = x / scale + length * tangent
    start = (y0, jnp.ones((), x.dtype), jnp.zeros((), jnp.int32), y0, jnp.zeros((), bool))
    # One correction more than it takes: the tangent is then that of the solution.
    y, size, count, along, _ = jax.lax.while_loop(going, newton, start)
    along = along / jnp.linalg.norm(along)
    # Rounding may keep the last correction above the tolerance where the curve is steep.
    good = (size <= 1e3 * _TOLERANCE) & jnp.all(jnp.isfinite(along))
    return Step(y * scale, along, size, count, good, problem.observe(y * scale))


def advance(problem: Shooting, x: Unknowns, tangent: Unknowns, length: float) -> Step:
    """The solution on the plane across a unit tangent, at a length along it from `x` (scaled)."""
    return _advanced(problem, x, tangent, problem.scale, float(length))


@on_host
def observe(problem: Shooting, x):
    """What is observed of a solution: multipliers, extremes, clearance, speeds of approach."""
    return problem.observe(x)


@on_host
def _lacks(problem: Shooting, x):
    ends = problem.lacks(x)[: problem.legs * problem.states]
    return ends.reshape(-1, problem.states) / problem.sizes[1:]


def off_by(problem: Shooting, x: Unknowns) -> float:
    """How much twice the steps change the ends of the flights, relative to their sizes."""
    finer = dataclasses.replace(problem, steps=2 * problem.steps)
    return float(np.max(np.abs(_lacks(finer, x) - _lacks(problem, x))))


def tangent_at(problem: Shooting, x: np.ndarray) -> np.ndarray:
    """The unit tangent (scaled) of the solutions through `x`, the last unknown rising."""
    null = np.linalg.svd(jacobian_at(problem, x) * problem.scale)[2]
    tangent = null[-1]
    if problem.is_double:  # of the plane one direction moves the parameters
        tangent = np.linalg.svd(null[-2:, -2:])[0][:, 0] @ null[-2:]
    return tangent * np.copysign(1.0, tangent[-1])


@on_host
def state_at(problem: Shooting, x, leg, s):
    """The numbers of the state at clock `s` within the leg of this number."""
    return ravel_pytree(problem.state_at(x, leg, s))[0]


@on_host
def jacobian_at(problem: Shooting, x):
    """The derivatives of the equations by all unknowns."""
    return _jacobian(problem.residual, x)[0]


# How far short of a place that has no solution (as a share of the step) one is looked for: choices.
_SHORT_OF = (1e-6, 1e-5, 1e-4, 1e-3)

# Places without a solution after which none closer is looked for: around a place at which the
# equations are singular, what is left to be told is the rounding of the corrector. A choice.
_TRIALS = 5

# How far beside a point where branches cross (by the scaled unknowns) it is looked at: a choice.
BESIDE = 1e-3

# At most so many times as far on each side.
MOST = 8

# A neighbour whose tangent is so many times as far from the middle one as half of them are lies on
# the curve that crosses: a choice, where equal distances leave 3 at most.
_ASTRAY = 10.0

# A zero beside a solution is not further from it (in the parameter's scale): a choice.
_CLOSE = 1e-2


class NoValueError(ArithmeticError):
    """A test has no value, because the corrector has no answer there."""


class _CloseError(ArithmeticError):
    """The corrector has had no answer so often that no closer place is to be had."""


def located(problem: Shooting, here: Step, new: Step, test: Callable[[Step], float]) -> Step | None:
    """The point between two, along the first one's tangent, at which a test that changes its sign
    between them is zero; `None` if there is none. `new` may lie on either side of `here`."""
    length = distance_along(problem, here, new)
    at: dict[float, Step] = {0.0: here, length: new}
    silent: list[float] = []

    def reached(s: float) -> Step:
        """There, or where there is no answer, as close to where branches cross, right beside."""
        step = advance(problem, here.x, here.tangent, s)
        for short in _SHORT_OF:
            if bool(step.good):
                break
            if short == _SHORT_OF[0]:
                silent.append(s)
            step = advance(problem, here.x, here.tangent, s - short * length)
        return step

    def value(s: float) -> float:
        if s not in at:
            if len(silent) >= _TRIALS:
                raise _CloseError
            at[s] = reached(s)
        found = test(at[s])
        if np.isnan(found):
            raise NoValueError
        return found

    from scipy.optimize import brentq  # slow to load

    # Where the test jumps, or has no value, the closest point to it has to do.
    options: Any = {"xtol": 1e-14, "rtol": 1e-14, "maxiter": 80}
    try:
        if not value(0.0) * value(length) <= 0:
            return None
        root = float(brentq(value, 0.0, length, full_output=True, disp=False, **options)[0])
        value(root)
    except NoValueError:
        return None
    except _CloseError:
        root = silent[-1]
    # Where branches cross, or a motion shrinks to rest, a point short of it has to do.
    for short in _SHORT_OF:
        if any(bool(at[s].good) for s in at if abs(s - root) <= short * abs(length)):
            break
        with contextlib.suppress(NoValueError, _CloseError):
            value(root - short * length)
    begin, good = test(here), [(s, step) for s, step in at.items() if bool(step.good)]

    def off(place: tuple[float, Step]) -> tuple[float, bool, float]:
        """How far a point is from it; of a test that jumps, the last one before is closest."""
        left = test(place[1])
        return abs(left), bool(left * begin < 0), abs(place[0] - root)

    return min(good, key=off)[1] if good else None


def zero_near(problem: Shooting, x: np.ndarray, test: Callable[[Step], float]) -> Step | None:
    """The solution near one at which a test is zero, by the secant method; `None` without."""
    found: list[Step] = []

    def value(shift: float) -> float:
        step = advance(problem, x, np.eye(x.size)[-1], shift)
        found.append(step)
        if not bool(step.good):
            raise NoValueError  # else the secant goes on with NaN, fifty times
        return test(step)

    from scipy.optimize import newton  # slow to load

    try:
        shift, report = newton(  # pyright: ignore[reportAssignmentType]
            value, 0.0, x1=1e-6, tol=1e-12, full_output=True, disp=False
        )
        near = report.converged and abs(shift) < _CLOSE and not np.isnan(value(float(shift)))
    except NoValueError:
        return None
    return found[-1] if near else None


def crossing(
    problem: Shooting, advance: Callable[[Any, Any, float], Step], here: Step, root: float,
    test: Callable[[Step], float], admits: Callable[[Step, float], bool] = lambda *_: True,
) -> Step | None:  # fmt: skip
    """The point of a curve at which a test is zero, where its equations are singular: where
    branches cross, or where an impact grazes. `None` if too few points were found, or no zero.

    Close to it the equations cannot be solved, but the curve passes through it smoothly, so that a
    polynomial through its neighbours tells where it is, and what the motion is there. Where the
    curve is found on the near side only, there are more neighbours of that one.

    **Arguments:** `root`, about how far the place is along the tangent; `admits`, of a point and
    its length, whether it belongs to this curve.
    """
    found: dict[float, Step] = {}

    def along(length: float) -> Step | None:
        step = advance(here.x, here.tangent, length)
        return step if bool(step.good) and admits(step, length) else None

    for side, wanted in ((-BESIDE, 3), (BESIDE, 6), (-BESIDE, 6)):
        for n in range(1, MOST + 1):
            if len(found) == wanted:
                break
            step = None if n * side in found else along(root + n * side)
            if step is not None:
                found[n * side] = step
    if len(found) < 6:
        return None
    tangents = np.stack([step.tangent for step in found.values()])
    aside = np.linalg.norm(tangents - np.median(tangents, axis=0), axis=1)
    along_it = aside <= _ASTRAY * np.median(aside) + 1e-9
    found = {x: step for (x, step), keep in zip(found.items(), along_it, strict=True) if keep}
    places, beside = np.array(list(found)), list(found.values())

    def through(values: Any) -> np.polynomial.Polynomial:
        return np.polynomial.Polynomial.fit(places, values, len(places) - 1)

    zeros = through([np.asarray(test(step)) for step in beside]).roots()
    zeros = zeros[np.abs(zeros.imag) < 1e-12].real
    if not zeros.size or np.abs(zeros).min() > BESIDE:
        return None
    place = zeros[np.argmin(np.abs(zeros))]

    def interpolated(get: Callable[[Step], Any]) -> np.ndarray:
        return np.stack([through(x)(place) for x in zip(*map(get, beside), strict=True)])

    x, tangent = interpolated(lambda step: step.x), interpolated(lambda step: step.tangent)
    return here._replace(x=x, tangent=tangent / np.linalg.norm(tangent), seen=observe(problem, x))


# Impacts of a cycle that are listed, hops of a chatter included: a choice. Others are counted only.
_LISTED = 32


class Hits(NamedTuple):
    """The impacts of a motion; of one that rests as the simulator finds them, hops included."""

    clock: np.ndarray
    """Clock of each impact that is listed, since the section."""
    speed: np.ndarray
    """V⁻ of each."""
    stop: np.ndarray
    """Number of the rigid stop of each."""
    number: int
    """How many there are in the period."""


@compiled
def _sections(problem: Shooting, x: Array):
    states = jax.vmap(lambda leg, s: problem.state_at(x, leg, s))(*problem.sections(x))
    return states, jnp.max(jnp.abs(problem.lacks(x)))


def sections_of(problem: Shooting, x: Unknowns) -> tuple[State, Scalar]:
    """The states on the sections, leaves (cycles,), and the largest component of the residual."""
    return _sections(problem, jnp.asarray(x))


def _first(problem: Shooting, x: Unknowns, sections: State | None = None) -> State:
    """The state on the first section of a solution, with the machine's own modes."""
    sections = sections_of(problem, x)[0] if sections is None else sections
    modes = problem.modes_in(int(problem.sections(jnp.asarray(x))[0][0]))
    state = jax.tree.map(lambda x: x[0], sections)
    return with_modes(state, own_modes(problem.machine, modes))


def hits_of(problem: Shooting, step: Step, state: State | None = None) -> Hits:
    """The impacts of a solution, whose state on the section may be known."""
    if problem.landings:
        state = _first(problem, step.x) if state is None else state
        count, *listed = map(np.asarray, _simulated(problem, jnp.asarray(step.x), state))
        clock, speed, stop = (a[listed[2] >= 0] for a in listed)
        return Hits(clock, speed, stop.astype(np.int32), int(count))
    # Along a branch an impact may move past the section: an orbit's clocks lie within its period.
    impacts, (clock, _, period) = np.asarray(problem.impacts, int), problem.values(step.x)
    stops = np.asarray([problem.events[i].number for i in impacts], np.int32)
    speed = np.asarray(step.seen.approach)[impacts]
    return Hits(np.mod(clock[impacts], period), speed, stops, len(impacts))


@compiled
def _simulated(problem: Shooting, x: Array, state: State) -> tuple[Array, ...]:
    """Number, clock, V⁻ and stop of the impacts."""
    machine, cycles = problem.at(x), problem.cycles
    run = simulate(machine, state, cycles, method=problem.method, impact_log=_LISTED, rests=True)
    log = run.impact_log
    assert log is not None
    begins = jnp.asarray(machine.cycle, x.dtype) * jnp.arange(cycles)
    clock = (log.phase + begins[:, None]).ravel()
    return jnp.sum(run.impacts), clock, log.speed.ravel(), log.stop.ravel()


def energies_of(problem: Shooting, steps: Sequence[Step]) -> np.ndarray:
    """The energy that impacts take in a cycle, in the mean of the period, at each step."""
    xs = [jnp.asarray(step.x) for step in steps]
    states = jax.tree.map(lambda *x: jnp.stack(x), *(_first(problem, x) for x in xs))
    return np.asarray(_lost(problem, jnp.stack(xs), states))


@compiled
def _lost(problem: Shooting, xs: Array, states: State) -> Array:
    def one(x, state):
        run = simulate(problem.at(x), state, problem.cycles, method=problem.method)
        assert run.impact_energy is not None
        return jnp.mean(run.impact_energy)

    return jax.vmap(one)(xs, states)


def orbit_of(problem: Shooting, step: Step) -> Orbit:
    seen, machine = step.seen, problem.at(step.x)
    sections, residual = sections_of(problem, step.x)
    state = _first(problem, step.x, sections)
    admissible = seen.admissible(range(len(problem.events)))
    hits = hits_of(problem, step, state)
    order = np.argsort(hits.clock)
    duration = jnp.asarray(seen.duration)
    return Orbit(
        machine=machine,
        method=problem.method,
        state=state,
        sections=sections,
        cycles=jnp.asarray(problem.cycles, jnp.int32),
        duration=duration,
        frequency_ratio=frequency_ratio(machine, duration / problem.cycles),
        impact_phase=jnp.asarray(phase_at(machine, hits.clock[order])),
        impact_speed=jnp.asarray(hits.speed[order]),
        impact_stop=jnp.asarray(hits.stop[order]),
        impacts=jnp.asarray(hits.number, jnp.int32),
        rests=jnp.asarray(len(problem.landings), jnp.int32),
        y_min=jnp.asarray(seen.y_min),
        y_max=jnp.asarray(seen.y_max),
        clearance=jnp.asarray(seen.nearest.room),
        monodromy=jnp.asarray(seen.monodromy),
        multipliers=jnp.asarray(seen.multipliers),
        residual=residual,
        error=jnp.asarray(step.size),
        iterations=jnp.asarray(step.iterations, jnp.int32),
        history=jnp.zeros((0,)),
        result=ORBIT_RESULTS.successful if admissible else ORBIT_RESULTS.inadmissible,
        averages={name: jnp.asarray(x) for name, x in seen.averages.items()},
    )
