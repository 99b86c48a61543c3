"""The arcs of a shooting: followed from where they begin, and what is observed on them.

`find_orbit` cuts the period of a motion into arcs of whole cycles (one, unless `Newton(arcs=...)`
says otherwise). The unknowns are the states in which they begin; each has to end where the next one
begins.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .._types import Flag, Scalar, State
from ..flow import Run, simulate
from ..machine import (
    AbstractMachine,
    Scene,
    bare,
    in_rows,
    is_autonomous,
    nearest_images,
    raveled,
    with_modes,
)
from ._cycle_map import CycleMap, forward_jacobian, tied
from ._neutral import smallest_solution
from ._root import root_of, shooting_matrix
from .root_finders import AbstractRootFinder, Found

# Places in a cycle at which an orbit can be searched: a choice; each costs a sample of the guess.
_PLACES = 8

# A motion drifts if so much of what it lacks to be periodic is what no other start would change: by
# choice, most of it.
_DRIFTS = 0.5


def _run(the_map: CycleMap, state: State, impact_log: int) -> Run:
    """The motion with its impacts. The look at the guess and that at the orbit ask for the same
    program, if they are as long."""
    places = _places(the_map, state)
    return simulate(
        the_map.machine, state, the_map.cycles, method=the_map.method,
        samples=0 if places == 1 else places, impact_log=impact_log, rests=the_map.rests,
    )  # fmt: skip


def _places(the_map: CycleMap, state: State) -> int:
    """At how many places of a cycle the state is looked at: for an autonomous machine only on its
    section."""
    return 1 if is_autonomous(the_map.machine, bare(state)) else _PLACES


def moved_from_impacts(
    the_map: CycleMap, guess: State, impact_log: int
) -> tuple[CycleMap, State, Int[Array, ""]]:
    """Map, guess and their place (in eighths of a cycle) on the section to search on.

    The map jumps where an impact falls on its section, and no search gets across; so it is done
    where the guess's motion is farthest from its impacts, if the machine's section can be moved.
    """
    machine = the_map.machine
    if not isinstance(machine, Scene):
        return the_map, guess, jnp.zeros((), jnp.int32)
    run = _run(the_map, guess, impact_log)
    assert run.samples is not None and run.impact_log is not None
    step, half = machine.cycle / _PLACES, machine.cycle / 2
    phase = run.impact_log.phase.ravel() - step * jnp.arange(_PLACES)[:, None]
    apart = jnp.abs(jnp.mod(phase + half, machine.cycle) - half)
    place = jnp.argmax(jnp.min(jnp.where(jnp.isnan(apart), half, apart), axis=1))
    kept = with_modes(run.samples.state, run.samples.modes)
    there = jtu.tree_map(lambda x: x[place], kept)
    lost = ~jnp.all(jnp.isfinite(in_rows(bare(there), 0)))
    place = jnp.where(lost, 0, place)
    there = jtu.tree_map(lambda a, b: jnp.where(lost, a, b), guess, there)
    moved = machine.observed_later(jnp.asarray(step, phase.dtype) * place)
    return dataclasses.replace(the_map, machine=moved), there, place


class Impacts(NamedTuple):
    """The impacts of each cycle in their order; all floats, NaN (of `stop` -1) beyond the last."""

    phase: Float[Array, "cycles log"]
    """Clock of each since its cycle began."""
    speed: Float[Array, "cycles log"]
    """V⁻ of each."""
    stop: Float[Array, "cycles log"]
    """Number of the rigid stop of each."""


class ObservedArc(NamedTuple):
    """An arc of the shooting followed from its start, cycle by cycle; all floats."""

    states: Float[Array, "cycles places states"]
    """States at each place of each cycle, the start left out."""
    modes: Float[Array, "cycles places modes"] | None
    """The machine's own modes there; `None` if it has none."""
    jacobians: Float[Array, "cycles states states"]
    """Derivatives by the start of the states after each cycle."""
    listed: Impacts
    impacts: Float[Array, " cycles"]
    """Their number, those beyond the list included."""
    rests: Float[Array, " cycles"]
    """Times that a body comes to rest on a stop."""
    y_min: Float[Array, " cycles"]
    y_max: Float[Array, " cycles"]
    clearance: Float[Array, " cycles"]
    duration: Float[Array, " cycles"]
    integrals: dict[str, Float[Array, " cycles"]]
    """Of the machine's averages, over the time of each cycle."""


def observe_arc(arc: CycleMap, state: State, impact_log: int, second: bool) -> ObservedArc:
    """What is observed of an arc that begins in `state`; its derivatives are taken by columns (see
    `forward_jacobian`).

    **Arguments:** `second`, whether those of `jacobians` are, which are second derivatives of the
    motion; zero if not.
    """

    # Apart from the motion: a program with second derivatives should hold no more than it must.
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
    def seen(arc, state):
        x, _ = raveled(state)
        jacobians = jacobians_from(arc, state) if second else jnp.zeros((0,), x.dtype)
        run = _run(arc, state, impact_log)
        log = run.impact_log
        assert log is not None and run.y_min is not None and run.y_max is not None
        met = run.sections if run.samples is None else run.samples.state
        own = run.modes if run.samples is None else run.samples.modes
        places, modes = in_rows(met)[1:], None
        places = places.reshape(arc.cycles, _places(arc, state), -1)
        if own:  # batched as all else is, see `forward_jacobian`
            modes = in_rows(own)[1:].reshape(*places.shape[:2], -1) + 0 * places[..., :1]
        assert run.clearance is not None and run.duration is not None
        rests = jnp.zeros_like(run.y_min) if run.rests is None else run.rests.astype(x.dtype)
        return ObservedArc(
            places, modes, jacobians, Impacts(log.phase, log.speed, log.stop.astype(x.dtype)),
            run.impacts.astype(x.dtype), rests, run.y_min, run.y_max, run.clearance, run.duration,
            {name: mean * run.duration for name, mean in run.averages.items()},
        )  # fmt: skip

    found = seen(arc, state)
    if second:
        return found
    numbers, rest = eqx.partition((arc, state), eqx.is_array)
    still = eqx.combine(jax.lax.stop_gradient(numbers), rest)
    return found._replace(jacobians=jacobians_from(*still))


