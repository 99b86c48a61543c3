"""`find_orbit`: from a guess to a differentiable periodic motion, with its stability.

The period is divided into arcs of whole cycles (one by default, see `Newton(arcs=...)`). The
unknowns x are the first states of the arcs. The residual F(x, p) is the difference from the end of
each arc to the begin of the next; p are the parameters of the machine.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .._checks import count, flag
from .._messages import count_of, warning_once
from .._programs import compiled
from .._types import Flag, Number, Scalar, Scalars, State, Vector
from ..flow import (
    ExactFlight,
    MethodLike,
    Run,
    SmoothMachine,
    check_leaves,
    in_modes,
    means,
    raised,
    row_sizes,
    shape_of,
    simulate,
    simulate_states,
)
from ..machine import (
    AbstractMachine,
    HybridState,
    angles_in,
    begin_modes,
    closed_contacts,
    frequency_ratio,
    in_rows,
    is_autonomous,
    modes_of,
    nearest_images,
    observed_later,
    phase_at,
    pressed_contacts,
    raveled,
    replaced,
    stops_of,
    with_modes,
    without_modes,
)
from .cycle_map import CycleMap, axes_of, batch_together, cycle_map, forward_jacobian, map_state
from .delay import as_chain, with_delay_error
from .results import ORBIT_RESULTS, Orbit, distance, multipliers_of, trimmed
from .root_finders import (
    AbstractRootFinder,
    Found,
    Newton,
    find_root,
    rounding,
    smallest_solution,
)


def _residual(
    arc: CycleMap, arcs: Float[Array, "arcs states"], unravel: Callable[[Vector], State],
    end: Callable[[State], State],
) -> Float[Array, "arcs states"]:  # fmt: skip
    """Return F, each arc's end minus the next arc's begin; the first arc follows the last. `end` is
    `arc` or a function of its values."""
    ends = jax.vmap(lambda x: raveled(end(unravel(x)))[0])(arcs)
    angles, next_starts = (
        angles_in(arc.machine, without_modes(unravel(arcs[0]))),
        jnp.roll(arcs, -1, axis=0),
    )
    return nearest_images(angles, ends, next_starts) - next_starts


def root_of(
    arc: CycleMap, guess: State, root_finder: AbstractRootFinder,
    end: Callable[[State], State] | None = None,
) -> Found:  # fmt: skip
    """Run a root finder from a guess, the first arc's start; the other arcs begin on the motion
    from there. The result's `x` holds the starts of the arcs in rows. The residual is relative to
    the sizes of the components. All numbers are floats."""
    x, unravel = raveled(guess)
    sizes = row_sizes(arc.machine, guess)
    arcs = x[None]
    if root_finder.arcs > 1:
        run = simulate(
            arc.machine, guess, arc.cycles * root_finder.arcs, method=arc.method, rests=arc.rests
        )
        sections = in_rows(run.sections)[: -1 : arc.cycles]
        arcs = jnp.where(jnp.isfinite(sections), sections, x)
    residual = lambda z: _residual(arc, z * sizes, unravel, end or arc) / sizes
    found = find_root(root_finder, residual, arcs / sizes, arc.cycles)
    found = found._replace(x=found.x * sizes)
    return jtu.tree_map(lambda a: a.astype(x.dtype), found)  # all floats, for `jvp`


def shooting_matrix(jacobians: Float[Array, "arcs states states"]) -> Float[Array, "all all"]:
    """Return ∂F/∂x. Its diagonal holds the derivatives of each arc's end with respect to its start;
    next to it are entries -1 for the next arc's start."""
    arcs, states, _ = jacobians.shape
    following = np.kron(np.roll(np.eye(arcs), 1, axis=1), np.eye(states))
    blocks = jnp.einsum("ab,aij->aibj", np.eye(arcs, dtype=jacobians.dtype), jacobians)
    return blocks.reshape(following.shape) - following.astype(jacobians.dtype)


def _start_change(
    jacobians: Float[Array, "arcs states states"], difference: Vector, sizes: Vector
) -> Vector:
    """Return the smallest change of the arcs' starts (by `sizes`) for this `difference` of F."""
    sizes = jnp.tile(sizes, len(jacobians))
    matrix = shooting_matrix(jacobians) * sizes / sizes[:, None]
    return sizes * smallest_solution(matrix, difference / sizes)


