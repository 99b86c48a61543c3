"""`find_orbit`: from a guess to a periodic motion that is judged and differentiable."""

import contextlib
import dataclasses
from math import pi
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._checks import count, flag
from .._numbers import concrete
from .._programs import compiled
from .._renamed import renamed
from ..flow import Run, simulate
from ..flow.arguments import check_leaves, refuse_arrays
from ..flow.beside import means
from ..flow.methods import MethodLike
from ..machine import AbstractMachine, Scene
from ..machine.event import is_autonomous
from ._forward_jacobian import forward_jacobian
from ._neutral import neutral
from ._root import root_of, shooting_matrix
from .cycle_map import CycleMap, adopted, cycle_map
from .floquet import multipliers_of
from .results import ORBIT_RESULTS, Orbit, trimmed
from .root_finders import AbstractRootFinder, Newton

# Places in a cycle at which an orbit can be searched.
_PLACES = 8

# Lanes searched at once: a batch lasts as long as its slowest lane.
_BATCH = 512

# A search that fails with an impact slower than this (or a turn that would be one) failed at a
# grazing: there the map's derivative is of the order of 1/V⁻ and jumps.
_SLOW = 0.02

# A motion drifts if so much of what it lacks to be periodic is what no other start would change.
_DRIFTS = 0.5


@renamed(scene="machine")
def find_orbit(
    machine: AbstractMachine,
    guess: Any,
    cycles: int | Int[Array, ""] = 1,
    *,
    root_finder: AbstractRootFinder | None = None,
    method: MethodLike = None,
    section: Any = None,
    impact_log: int = 8,
    throw: bool = False,
) -> Orbit:
    """Find the periodic motion of `machine` near `guess`.

    Works under `jit` and `vmap`. Everything in the orbit is differentiable by every leaf of the
    machine, in either mode and to any order, by the implicit function theorem: the search is not
    differentiated. Where no orbit was found the derivatives are NaN.

    **Arguments:**

    - `machine`: a `Scene` (ideal drive or motor, any crank, any stops), or one of your own whose
      independent variable counts its cycles.
    - `guess`: a state on the section from `machine.start(...)`, or another `Orbit`. With arrays of
      one leading axis in it, every guess is searched from in one compiled call.
    - `cycles`: period in drive cycles; static.
    - `root_finder`: `Newton()` (default) or `Gradient(optax_optimiser)`.
    - `method`: how the machine is carried: by default as by `simulate`, with the `"standard"`
      preset; but a `Scene` with a motor, whose preset has fixed steps, with
      `Adaptive(Tsit5(), rtol=1e-11)`.
    - `section`: crank angle of the section (radians) instead of the machine's own, which is 0. The
      guess and the orbit's states are on it; the search itself is done in eighths of a cycle
      away from it, where the guess's motion is farthest from its impacts, because the map jumps
      where an impact falls on the section.
    - `impact_log`: impacts of one cycle that the orbit can list.
    - `throw`: raise an error if no orbit is found, instead of only saying so in `result`.

    **Returns:** an `Orbit`. Its `result` tells an orbit of a smaller period, a search that found
    none, one that ended at a grazing, a motion that drifts and a guess that cannot be simulated
    from each other. Where something in the state is neutral (a multiplier is exactly 1), as the
    place of a body that slides freely or a number that is carried along, the orbits are a family:
    the one nearest to the guess is found, and derivatives are those across the family.

    **Raises:** `ValueError` or `TypeError` for arguments that cannot be used, before any work.
    """
    root_finder = Newton() if root_finder is None else root_finder
    if not isinstance(root_finder, AbstractRootFinder):
        raise TypeError(
            f"Argument `root_finder` must be `Newton(...)` or `Gradient(...)`, but got "
            f"{root_finder!r}. The integrator is the argument `method`."
        )
    impact_log, throw = count("impact_log", impact_log, least=1), flag("throw", throw)
    the_map = cycle_map(machine, cycles, method=method, section=section)
    if the_map.cycles % root_finder.arcs:
        raise ValueError(
            "Argument `root_finder` must have a number of arcs that divides the "
            f"{cycles} cycles, but has {root_finder.arcs} arcs."
        )
    guess = guess.state if isinstance(guess, Orbit) else guess
    state = adopted(the_map.machine, guess, "guess")
    _check_guess(the_map.machine, state)
    orbit = _find(the_map, state, root_finder, impact_log)
    if throw:
        orbit = eqx.error_if(orbit, ~orbit.successful, "No orbit was found; see `Orbit.result`.")
    return trimmed(orbit)