@eqx.filter_custom_jvp
def found_and_seen(
    arc: CycleMap, guess: State, root_finder: AbstractRootFinder, impact_log: int, second: bool
) -> tuple[Found, ObservedArc]:
    """The root that is found from a guess (`root_of`), and what is observed on its arcs, in rows.

    Differentiated by the numbers p of `arc`: the root x(p) of F has dx/dp = -(∂F/∂x)⁻¹ ∂F/∂p, by
    the implicit function theorem, so that no step of the search is. All derivatives are those of
    what is observed, by one program.
    """
    root, (_, unravel) = root_of(arc, guess, root_finder), raveled(guess)
    see = lambda x: observe_arc(arc, unravel(x), impact_log, second)
    return tied((root, jax.vmap(see)(root.x)), root.x)


@found_and_seen.def_jvp
def _(primals, tangents):
    arc, guess, _, impact_log, second = primals
    root, seen = found_and_seen(*primals)
    _, unravel = raveled(guess)
    still = jtu.tree_map(jnp.zeros_like, (root, seen))
    if not jtu.tree_leaves(tangents[0]):
        return (root, seen), still
    given = jtu.tree_map(lambda t: t is not None, tangents[0], is_leaf=lambda t: t is None)
    moving, fixed = eqx.partition(arc, given)
    numbers, as_numbers = ravel_pytree(moving)
    count = numbers.size

    def observed(both):
        moved = eqx.combine(as_numbers(both[:count]), fixed)
        return observe_arc(moved, unravel(both[count:]), impact_log, second)

    slopes = jax.vmap(lambda x: jax.jacfwd(observed)(jnp.append(numbers, x)))(root.x)
    ends, along = slopes.states[:, -1, -1], ravel_pytree(tangents[0])[0]
    rate = (ends[..., :count] @ along).ravel()
    move = -smallest_solution(shooting_matrix(ends[..., count:]), rate).reshape(root.x.shape)
    # Where there is no orbit there is no derivative of one.
    # A product, since the transpose of a choice would be zero.
    move = move * jnp.where(root.converged > 0, 1.0, jnp.nan)

    def rates(slope):
        by_starts = jax.vmap(lambda own, x: own @ x)(slope[..., count:], move)
        return slope[..., :count] @ along + by_starts

    return (root, seen), (still[0]._replace(x=move), jtu.tree_map(rates, slopes))


def by_the_first_state(jacobians: Float[Array, "arcs cycles n n"]) -> Float[Array, "all n n"]:
    """Derivatives of the states after each cycle of all arcs by the first state of the first arc,
    from those by the first state of their own arc: a running product."""
    passed, all_of_them = jnp.eye(jacobians.shape[-1], dtype=jacobians.dtype), []
    for own in jacobians:
        all_of_them.append(own @ passed)
        passed = all_of_them[-1][-1]
    return jnp.concatenate(all_of_them)


def error_of(
    angles: np.ndarray | None, seen: ObservedArc, x: Float[Array, "arcs states"]
) -> tuple[Scalar, Flag]:
    """The largest component of Newton's next step from the arcs' starts `x`, and whether the motion
    drifts: most of what it lacks to be periodic is what no other start would change."""
    after = jnp.roll(x, -1, axis=0)
    missing = nearest_images(angles, seen.states[:, -1, -1], after) - after
    missing, ahead = missing.ravel(), shooting_matrix(seen.jacobians[:, -1])
    step = smallest_solution(ahead, missing)
    drifts = jnp.linalg.norm(missing - ahead @ step) > _DRIFTS * jnp.linalg.norm(missing)
    return jnp.max(jnp.abs(step)), drifts


def in_order(
    seen: ObservedArc, hit: Bool[Array, "cycles log"], least: Int[Array, ""],
    machine: AbstractMachine, place: Int[Array, ""] | None,
) -> Impacts:  # fmt: skip
    """The impacts of a period, in one row and in their order from the section asked for.

    **Arguments:** the motion, cycle by cycle; which entries of its list are impacts of the period;
    the period in cycles; the machine; the eighths of a cycle by which the section searched on lies
    behind the one asked for, `None` for an autonomous machine, whose cycles differ in length.
    """
    phase, cycles = seen.listed.phase, seen.duration.shape[0]
    if place is not None:
        turn = jnp.asarray(machine.cycle, phase.dtype)
        behind = jnp.arange(cycles)[:, None] + place / _PLACES
        phase = jnp.mod(phase + turn * behind, turn * least)
    else:
        phase = phase + (jnp.cumsum(seen.duration) - seen.duration)[:, None]
    phase = jnp.where(hit, phase, jnp.inf).ravel()
    order = jnp.argsort(phase)
    columns = ((phase, jnp.nan), (seen.listed.speed, jnp.nan), (seen.listed.stop, -1.0))
    return Impacts(*(jnp.where(hit.ravel(), a.ravel(), none)[order] for a, none in columns))