# Places in a cycle for the section of the search: a choice; each costs a sample of the guess.
_SAMPLES = 8

# A motion drifts if no change of the start would reduce F by this share: a choice.
_DRIFTS = 0.5


def _run(
    the_map: CycleMap, state: State, impact_log: int, by: Callable[..., Run] = simulate_states
) -> Run:
    """Simulate the motion with its impacts; by default, only the states have derivatives. Guess and
    orbit share a program if equally long."""
    places = _samples_per_cycle(the_map, state)
    return by(
        the_map.machine, state, the_map.cycles, method=the_map.method,
        samples=0 if places == 1 else places, impact_log=impact_log, rests=the_map.rests,
    )  # fmt: skip


@forward_jacobian
def _end_of_motion(the_map: CycleMap, state: State, impact_log: int) -> State:
    return _run(the_map, state, impact_log).last


def _with_jacobians(the_map: CycleMap, state: State, impact_log: int) -> tuple[Run, Array]:
    """Return the run and the derivatives of its sections but the first with respect to the state,
    by the program that also computes the derivatives of `_end_of_motion`."""
    x, unravel = raveled(jax.lax.stop_gradient(state))

    def along(direction):
        def sections(x):
            run = _run(the_map, unravel(x), impact_log)
            return in_rows(run.sections)[1:], run

        _, columns, run = jax.jvp(sections, (x,), (direction,), has_aux=True)
        return run, columns

    runs, columns = jax.vmap(along, out_axes=(0, -1))(jnp.eye(x.size, dtype=x.dtype))
    return jtu.tree_map(lambda leaf: leaf[0], runs), columns


def _shares_a_program(the_map: CycleMap, state: State) -> bool:
    """Return whether one program serves the search and the observation of a single guess. Its steps
    end on samples, which changes the motion by rounding, or not at all."""
    exact = isinstance(the_map.method, ExactFlight)
    return exact or _samples_per_cycle(the_map, state) == 1


def _samples_per_cycle(the_map: CycleMap, state: State) -> int:
    return 1 if is_autonomous(the_map.machine, without_modes(state)) else _SAMPLES


def move_section(
    the_map: CycleMap, guess: State, impact_log: int, shared: bool
) -> tuple[CycleMap, State, Int[Array, ""]]:
    """Return map, guess and their place (in eighths of a cycle) for the section of the search.

    The map jumps where an impact falls on its section, and no search crosses the jump. So the
    section is put where the guess's motion is farthest from its impacts, if it can be moved.
    """
    machine = the_map.machine
    here = observed_later(machine, jnp.zeros(()))
    if here is None:
        return the_map, guess, jnp.zeros((), jnp.int32)
    if shared:
        # With a section phase, also of 0, the guess and the orbit have one program.
        run, _ = _with_jacobians(dataclasses.replace(the_map, machine=here), guess, impact_log)
    else:
        run = _run(the_map, guess, impact_log, simulate)
    assert run.samples is not None and run.impact_log is not None
    step, half = machine.cycle / _SAMPLES, machine.cycle / 2
    phase = run.impact_log.phase.ravel() - step * jnp.arange(_SAMPLES)[:, None]
    time_to_impact = jnp.abs(jnp.mod(phase + half, machine.cycle) - half)
    place = jnp.argmax(jnp.min(jnp.where(jnp.isnan(time_to_impact), half, time_to_impact), axis=1))
    sampled = with_modes(run.samples.state, run.samples.modes)
    start = jtu.tree_map(lambda x: x[place], sampled)
    failed = ~jnp.all(jnp.isfinite(in_rows(without_modes(start), 0)))
    place = jnp.where(failed, 0, place)
    start = jtu.tree_map(lambda a, b: jnp.where(failed, a, b), guess, start)
    moved = observed_later(machine, jnp.asarray(step, phase.dtype) * place)
    return dataclasses.replace(the_map, machine=moved), start, place


class Impacts(NamedTuple):
    """The impacts of each cycle in order; all floats, NaN (`stop`: -1) after the last."""

    phase: Float[Array, "cycles log"]
    """Clock of each impact since its cycle began."""
    speed: Float[Array, "cycles log"]
    """V⁻ of each impact."""
    stop: Float[Array, "cycles log"]
    """Number of the rigid stop of each impact."""