def _check_guess(machine: AbstractMachine, state: Any) -> None:
    """**Raises:** `ValueError` unless these are numbers, or rows of them for as many guesses."""
    check_leaves("guess", state)
    with contextlib.suppress(AttributeError, TypeError, LookupError):  # which `simulate` explains
        if not jnp.ndim(machine.position(state)):
            refuse_arrays("guess", "find_orbit", state)
    shapes = {jnp.shape(leaf) for leaf in jtu.tree_leaves(state)}
    if len(shapes) > 1 or len(next(iter(shapes))) > 1:
        raise ValueError(
            "Argument `guess` must hold scalars, or arrays of one length for as many guesses, but "
            f"holds shapes {sorted(shapes)}."
        )
    for path, leaf in jtu.tree_leaves_with_path(state):
        numbers = concrete(leaf)
        if numbers is not None and numbers.ndim == 0 and not np.isfinite(numbers):
            name = jtu.keystr(path).lstrip(".")
            raise ValueError(f"Argument `guess` must be finite, but its {name} is {numbers}.")


@compiled
def _find(the_map: CycleMap, guess: Any, root_finder: AbstractRootFinder, impact_log: int) -> Orbit:
    def one(guess):
        return _judged(the_map, guess, root_finder, impact_log)

    first = jtu.tree_leaves(guess)[0]
    if not first.ndim:
        return one(guess)
    return jax.lax.map(one, guess, batch_size=min(_BATCH, first.shape[0]))


def _run(the_map: CycleMap, state: Any, impact_log: int) -> Run:
    """The motion with its impacts: one program for the look at the guess and for that at the orbit,
    where they are as long."""
    places = _places(the_map, state)
    return simulate(
        the_map.machine, state, the_map.cycles, method=the_map.method,
        samples=0 if places == 1 else places, impact_log=impact_log, rests=the_map.rests,
    )  # fmt: skip


def _places(the_map: CycleMap, state: Any) -> int:
    """Places of a cycle that are looked at: of an autonomous machine only its section."""
    return 1 if is_autonomous(the_map.machine, state) else _PLACES


def _moved(the_map: CycleMap, guess: Any, impact_log: int) -> tuple[CycleMap, Any, Int[Array, ""]]:
    """Map, guess and their place (in eighths of a cycle) on the section to search on.

    The map jumps where an impact falls on its section, and no search gets across; so it is done
    where the guess's motion is farthest from its impacts.
    """
    machine = the_map.machine
    if not isinstance(machine, Scene):
        return the_map, guess, jnp.zeros((), jnp.int32)
    run = _run(the_map, guess, impact_log)
    assert run.samples is not None and run.impact_log is not None
    step = 2 * pi / _PLACES
    phase = run.impact_log.phase.ravel() - step * jnp.arange(_PLACES)[:, None]
    apart = jnp.abs(jnp.mod(phase + pi, 2 * pi) - pi)
    place = jnp.argmax(jnp.min(jnp.where(jnp.isnan(apart), pi, apart), axis=1))
    there = jtu.tree_map(lambda x: x[place], run.samples.state)
    lost = ~jnp.isfinite(sum(jtu.tree_leaves(there)))
    place = jnp.where(lost, 0, place)
    there = jtu.tree_map(lambda a, b: jnp.where(lost, a, b), guess, there)
    angle = machine.phase_at(jnp.asarray(step, phase.dtype) * place)
    moved = machine.at_section(jnp.where(angle > 2 * pi, angle - 2 * pi, angle))
    return dataclasses.replace(the_map, machine=moved), there, place


