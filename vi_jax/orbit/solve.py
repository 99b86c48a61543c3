"""The equations of an orbit from impact to impact, solved: their programs, and what they say."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._programs import compiled
from ..flow.choice import MethodLike
from ..scene.leaves import leaf, with_leaf
from .curve import Step, array_of, corrected, first_tangent
from .results import ORBIT_RESULTS, Orbit
from .shooting import Shooting, carrier, steps_of


@runtime_checkable
class Equations(Protocol):
    """What is solved here: an orbit's equations, or those with a condition beside them."""

    def residual(self, x: Any) -> Any:
        """What the unknowns `x` lack to be a solution."""
        ...

    def observe(self, x: Any) -> Any:
        """What is seen of a solution."""
        ...


def problem_of(
    orbit: Orbit, parameter: str, bounds: tuple[float, float], method: MethodLike
) -> tuple[Shooting, np.ndarray]:
    """The equations of an orbit from impact to impact, and the unknowns it gives."""
    scene = orbit.scene
    carried = carrier(method, orbit.method, scene)
    corners = [with_leaf(scene, parameter, end) for end in bounds]
    cycles = int(orbit.cycles)
    stops = tuple(int(i) for i in np.asarray(orbit.impact_stop) if i >= 0)
    if len(stops) != int(orbit.impacts):
        raise ValueError(
            f"Argument `orbit` must list all its {int(orbit.impacts)} impacts, but lists "
            f"{len(stops)}: find it with a larger `impact_log`."
        )
    steps = steps_of(carried, corners, orbit.state, cycles)
    problem = Shooting(scene, carried, orbit.state, cycles, stops, steps, (parameter,))
    section = float(scene.phase_at(0.0))
    clock = np.asarray(orbit.impact_phase)[: len(stops)] - section
    u, s = ravel_pytree(orbit.state)[0], 0.0
    states = []
    for i, place in enumerate(clock):
        u = _carry(problem, s, place, u)
        states.append(u)
        u, s = _bounce(problem, i, u), place
    value = leaf(scene, parameter)
    x = problem.pack(clock, jnp.stack(states) if states else u, [value])
    return problem, np.asarray(x)


@compiled
def _carry(problem: Shooting, s0, s1, u):
    return problem.flight(problem.scene, jnp.asarray(s0), jnp.asarray(s1), u)[0]


@compiled
def _bounce(problem: Shooting, leg, u):
    return problem.bounced(problem.scene, jnp.asarray(leg), u)


@compiled
def _compiled_advance(equations, x, tangent, scale, length) -> Step:
    def observe(x, tangent):
        return equations.observe(x)

    return corrected(equations.residual, observe, x, tangent, scale, length)


def advance(equations: Equations, x, tangent, scale, length) -> Step:
    """The solution at this length along a tangent from `x` (scaled unknowns)."""
    arguments = (jnp.asarray(a) for a in (x, tangent, scale, length))
    return array_of(_compiled_advance(equations, *arguments))


@compiled
def _compiled_observe(problem, x):
    return problem.observe(x)


def observe(problem: Shooting, x: np.ndarray) -> Any:
    """What is seen of a solution: multipliers, extremes, clearance, speeds of approach."""
    return array_of(_compiled_observe(problem, jnp.asarray(x)))


@compiled
def _compiled_tangent(equations, x, scale):
    return first_tangent(equations.residual, x, scale)


def tangent_at(equations: Equations, x: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The unit tangent of the solutions through `x`, in scaled unknowns."""
    return np.asarray(_compiled_tangent(equations, jnp.asarray(x), jnp.asarray(scale)))


@compiled
def state_at(problem: Shooting, x, leg, s):
    """The state at a clock reading within the flight after an impact."""
    return problem.state_at(x, leg, s)


@compiled
def jacobian_at(problem: Shooting, x):
    """The derivatives of the equations by all unknowns."""
    return jax.jacfwd(problem.residual)(x)


def located(
    problem: Shooting,
    here: Step,
    new: Step,
    scale: np.ndarray,
    test: Callable[[Step], float],
) -> Step | None:
    """The point between two, along the first one's tangent, at which a test is zero."""
    length = float(np.dot(here.tangent, (new.x - here.x) / scale))
    at: dict[float, Step] = {0.0: here, length: new}

    def value(s: float) -> float:
        if s not in at:
            at[s] = advance(problem, here.x, here.tangent, scale, s)
        return test(at[s])

    if not value(0.0) * value(length) <= 0:
        return None
    from scipy.optimize import brentq  # slow to load

    root = float(brentq(value, 0.0, length, xtol=1e-14, rtol=1e-14, maxiter=80))  # pyright: ignore
    value(root)
    # Where branches cross the corrector has no answer; a point beside it will do.
    good = [step for step in at.values() if bool(step.good)]
    return min(good, key=lambda step: abs(test(step)), default=None)


@compiled
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
    since = scene.phase_at(within[order])
    duration = jnp.asarray(seen.duration)
    return Orbit(
        scene=scene,
        method=problem.method,
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