class ObservedArc(NamedTuple):
    """An arc of the shooting from its start, cycle by cycle; all floats."""

    states: Float[Array, "cycles places states"]
    """States at each place of each cycle, without the start."""
    modes: Float[Array, "cycles places modes"] | None
    """The machine's own modes there, or `None`."""
    jacobians: Float[Array, "cycles states states"]
    """Derivatives of the states after each cycle with respect to the start."""
    listed: Impacts
    impacts: Float[Array, " cycles"]
    """Number of impacts, those beyond the list included."""
    rests: Float[Array, " cycles"]
    """Number of times that a body comes to rest on a stop."""
    y_min: Float[Array, " cycles"]
    y_max: Float[Array, " cycles"]
    clearance: Float[Array, " cycles"]
    duration: Float[Array, " cycles"]
    integrals: dict[str, Float[Array, " cycles"]]
    """Integrals of the machine's averages over the time of each cycle."""


def observe_arc(arc: CycleMap, state: State, impact_log: int, second: bool) -> ObservedArc:
    """Observe an arc that begins in `state`, with derivatives by columns (see `forward_jacobian`).
    `second`: whether `jacobians` are differentiated, as second derivatives of the motion."""

    # Separate from the motion, to keep a program with second derivatives small.
    def jacobians_from(arc, state):
        x, unravel = raveled(state)

        def states(x):
            run = simulate(
                arc.machine, unravel(x), arc.cycles, method=arc.method, record="sections",
                rests=arc.rests,
            )  # fmt: skip
            return in_rows(run.sections)[1:]

        return jax.jacfwd(states)(x)

    @forward_jacobian
    def observe(arc, state):
        jacobians = (
            jacobians_from(arc, state) if second else jnp.zeros((0,), raveled(state)[0].dtype)
        )
        return _observations(arc, state, _run(arc, state, impact_log, simulate), jacobians)

    found = observe(arc, state)
    if second:
        return found
    numbers, rest = eqx.partition((arc, state), eqx.is_array)
    constants = eqx.combine(jax.lax.stop_gradient(numbers), rest)
    return found._replace(jacobians=jacobians_from(*constants))


def _observations(arc: CycleMap, state: State, run: Run, jacobians: Array) -> ObservedArc:
    log, dtype = run.impact_log, jacobians.dtype
    assert log is not None and run.y_min is not None and run.y_max is not None
    states_met = run.sections if run.samples is None else run.samples.state
    modes_there = run.modes if run.samples is None else run.samples.modes
    places, modes = in_rows(states_met)[1:], None
    places = places.reshape(arc.cycles, _samples_per_cycle(arc, state), -1)
    if modes_there:  # batched as all else, see `forward_jacobian`
        modes = in_rows(modes_there)[1:].reshape(*places.shape[:2], -1) + 0 * places[..., :1]
    assert run.clearance is not None and run.duration is not None
    rests = jnp.zeros_like(run.y_min) if run.rests is None else run.rests.astype(dtype)
    return ObservedArc(
        places, modes, jacobians, Impacts(log.phase, log.speed, log.stop.astype(dtype)),
        run.impacts.astype(dtype), rests, run.y_min, run.y_max, run.clearance, run.duration,
        {name: mean * run.duration for name, mean in run.averages.items()},
    )  # fmt: skip


@eqx.filter_custom_jvp
def find_and_observe(
    arc: CycleMap, guess: State, root_finder: AbstractRootFinder, impact_log: int, second: bool,
    shared: bool,
) -> tuple[Found, ObservedArc]:  # fmt: skip
    """Return the root found from a guess (`root_of`), and the observations of its arcs, in rows.

    The derivative with respect to the numbers p of `arc` is that of the root x(p) of F, dx/dp =
    -(∂F/∂x)⁻¹ ∂F/∂p, by the implicit function theorem; the search is not differentiated. One
    program computes the derivatives of all observations.
    """
    end = (lambda state: _end_of_motion(arc, state, impact_log)) if shared else None
    root, (_, unravel) = root_of(arc, guess, root_finder, end), raveled(guess)

    def observe_from(x):
        state = unravel(x)
        if shared:
            return _observations(arc, state, *_with_jacobians(arc, state, impact_log))
        return observe_arc(arc, state, impact_log, second)

    return batch_together((root, jax.vmap(observe_from)(root.x)), root.x)