class _Seen(NamedTuple):
    """One arc followed from its start; all floats, cycle by cycle."""

    states: Float[Array, "cycles places states"]
    """States at each place of each cycle, the start left out."""
    jacobians: Float[Array, "cycles states states"]
    """Derivatives by the start of the states after each cycle."""
    y_min: Float[Array, " cycles"]
    y_max: Float[Array, " cycles"]
    clearance: Float[Array, " cycles"]
    duration: Float[Array, " cycles"]
    impacts: Float[Array, " cycles"]
    integrals: dict[str, Float[Array, " cycles"]]
    """Of the machine's averages, over the time of each cycle."""
    phase: Float[Array, "cycles log"]
    speed: Float[Array, "cycles log"]
    stop: Float[Array, "cycles log"]


def _follow(arc: CycleMap, state: Any, impact_log: int) -> _Seen:
    @forward_jacobian
    def seen(arc, state):
        x, unravel = ravel_pytree(state)

        def states(x):
            run = simulate(
                arc.machine, unravel(x), arc.cycles, method=arc.method, record="sections",
                rests=arc.rests,
            )  # fmt: skip
            return jnp.stack(jtu.tree_leaves(run.sections), axis=-1)[1:]

        # Apart from the motion: a program with second derivatives should hold no more than it must.
        jacobians = jax.jacfwd(states)(x)
        run = _run(arc, state, impact_log)
        log = run.impact_log
        assert log is not None and run.y_min is not None and run.y_max is not None
        met = run.sections if run.samples is None else run.samples.state
        places = jnp.stack(jtu.tree_leaves(met), axis=-1)[1:]
        places = places.reshape(arc.cycles, _places(arc, state), -1)
        assert run.clearance is not None and run.duration is not None
        return _Seen(
            places, jacobians, run.y_min, run.y_max, run.clearance, run.duration,
            run.impacts.astype(x.dtype),
            {name: mean * run.duration for name, mean in run.averages.items()},
            log.phase, log.speed, log.stop.astype(x.dtype),
        )  # fmt: skip

    return seen(arc, state)


