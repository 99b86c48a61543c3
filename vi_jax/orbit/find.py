"""`find_orbit`: from a guess to a periodic motion that is judged and differentiable."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._checks import concrete, count, flag
from .._messages import warning_once
from .._programs import compiled
from .._types import Flag, Number, State
from ..flow import MethodLike, check_leaves, in_modes, means, shape_of
from ..machine import (
    AbstractMachine,
    HybridState,
    angles_in,
    bare,
    begin_modes,
    frequency_ratio,
    is_autonomous,
    modes_of,
    nearest_images,
    phase_at,
    raveled,
    replaced,
)
from ._arcs import (
    ObservedArc,
    by_the_first_state,
    error_of,
    found_and_seen,
    in_order,
    moved_from_impacts,
)
from ._cycle_map import CycleMap, adopted, axes_of, cycle_map
from .distinct import distance
from .floquet import multipliers_of
from .results import ORBIT_RESULTS, Orbit, trimmed
from .root_finders import AbstractRootFinder, Newton

# Lanes searched at once, a choice: a batch lasts as long as its slowest lane.
_BATCH = 512

# A search that fails with an impact slower than this (or a turn that would be one) failed at a
# grazing: there the map's derivative is of the order of 1/V⁻, here 50, and jumps. A choice.
_SLOW = 0.02


@warning_once
def find_orbit(
    machine: AbstractMachine,
    guess: State,
    cycles: int | Int[Array, ""] = 1,
    *,
    root_finder: AbstractRootFinder | None = None,
    method: MethodLike = None,
    section: Number | None = None,
    impact_log: int = 8,
    multipliers: bool = True,
    throw: bool = False,
) -> Orbit:
    """Find the periodic motion of `machine` near `guess`.

    Works under `jit` and `vmap`. Everything in the orbit is differentiable with respect to every
    leaf of the machine, in either mode and to any order, by the implicit function theorem: the
    search is not differentiated. Derivatives of a failed search are NaN.

    **Arguments:**

    - `machine`: a `Scene` (ideal drive or motor, any crank, any stops), or one of your own whose
      independent variable counts its cycles.
    - `guess`: a state on the section from `machine.start(...)`, or another `Orbit`. With arrays of
      one leading axis in it, every guess is searched from in one compiled call.
    - `cycles`: period in drive cycles; static.
    - `root_finder`: `Newton()` (default) or `Gradient(optax_optimiser)`.
    - `method`: how the motion is computed: by default by the `"standard"` preset, as in `simulate`,
      but for a `Scene` with a motor by `Adaptive(Tsit5(), rtol=1e-11)`.
    - `section`: crank angle of the section (radians) instead of the machine's own, which is 0. The
      guess and the orbit's states are on it. The search uses a section some eighths of a cycle
      later, where the guess's motion is farthest from its impacts, because the map jumps where an
      impact falls on the section.
    - `impact_log`: impacts of one cycle that the orbit can list.
    - `multipliers`: whether the orbit gets its multipliers and its monodromy matrix, else NaN.
      Their derivatives are second derivatives of the motion: without them the first gradient of
      anything else takes half the time.
    - `throw`: raise an error if no orbit is found, instead of only reporting it in `result`.

    **Returns:** an `Orbit`. Its `result` distinguishes an orbit of a smaller period, a search that
    found none, one that ended at a grazing or at an equilibrium, a motion that drifts and a guess
    that cannot be simulated. If a component is neutral (a multiplier is exactly 1), such as the
    position of a body that slides freely, the orbits are a family. The search then returns the one
    nearest to the guess, with derivatives across the family.

    **Raises:** `ValueError` or `TypeError` for arguments that cannot be used, before any work.
    """
    root_finder = Newton() if root_finder is None else root_finder
    if not isinstance(root_finder, AbstractRootFinder):
        raise TypeError(
            f"Argument `root_finder` must be `Newton(...)` or `Gradient(...)`, but got "
            f"{root_finder!r}. The integrator is the argument `method`."
        )
    impact_log, throw = count("impact_log", impact_log, least=1), flag("throw", throw)
    multipliers = flag("multipliers", multipliers)
    the_map = cycle_map(machine, cycles, method=method, section=section)
    if the_map.cycles % root_finder.arcs:
        raise ValueError(
            "Argument `root_finder` must have a number of arcs that divides the "
            f"{cycles} cycles, but has {root_finder.arcs} arcs."
        )
    guess = guess.state if isinstance(guess, Orbit) else guess
    state = adopted(the_map.machine, guess, "guess")
    _check_guess(the_map.machine, state)
    if modes_of(state) and root_finder.arcs > 1:
        raise ValueError(
            "Argument `root_finder` must have one arc for a machine with discrete modes, but has "
            f"{root_finder.arcs}."
        )
    orbit = _find(the_map, state, root_finder, impact_log, multipliers)
    if throw:
        orbit = eqx.error_if(orbit, ~orbit.successful, "No orbit was found; see `Orbit.result`.")
    return trimmed(orbit)


def _check_guess(machine: AbstractMachine, state: State) -> None:
    """**Raises:** `ValueError` unless this is a state, or as many of them in rows."""
    check_leaves("guess", state)
    axes = axes_of(machine, state)
    if axes > 1:
        raise ValueError(
            "Argument `guess` must be one state, or several along one axis, but its position has "
            f"{axes} axes."
        )
    many = axes > 0
    if not many:
        shape_of("guess", machine, bare(state))
    shapes = {jnp.shape(leaf)[:1] for leaf in jtu.tree_leaves(state)} if many else {()}
    if len(shapes) > 1:
        whole = sorted(jnp.shape(leaf) for leaf in jtu.tree_leaves(state))
        raise ValueError(
            "Argument `guess` must hold the numbers of a state, or rows of one length for as many "
            f"guesses, but holds shapes {whole}."
        )
    for path, leaf in jtu.tree_leaves_with_path(state):
        numbers = concrete(leaf)
        if numbers is not None and not many and not np.isfinite(numbers).all():
            name = jtu.keystr(path).lstrip(".")
            raise ValueError(f"Argument `guess` must be finite, but its {name} is {numbers}.")


@compiled
def _find(
    the_map: CycleMap, guess: State, root_finder: AbstractRootFinder, impact_log: int,
    multipliers: bool,
) -> Orbit:  # fmt: skip
    def one(guess):
        return _judged(the_map, guess, root_finder, impact_log, multipliers)

    first = jtu.tree_leaves(guess)[0]
    if not axes_of(the_map.machine, guess):
        return one(guess)
    return jax.lax.map(one, guess, batch_size=min(_BATCH, first.shape[0]))


def _judged(
    the_map: CycleMap, guess: State, root_finder: AbstractRootFinder, impact_log: int,
    multipliers: bool,
) -> Orbit:  # fmt: skip
    """The orbit found from one guess, with all that is said about it."""
    machine, cycles = the_map.machine, the_map.cycles
    guess = _in_later_modes(the_map, jax.lax.stop_gradient(guess))
    moved, start, place = moved_from_impacts(the_map, guess, impact_log)
    arc = dataclasses.replace(moved, cycles=cycles // root_finder.arcs)
    root, seen = found_and_seen(arc, start, root_finder, impact_log, multipliers)
    x = root.x
    jacobians = by_the_first_state(seen.jacobians)
    angles = angles_in(machine, bare(guess))
    error, drifts = error_of(angles, seen, x)
    seen = jtu.tree_map(lambda a: a.reshape(cycles, *a.shape[2:]), seen)

    # Back on the section asked for, of which the last one met is the guess's.
    last = seen.states.shape[1] - 1
    sections = jnp.roll(jnp.take(seen.states, last - place, axis=1), 1, axis=0)
    modes, told = None, sections
    if seen.modes is not None:
        modes = jnp.roll(jnp.take(seen.modes, last - place, axis=1), 1, axis=0)
        told = jnp.concatenate([sections, modes], axis=1)
    unit = jax.lax.stop_gradient(root.unit)
    least = _least_period(told, error, unit, angles)
    again = _comes_back(start, seen)
    monodromy = jacobians[least - 1] if multipliers else jnp.full_like(jacobians[0], jnp.nan)
    within = jnp.arange(cycles) < least
    hit = (seen.listed.stop >= 0) & within[:, None]
    listed = in_order(seen, hit, least, machine, place if last else None)
    duration = jnp.sum(jnp.where(within, seen.duration, 0.0))
    sums = {name: jnp.sum(jnp.where(within, a, 0.0)) for name, a in seen.integrals.items()}
    clearance = jnp.min(jnp.where(within, seen.clearance, jnp.inf))
    state = _at_section(guess, sections[0], None if modes is None else modes[0])
    still = _stands_still(machine, state, duration, unit)
    close = error < jnp.sqrt(jnp.finfo(x.dtype).eps) * 100 * unit
    found = (root.converged > 0) & again & ~still & close
    slowest = jnp.min(jnp.where(hit, seen.listed.speed, jnp.inf))
    slow = jnp.sqrt(2 * unit * jnp.maximum(clearance, 0))
    near = jnp.minimum(slowest, slow) < _SLOW * unit
    return Orbit(
        machine=machine,
        method=the_map.method,
        state=state,
        sections=jax.vmap(ravel_pytree(bare(guess))[1])(sections),
        cycles=least,
        duration=duration,
        frequency_ratio=frequency_ratio(machine, duration / least),
        impact_phase=phase_at(machine, listed.phase),
        impact_speed=listed.speed,
        impact_stop=listed.stop.astype(jnp.int32),
        impacts=jnp.sum(jnp.where(within, seen.impacts, 0.0)).astype(jnp.int32),
        rests=jnp.sum(jnp.where(within, seen.rests, 0.0)).astype(jnp.int32),
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
        result=_verdict(
            found, least < cycles, near, drifts, still, jnp.isnan(root.residual),
            (root.converged > 0) & ~again,
        ),
    )  # fmt: skip


def _in_later_modes(the_map: CycleMap, guess: State) -> State:
    """The guess in the modes in which the motion from it is a period later, which are more likely
    those of an orbit near it than those that a motion begins with."""
    if modes_of(guess) is None:
        return guess
    later = the_map(guess)
    there = jnp.all(jnp.isfinite(raveled(later)[0]))
    return jtu.tree_map(lambda a, b: jnp.where(there, a, b), replaced(later, bare(guess)), guess)


def _comes_back(start: State, seen: ObservedArc) -> Flag:
    """Whether a motion comes back to the modes in which it began: after as many cycles as were
    asked for."""
    modes = modes_of(start)
    if modes is None or seen.modes is None:
        return jnp.ones((), bool)
    return jnp.all(seen.modes[-1, -1] == jnp.stack(modes))


def _at_section(guess: State, section: Array, modes: Array | None) -> State:
    """A state on the section from its numbers, and the machine's own modes there."""
    state = ravel_pytree(bare(guess))[1](section)
    return state if modes is None else HybridState(state, tuple(modes))