@find_and_observe.def_jvp
def _(primals, tangents):
    arc, guess, _, impact_log, second, _ = primals
    root, observed = find_and_observe(*primals)
    _, unravel = raveled(guess)
    zeros = jtu.tree_map(jnp.zeros_like, (root, observed))
    if not jtu.tree_leaves(tangents[0]):
        return (root, observed), zeros
    is_perturbed = jtu.tree_map(lambda t: t is not None, tangents[0], is_leaf=lambda t: t is None)
    moving, fixed = eqx.partition(arc, is_perturbed)
    numbers, unravel_numbers = ravel_pytree(moving)
    count = numbers.size

    def observe_moved(joined):
        moved = eqx.combine(unravel_numbers(joined[:count]), fixed)
        return observe_arc(moved, unravel(joined[count:]), impact_log, second)

    slopes = jax.vmap(lambda x: jax.jacfwd(observe_moved)(jnp.append(numbers, x)))(root.x)
    ends, along = slopes.states[:, -1, -1], ravel_pytree(tangents[0])[0]
    rate = (ends[..., :count] @ along).ravel()
    move = -_start_change(ends[..., count:], rate, row_sizes(arc.machine, guess))
    move = move.reshape(root.x.shape)
    # Without an orbit the derivative is NaN. A product, as the transpose of a choice would be zero.
    move = move * jnp.where(root.converged > 0, 1.0, jnp.nan)

    def rates(slope):
        by_starts = jax.vmap(lambda jacobian, x: jacobian @ x)(slope[..., count:], move)
        return slope[..., :count] @ along + by_starts

    return (root, observed), (zeros[0]._replace(x=move), jtu.tree_map(rates, slopes))


def chain_jacobians(jacobians: Float[Array, "arcs cycles n n"]) -> Float[Array, "all n n"]:
    """Return the derivatives of the states after all cycles with respect to the first state, from
    those with respect to the first state of each arc."""
    product, chained = jnp.eye(jacobians.shape[-1], dtype=jacobians.dtype), []
    for jacobian in jacobians:
        chained.append(jacobian @ product)
        product = chained[-1][-1]
    return jnp.concatenate(chained)


def error_of(
    angles: np.ndarray | None, observed: ObservedArc, x: Float[Array, "arcs states"], sizes: Vector
) -> tuple[Scalar, Flag]:
    """Return the largest component of Newton's next step from the arcs' starts `x`, relative to
    `sizes`, and whether the motion drifts. It drifts if F is not rounding, and no change of the
    starts reduces it much."""
    after = jnp.roll(x, -1, axis=0)
    residual = (nearest_images(angles, observed.states[:, -1, -1], after) - after).ravel()
    step = _start_change(observed.jacobians[:, -1], residual, sizes)
    remainder = residual - shooting_matrix(observed.jacobians[:, -1]) @ step
    sizes = jnp.tile(sizes, len(x))
    size = jnp.linalg.norm(residual / sizes)
    drifts = jnp.linalg.norm(remainder / sizes) > _DRIFTS * size
    drifts = drifts & (size > rounding(x.dtype))
    return jnp.max(jnp.abs(step / sizes)), drifts


def order_impacts(
    observed: ObservedArc, hit: Bool[Array, "cycles log"], least: Int[Array, ""],
    machine: AbstractMachine, place: Int[Array, ""] | None,
) -> Impacts:  # fmt: skip
    """Return the impacts of a period in one row, in order from the given section. `hit` flags those
    of the log that belong to it; `place` is the eighths of a cycle from the given section to that
    of the search, `None` for cycles of any length."""
    phase, cycles = observed.listed.phase, observed.duration.shape[0]
    if place is not None:
        turn = jnp.asarray(machine.cycle, phase.dtype)
        cycles_before = jnp.arange(cycles)[:, None] + place / _SAMPLES
        phase = jnp.mod(phase + turn * cycles_before, turn * least)
    else:
        phase = phase + (jnp.cumsum(observed.duration) - observed.duration)[:, None]
    phase = jnp.where(hit, phase, jnp.inf).ravel()
    order = jnp.argsort(phase)
    columns = ((phase, jnp.nan), (observed.listed.speed, jnp.nan), (observed.listed.stop, -1.0))
    return Impacts(*(jnp.where(hit.ravel(), a.ravel(), none)[order] for a, none in columns))