def _judged(
    the_map: CycleMap, guess: Any, root_finder: AbstractRootFinder, impact_log: int
) -> Orbit:
    """The orbit found from one guess, with all that is said about it."""
    machine, arcs, cycles = the_map.machine, root_finder.arcs, the_map.cycles
    moved, start, place = _moved(the_map, jax.lax.stop_gradient(guess), impact_log)
    arc = dataclasses.replace(moved, cycles=cycles // arcs)
    root = root_of(arc, start, root_finder)
    x, unravel = root.arcs, ravel_pytree(guess)[1]
    seen = jax.vmap(lambda x: _follow(arc, unravel(x), impact_log))(x)
    # Derivatives by the very first state: those within an arc after those of the arcs before.
    passed, jacobians = jnp.eye(x.shape[1], dtype=x.dtype), []
    for i in range(arcs):
        jacobians.append(seen.jacobians[i] @ passed)
        passed = jacobians[-1][-1]
    jacobians = jnp.concatenate(jacobians)
    missing = seen.states[:, -1, -1] - jnp.roll(x, -1, axis=0)
    missing, ahead = missing.ravel(), shooting_matrix(seen.jacobians[:, -1])
    lost = neutral(ahead)
    error = jnp.max(jnp.abs(jnp.linalg.solve(ahead + lost.filled, missing)))
    drifts = jnp.linalg.norm(lost.unmet @ missing) > _DRIFTS * jnp.linalg.norm(missing)
    seen = jtu.tree_map(lambda a: a.reshape(cycles, *a.shape[2:]), seen)

    # Back on the section asked for, of which the last one met is the guess's.
    last = seen.states.shape[1] - 1
    sections = jnp.roll(jnp.take(seen.states, last - place, axis=1), 1, axis=0)
    least = _least_period(sections, error)
    monodromy = jacobians[least - 1]
    within = jnp.arange(cycles) < least
    turn = jnp.asarray(machine.cycle, x.dtype)
    hit = (seen.stop >= 0) & within[:, None]
    if last:
        phase = seen.phase + turn * (jnp.arange(cycles)[:, None] + place / _PLACES)
        phase = jnp.mod(phase, turn * least)
    else:  # each cycle as long as it lasts
        phase = seen.phase + (jnp.cumsum(seen.duration) - seen.duration)[:, None]
    phase = jnp.where(hit, phase, jnp.inf).ravel()
    order = jnp.argsort(phase)
    phase, speed, stop = (
        jnp.where(hit.ravel(), a.ravel(), none)[order]
        for a, none in ((phase, jnp.nan), (seen.speed, jnp.nan), (seen.stop, -1.0))
    )
    phase = machine.phase_at(phase)
    duration = jnp.sum(jnp.where(within, seen.duration, 0.0))
    sums = {name: jnp.sum(jnp.where(within, a, 0.0)) for name, a in seen.integrals.items()}
    clearance = jnp.min(jnp.where(within, seen.clearance, jnp.inf))
    found = (root.converged > 0) & (error < jnp.sqrt(jnp.finfo(x.dtype).eps) * 100)
    slowest = jnp.min(jnp.where(hit, seen.speed, jnp.inf))
    near = jnp.minimum(slowest, jnp.sqrt(2 * jnp.maximum(clearance, 0))) < _SLOW
    return Orbit(
        machine=machine,
        method=the_map.method,
        state=unravel(sections[0]),
        sections=jax.vmap(unravel)(sections),
        cycles=least,
        duration=duration,
        frequency_ratio=machine.frequency_ratio(duration / least),
        impact_phase=phase,
        impact_speed=speed,
        impact_stop=stop.astype(jnp.int32),
        impacts=jnp.sum(jnp.where(within, seen.impacts, 0.0)).astype(jnp.int32),
        y_min=jnp.min(jnp.where(within, seen.y_min, jnp.inf)),
        y_max=jnp.max(jnp.where(within, seen.y_max, -jnp.inf)),
        clearance=clearance,
        monodromy=monodromy,
        multipliers=multipliers_of(monodromy),
        residual=root.residual,
        error=error,
        iterations=root.steps.astype(jnp.int32),
        history=root.history,
        averages=means(sums, duration),
        result=_verdict(found, least < cycles, near, drifts, jnp.isnan(root.residual)),
    )


def _least_period(sections: Float[Array, "cycles states"], error: Array) -> Array:
    """The fewest cycles after which the sections repeat."""
    cycles = sections.shape[0]
    least = jnp.asarray(cycles, jnp.int32)
    slack = jnp.maximum(1e-6 if sections.dtype == jnp.float64 else 1e-3, 100 * error)
    for m in range(cycles - 1, 0, -1):
        if cycles % m == 0:
            apart = jnp.abs(sections - jnp.roll(sections, -m, axis=0))
            same = jnp.all(apart <= slack * (1 + jnp.abs(sections)))
            least = jnp.where(same, m, least)
    return least


def _verdict(
    found: Array, smaller: Array, near_grazing: Array, drifts: Array, no_run: Array
) -> ORBIT_RESULTS:
    where, results = ORBIT_RESULTS.where, ORBIT_RESULTS
    missed = where(near_grazing, results.grazing, results.no_orbit)
    missed = where(drifts, results.drifts, missed)
    missed = where(no_run, results.not_simulated, missed)
    return where(found, where(smaller, results.smaller_period, results.successful), missed)