def _least_period(
    sections: Float[Array, "cycles states"], error: Array, unit: Array, angles: np.ndarray | None
) -> Array:
    """The fewest cycles after which the sections repeat."""
    cycles = sections.shape[0]
    least = jnp.asarray(cycles, jnp.int32)
    slack = jnp.maximum(_slack(sections.dtype), 100 * error / unit)
    for m in range(cycles - 1, 0, -1):
        if cycles % m == 0:
            later = nearest_images(angles, jnp.roll(sections, -m, axis=0), sections)
            same = jnp.all(distance(later, sections, unit) <= slack)
            least = jnp.where(same, m, least)
    return least


def _stands_still(machine: AbstractMachine, state: State, duration: Array, unit: Array) -> Flag:
    """Whether an autonomous machine stands still in a state, at an equilibrium: as fast as it
    leaves the section it would get nowhere in its period."""
    own, state = modes_of(state), bare(state)
    if not is_autonomous(machine, state):
        return jnp.zeros((), bool)
    x = ravel_pytree(state)[0]
    s = jnp.zeros((), x.dtype)
    field = in_modes(machine, begin_modes(machine, s, state, own)).field
    passed = jnp.abs(ravel_pytree(field(s, state))[0]) * duration
    return jnp.all(passed <= _slack(x.dtype) * (unit + jnp.abs(x)))


def _slack(dtype: object) -> float:
    """What tells states from each other, see `distance`."""
    return 1e-6 if dtype == jnp.float64 else 1e-3


def _verdict(
    found: Array, smaller: Array, near_grazing: Array, drifts: Array, still: Array, no_run: Array,
    other_modes: Array,
) -> ORBIT_RESULTS:  # fmt: skip
    """The result of a search, from flags.

    **Arguments:** `found`, an orbit; `smaller`, its period; `near_grazing`, where the search ended;
    `drifts`, the motion; `still`, an equilibrium; `no_run`, the guess cannot be simulated;
    `other_modes`, the motion ends where it began, but in other modes.
    """
    where, results = ORBIT_RESULTS.where, ORBIT_RESULTS
    missed = where(near_grazing, results.grazing, results.no_orbit)
    missed = where(drifts, results.drifts, missed)
    missed = where(other_modes, results.other_modes, missed)
    missed = where(still, results.equilibrium, missed)
    missed = where(no_run, results.not_simulated, missed)
    return where(found, where(smaller, results.smaller_period, results.successful), missed)