# Lanes of a batch, a choice: a batch lasts as long as its slowest lane.
_BATCH = 512

# A search that fails with an impact or a turn slower than this failed at a grazing. There the map's
# derivative is of the order of 1/V⁻, here 50, and jumps. A choice.
_SLOW = 0.02


@warning_once
def find_orbit(
    machine: AbstractMachine,
    guess: State = None,
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

    - `machine`: a `Scene` (ideal drive or motor, any crank, any stops), or another machine whose
      independent variable counts its cycles. One with delays is replaced by `delay_chain(machine)`,
      and a run with the whole history gives `Orbit.delay_error`.
    - `guess`: a state on the section, by default the machine's own start, or another `Orbit`. If
      its arrays have one leading axis, one compiled call searches from every guess.
    - `cycles`: period in drive cycles; static.
    - `root_finder`: `Newton()` (default) or `Gradient(optax_optimiser)`.
    - `method`: integration method: by default the `"standard"` preset, as in `simulate`, except
      `Adaptive(Tsit5(), rtol=1e-11)` for a `Scene` with a motor.
    - `section`: crank angle of the section (radians) of the guess and of the orbit's states; by
      default the machine's own, which is 0. The search uses a section some eighths of a cycle
      later, where the guess's motion is farthest from its impacts, because the map jumps at an
      impact on the section.
    - `impact_log`: number of impacts of one cycle that the orbit can list.
    - `multipliers`: whether to compute the multipliers and the monodromy matrix, else NaN. Their
      derivatives are second derivatives of the motion: without them the first gradient of anything
      else takes half the time.
    - `throw`: whether to raise an error if no orbit is found, instead of only reporting it in
      `result`.

    **Returns:** an `Orbit`. Its `result` distinguishes an orbit of a smaller period and the reasons
    of a failure: none found, a grazing, an equilibrium, a drift, a guess that cannot be simulated.
    If a component is neutral (a multiplier is exactly 1), such as the position of a body that
    slides freely, the orbits are a family. The search then returns the one nearest to the guess,
    relative to the size of each component, with derivatives across the family.

    **Raises:** `ValueError` or `TypeError` for invalid arguments, before any work.
    """
    root_finder = Newton() if root_finder is None else root_finder
    if not isinstance(root_finder, AbstractRootFinder):
        raise TypeError(
            f"Argument `root_finder` must be `Newton(...)` or `Gradient(...)`, but got "
            f"{root_finder!r}. The integrator is the argument `method`."
        )
    impact_log, throw = count("impact_log", impact_log, least=1), flag("throw", throw)
    multipliers = flag("multipliers", multipliers)
    machine, guess = as_chain(machine, guess)
    the_map = cycle_map(machine, cycles, method=method, section=section)
    if the_map.cycles % root_finder.arcs:
        raise ValueError(
            "Argument `root_finder` must have a number of arcs that divides "
            f"{count_of(the_map.cycles, 'cycle')}, but has {root_finder.arcs} arcs."
        )
    guess = the_map.machine.start() if guess is None else guess
    guess = guess.state if isinstance(guess, Orbit) else guess
    state = map_state(the_map.machine, guess, "guess")
    _check_guess(the_map.machine, state)
    if modes_of(state) and root_finder.arcs > 1:
        raise ValueError(
            "Argument `root_finder` must have one arc for a machine with discrete modes, but has "
            f"{root_finder.arcs}."
        )
    orbit = _find(the_map, state, root_finder, impact_log, multipliers)
    orbit = dataclasses.replace(orbit, multipliers=multipliers_of(orbit.monodromy))
    if throw:
        orbit = raised(orbit, ~orbit.successful, "The search failed", orbit.result)
    return with_delay_error(trimmed(orbit))


def _check_guess(machine: AbstractMachine, state: State) -> None:
    check_leaves("guess", state)
    axes = axes_of(machine, state)
    if axes > 1:
        raise ValueError(
            "Argument `guess` must be one state, or several along one axis, but its position has "
            f"{axes} axes."
        )
    is_batch = axes > 0
    if not is_batch:
        shape_of("guess", machine, without_modes(state))
    shapes = {jnp.shape(leaf)[:1] for leaf in jtu.tree_leaves(state)} if is_batch else {()}
    if len(shapes) > 1:
        all_shapes = sorted(jnp.shape(leaf) for leaf in jtu.tree_leaves(state))
        raise ValueError(
            "Argument `guess` must hold the numbers of a state, or rows of one length for as many "
            f"guesses, but holds shapes {all_shapes}."
        )


@compiled
def _find(
    the_map: CycleMap, guess: State, root_finder: AbstractRootFinder, impact_log: int,
    multipliers: bool,
) -> Orbit:  # fmt: skip
    def find_one(guess, shared=False):
        return _find_one(the_map, guess, root_finder, impact_log, multipliers, shared)

    first = jtu.tree_leaves(guess)[0]
    if not axes_of(the_map.machine, guess):
        return find_one(guess, _shares_a_program(the_map, guess))
    return jax.lax.map(find_one, guess, batch_size=min(_BATCH, first.shape[0]))


def _find_one(
    the_map: CycleMap, guess: State, root_finder: AbstractRootFinder, impact_log: int,
    multipliers: bool, shared: bool,
) -> Orbit:  # fmt: skip
    machine, cycles = the_map.machine, the_map.cycles
    guess = _with_later_modes(the_map, jax.lax.stop_gradient(guess))
    moved, start, place = move_section(the_map, guess, impact_log, shared)
    arc = dataclasses.replace(moved, cycles=cycles // root_finder.arcs)
    root, observed = find_and_observe(arc, start, root_finder, impact_log, multipliers, shared)
    x = root.x
    jacobians = chain_jacobians(observed.jacobians)
    angles = angles_in(machine, without_modes(guess))
    sizes = row_sizes(machine, start, in_rows(without_modes(observed.states), 3))
    error, drifts = error_of(angles, observed, x, sizes)
    observed = jtu.tree_map(lambda a: a.reshape(cycles, *a.shape[2:]), observed)

    # Return to the given section; the last one met is the guess's.
    last = observed.states.shape[1] - 1
    sections = jnp.roll(jnp.take(observed.states, last - place, axis=1), 1, axis=0)
    modes, rows = None, sections
    if observed.modes is not None:
        modes = jnp.roll(jnp.take(observed.modes, last - place, axis=1), 1, axis=0)
        rows = jnp.concatenate([sections, modes], axis=1)
        angles = None if angles is None else np.append(angles, np.zeros(modes.shape[1], bool))
    unit = jax.lax.stop_gradient(root.unit)
    scale = unit * (sizes if modes is None else jnp.append(sizes, jnp.ones(modes.shape[1])))
    least = _least_period(rows, error / unit, scale, angles)
    recurs = _modes_recur(start, observed)
    monodromy = jacobians[least - 1] if multipliers else jnp.full_like(jacobians[0], jnp.nan)
    within = jnp.arange(cycles) < least
    hit = (observed.listed.stop >= 0) & within[:, None]
    listed = order_impacts(observed, hit, least, machine, place if last else None)
    duration = jnp.sum(jnp.where(within, observed.duration, 0.0))
    sums = {name: jnp.sum(jnp.where(within, a, 0.0)) for name, a in observed.integrals.items()}
    clearance = jnp.min(jnp.where(within, observed.clearance, jnp.inf))
    unravel = ravel_pytree(without_modes(guess))[1]
    state = unravel(sections[0])
    state = state if modes is None else HybridState(state, tuple(modes[0]))
    is_still = is_equilibrium(machine, state, duration, unit * sizes)
    is_close = error < jnp.sqrt(jnp.finfo(x.dtype).eps) * 100 * unit
    is_found = (root.converged > 0) & recurs & ~is_still & is_close
    y_min = jnp.min(jnp.where(within, observed.y_min, jnp.inf))
    y_max = jnp.max(jnp.where(within, observed.y_max, -jnp.inf))
    # Speeds of a harmonic motion of this extent, once in a cycle: the greatest, and at `clearance`.
    fastest = jnp.pi * (y_max - y_min) * least / duration
    slow_turn = fastest * jnp.sqrt(4 * jnp.maximum(clearance, 0) / (y_max - y_min))
    slowest = jnp.min(jnp.where(hit, observed.listed.speed, jnp.inf))
    near_grazing = jnp.minimum(slowest, slow_turn) < _SLOW * fastest
    return Orbit(
        machine=machine,
        method=the_map.method,
        state=state,
        sections=jax.vmap(unravel)(sections),
        cycles=least,
        duration=duration,
        frequency_ratio=frequency_ratio(machine, duration / least),
        impact_phase=phase_at(machine, listed.phase),
        impact_speed=listed.speed,
        impact_stop=listed.stop.astype(jnp.int32),
        impacts=jnp.sum(jnp.where(within, observed.impacts, 0.0)).astype(jnp.int32),
        rests=jnp.sum(jnp.where(within, observed.rests, 0.0)).astype(jnp.int32),
        y_min=y_min,
        y_max=y_max,
        clearance=clearance,
        monodromy=monodromy,
        multipliers=jnp.full(len(monodromy), jnp.nan, jnp.result_type(x.dtype, jnp.complex64)),
        residual=root.residual,
        error=error,
        iterations=root.steps.astype(jnp.int32),
        history=root.history,
        averages=means(sums, duration),
        modes=() if modes is None else tuple(modes.T),
        result=_result_of(
            is_found, least < cycles, grazing=near_grazing, drifts=drifts, equilibrium=is_still,
            other_modes=(root.converged > 0) & ~recurs, not_simulated=jnp.isnan(root.residual),
        ),
    )  # fmt: skip


def _with_later_modes(the_map: CycleMap, guess: State) -> State:
    """Return the guess with the modes of its motion a period later. An orbit near it is more likely
    to have these than the modes with which a motion begins."""
    if modes_of(guess) is None:
        return guess
    later = the_map(guess)
    is_finite = jnp.all(jnp.isfinite(raveled(later)[0]))
    return jtu.tree_map(
        lambda a, b: jnp.where(is_finite, a, b), replaced(later, without_modes(guess)), guess
    )


def _modes_recur(start: State, observed: ObservedArc) -> Flag:
    modes = modes_of(start)
    if modes is None or observed.modes is None:
        return jnp.ones((), bool)
    return jnp.all(observed.modes[-1, -1] == jnp.stack(modes))


def _least_period(
    sections: Float[Array, "cycles states"], error: Array, unit: Vector, angles: np.ndarray | None
) -> Array:
    cycles = sections.shape[0]
    least = jnp.asarray(cycles, jnp.int32)
    slack = jnp.maximum(_state_tolerance(sections.dtype), 100 * error)
    for m in range(cycles - 1, 0, -1):
        if cycles % m == 0:
            later = nearest_images(angles, jnp.roll(sections, -m, axis=0), sections)
            same = jnp.all(distance(later, sections, unit) <= slack)
            least = jnp.where(same, m, least)
    return least


def is_equilibrium(machine: AbstractMachine, state: State, duration: Any, unit: Any) -> Flag:
    """Return whether an autonomous machine is at an equilibrium. At the rate of its state it would
    not move in its period, relative to `unit` + |state|."""
    machine_modes, state = modes_of(state), without_modes(state)
    if not is_autonomous(machine, state):
        return jnp.zeros((), bool)
    x = ravel_pytree(state)[0]
    s = jnp.zeros((), x.dtype)
    modes = begin_modes(machine, s, state, machine_modes)
    moved = jnp.abs(ravel_pytree(_with_rests(machine, s, state, modes).field(s, state))[0])
    return jnp.all(moved * duration <= _state_tolerance(x.dtype) * (unit + jnp.abs(x)))


def _with_rests(machine: AbstractMachine, s: Scalar, state: State, modes: Scalars) -> SmoothMachine:
    """Return the machine with the bodies held that rest on a stop in this state."""
    if not stops_of(machine):
        return in_modes(machine, modes)
    contact = closed_contacts(machine, s, state, modes)[0]
    return SmoothMachine(machine, *pressed_contacts(machine, s, state, modes, contact)[:2])


def _state_tolerance(dtype: object) -> float:
    return 1e-6 if dtype == jnp.float64 else 1e-3


def _result_of(found: Array, smaller: Array, **reasons: Array) -> ORBIT_RESULTS:
    """Return the result of a search; of several reasons for a failure the last in this order."""
    where, failure = ORBIT_RESULTS.where, ORBIT_RESULTS.no_orbit
    for name in ("grazing", "drifts", "other_modes", "equilibrium", "not_simulated"):
        failure = where(reasons[name], getattr(ORBIT_RESULTS, name), failure)
    successful = where(smaller, ORBIT_RESULTS.smaller_period, ORBIT_RESULTS.successful)
    return where(found, successful, failure)
