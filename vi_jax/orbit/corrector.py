"""Solutions of an orbit's equations along a curve: the corrector and its compiled programs, and a
solution as data.

A curve is the set of solutions of n - 1 equations in n unknowns (pseudo-arclength).
"""

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
from ..flow import AbstractMethod, ImplicitSteps, simulate
from ..machine import (
    AbstractMachine,
    frequency_ratio,
    own_modes,
    phase_at,
    scales_known,
    with_modes,
)
from .equations import Shooting, Unknowns
from .linear import solve
from .results import ORBIT_RESULTS, Orbit
from .tolerances import CORRECTED, LISTED, ROUGHLY

Vector = Float[Array, " n"]


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


def host_program(function: Callable[..., Any]) -> Callable[..., Any]:
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


@host_program
def _advance(problem: Shooting, x: Vector, tangent: Vector, scale: Vector, length: Scalar) -> Step:
    """Advance as `advance` does, without observations, by Newton's method on the equations and the
    plane. The parameter is one of the unknowns, so the Jacobian is not near singular at a fold."""

    def equations(y):
        return jnp.concatenate([problem.residual(y * scale), jnp.dot(tangent, y - y0)[None]])

    def newton(carry):
        y, before, count, *_ = carry
        jacobian, residual, _ = scaled_jacobian(equations, y)
        right_sides = jnp.stack([residual, jnp.zeros_like(y).at[-1].set(1.0)], axis=-1)
        move, along = solve(jacobian, right_sides).T
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


@host_program
def _observe(motion: Shooting, x):
    return motion.observe(x)


def observe(problem: Shooting, x: Unknowns) -> Any:
    """Return the observations of a solution (`Observed`), host-side."""
    return _observe(*problem.motion_at(x))


@host_program
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
    tangent = np.linalg.svd(jacobian_at(problem, x))[2][-1]
    return tangent * np.copysign(1.0, tangent[-1])


@host_program
def state_at(problem: Shooting, x, leg, s):
    return ravel_pytree(problem.state_at(x, leg, s))[0]


@host_program
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


# Flights have at least 16 steps, and 2 % more than the longest step demands (`steps_of`).
_ALMOST = 1.1


def steps_depend_on_motion(problem: Shooting) -> bool:
    """Return whether the number of steps depends on the motion, as its pace may be slow."""
    machine = problem.machine
    paced = machine.pace(jnp.zeros(()), problem.like) is not None
    return paced or not scales_known(machine) or isinstance(problem.method, ImplicitSteps)


@compiled
def fewest_steps(method: AbstractMethod, machine: AbstractMachine, like: State) -> Scalar | float:
    """Return the number of steps in a cycle that the longest step allows, here a real number."""
    return machine.cycle / method.longest(machine, jnp.zeros(()), like)


def method_of_runs(problem: Shooting, xs: Sequence[Unknowns]) -> AbstractMethod:
    """Return the method with about as many steps in a cycle as the flights of these solutions, if
    that number depends on the motion; host-side. Doubled steps need few programs."""
    method = problem.method
    if not steps_depend_on_motion(problem):
        return method
    for x in xs:
        machine, legs = problem.at(x), problem.lengths(x).max() / float(problem.period(x))
        needed = problem.steps / (legs * problem.cycles)
        while needed > _ALMOST * float(fewest_steps(method, machine, problem.like)):
            method = method.tighter()
    return method


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
        problem = dataclasses.replace(problem, method=method_of_runs(problem, [step.x]))
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
    problem = dataclasses.replace(problem, method=method_of_runs(problem, xs))
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
