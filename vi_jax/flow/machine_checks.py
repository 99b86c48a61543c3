"""Checks of a machine written by a user, with errors that name it."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .._checks import concrete, is_traced, named_leaves, outside_of_traces, returned
from .._messages import warn
from .._types import Scalar, Scalars, State
from ..lanes import dependent_results
from ..machine import (
    AbstractEvent,
    AbstractMachine,
    Coordinate,
    DryFriction,
    Mechanical,
    Reset,
    RigidStop,
    SoftStop,
    begin_modes,
    check_takes,
    clock_of,
    component,
    components,
    contacts_in,
    event_of,
    events_of,
    field_in,
    frictions_in,
    guard_of,
    has_own_modes,
    is_angle,
    is_autonomous,
    is_builtin,
    like,
    listed,
    others_of,
    outcomes_of,
    overridden,
    section_in,
    shown_modes,
    stops_of,
    switches_of,
)
from ..machine import State as NamedState
from ..machines import LinearMachine, Scene

_TRACER_ERRORS = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)

# A field whose values a cycle apart differ by more than this share has another period; with a
# period of five digits they differ by less. They are compared at the start and at this share of a
# cycle, where few inputs are zero.
_PERIODIC, INNER_INSTANT = 1e-4, 0.29


# The number of an outcome is a part of the number of a reason: it must be smaller than 4096.
_MOST_OUTCOMES = 4095


def check_field(machine: AbstractMachine, s: Scalar, state: State, modes: Scalars) -> None:
    """Check the field and the section, while the loop is traced, at no cost at run time.
    **Raises:** `TypeError` if one cannot be traced, takes other arguments or returns no state."""
    member = "`force` or `mass`" if isinstance(machine, Mechanical) else "`field`"
    label = f"{member} of a {type(machine).__name__}"
    modes = shown_modes(machine, modes)
    check_takes(machine.field, label, "`t`, the state", (s, state, *modes), len(modes))

    def checked_field(s, state, *modes):
        found = machine.field(s, state, *modes)
        return None if found is None else like(state, found, label)

    try:
        with explain_errors(label):
            flow = jax.eval_shape(checked_field, s, state, *modes)
    except (AttributeError, TypeError, LookupError) as error:
        if _is_traceable(machine.field, state, s, *modes):
            raise TypeError(
                f"{label} must take `t` first and then the state, but takes them the other way "
                "round."
            ) from None
        if isinstance(error, TypeError):  # it says what must be
            raise
        names = " In `force`, `q` has the positions and `v` the velocities." * ("mass" in member)
        raise TypeError(f"{label} cannot be computed: {error}{names}") from error
    returned(flow, label, "the components of its state")
    if jtu.tree_structure(state) != jtu.tree_structure(flow):
        raise TypeError(
            f"{label} must return the components of its state, {tree_text(state)}, but returned "
            f"{tree_text(flow)}."
        )
    for (part, x), rate in zip(named_leaves(state), jtu.tree_leaves(flow), strict=True):
        if jnp.shape(x) != jnp.shape(rate):
            raise TypeError(
                f"{label} must return the components of its state, but its rate of {part} has "
                f"shape {jnp.shape(rate)}, not {jnp.shape(x)}.{batch_hint(machine)}"
            )
    _output_shapes(
        f"`cycle` of a {type(machine).__name__}", lambda x: section_in(machine, x), state
    )


def check_before_modes(machine: AbstractMachine, s: Scalar, state: State) -> None:
    """Check the cycle and the frictions, and the field if it needs no modes: those of friction
    depend on the forces. **Raises:** as `check_field`, and as `_check_frictions`."""
    with explain_errors(f"`cycle` of a {type(machine).__name__}"):
        jnp.asarray(machine.cycle)
    _check_frictions(machine, s, state)
    _check_surfaces(machine, state)
    switches = switches_of(machine)
    if switches and all(x.acts for x in switches) and not has_own_modes(machine):
        check_field(machine, s, state, ())


def batch_hint(machine: AbstractMachine) -> str:
    arrays = [name for name, x in vars(machine).items() if eqx.is_array(x) and x.ndim]
    if not arrays:
        return ""
    return f" Of many machines, with a row as {' and '.join(arrays)}, take `jax.vmap` or `scan`."


def tree_text(tree: Any) -> str:
    """Return the structure of a tree as text, with types and shapes for numbers."""

    def blank(x: Any) -> Any:
        return jnp.zeros(x.shape, x.dtype) if hasattr(x, "shape") else x

    return eqx.tree_pformat(jtu.tree_map(blank, tree), width=1000)


def _is_traceable(function: Callable[..., Any], *arguments: Any) -> bool:
    try:
        jax.eval_shape(function, *arguments)
    except Exception:
        return False
    return True


@contextlib.contextmanager
def explain_errors(label: str) -> Iterator[None]:
    """Turn errors about traced numbers, assignments and division by zero into one sentence."""
    try:
        yield
    except jax.errors.TracerBoolConversionError as error:
        raise TypeError(
            f"{label} must be written for numbers that are traced: `jnp.where`, not `if`."
        ) from error
    except _TRACER_ERRORS as error:
        raise TypeError(
            f"{label} must be written for numbers that are traced: with the functions of "
            "`jax.numpy`, not with those of `numpy` or `math`, `float` or `int`."
        ) from error
    except dataclasses.FrozenInstanceError as error:
        raise TypeError(
            f"{label} must return new numbers, and change neither machine nor state: {error}."
        ) from error
    except ZeroDivisionError as error:
        raise ValueError(
            f"{label} must be finite, but divides by zero. One of its numbers is 0."
        ) from error


def _output_shapes(label: str, function: Callable[..., Any], *arguments: Any) -> Any:
    with explain_errors(label):
        return eqx.filter_eval_shape(function, *arguments)


def check_laws(machine: AbstractMachine, speed: Scalar) -> None:
    """**Raises:** `TypeError` for an invalid restitution law; as `check_field`."""
    for i, stop in enumerate(stops_of(machine)):
        if stop.is_one_number:
            continue
        label = f"The restitution law of stop {i} of a {type(machine).__name__}"
        try:
            got = _output_shapes(label, stop.velocity_after, speed)
        except TypeError as error:
            if str(error).startswith(label):
                raise
            raise TypeError(
                f"{label} must be a function of the speed of approach that returns a number in "
                f"[0, 1], but: {error}"
            ) from error
        if jnp.shape(got) != ():
            raise TypeError(
                f"{label} must return one number, but gives an array of shape {got.shape}."
            )


# A guard is evaluated in this many states around the start. Their modes are those of the start or
# these. Each number is moved by these distances, relative to 1 + its size. Choices.
_SAMPLES, _MODES, _DISTANCES = 48, (-1.0, 0.0, 1.0), (0.1, 1.0, 10.0)


def check_values(machine: AbstractMachine, start: State, repeats: bool = True) -> None:
    """Check numbers of a machine around its start. Warn once if the field is not periodic and the
    motion `repeats` its cycle, or if an event's guard is not negative in any of many states.
    Machines of this package and machines with traced numbers are not checked."""
    machine = getattr(machine, "observed_machine", machine)  # so that it is not checked twice
    kind = type(machine)
    if is_builtin(kind) or is_traced(machine, start):
        return
    _check_slips(machine, start)
    _check_friction_forces(machine, start)
    try:
        ticks = clock_of(machine, start) is None and not is_autonomous(machine, start)
        zero, state = jtu.tree_map(np.asarray, (np.zeros(()), start))
        found = 0.0, [], ()
        with outside_of_traces():
            timed = ticks or _has_timed_field(machine, state)
            masses = _masses(machine, state)
            if timed or others_of(machine):
                found = _values(machine, zero, state, timed)
        cycle, fields, below = jtu.tree_map(np.asarray, found)
    except Exception as error:  # others are raised with a better message in the trace
        if isinstance(error, ValueError) and str(error).startswith("`mass` of a"):
            raise
        return
    if masses.size and not _is_definite(masses):
        raise ValueError(
            f"`mass` of a {kind.__name__} must be positive, or a symmetric and positive definite "
            f"matrix, but at the start it is {masses.tolist()}."
        )
    if ticks and repeats:
        _check_period(kind, start, fields, cycle)
    elif not ticks and any(np.any(rates[0] != rates[1]) for rates in fields):
        _warn_once(
            kind,
            f"The `field` of a {kind.__name__} depends on time, which restarts from 0 in each "
            "cycle, but an event ends its cycles. Make the phase of a drive a component of the "
            "state.",
        )
    for i in np.flatnonzero(~np.asarray(below, bool)):
        event = others_of(machine)[i]
        _warn_once(
            kind,
            f"The guard of event {i} ({event.name or type(event).__name__}) of a {kind.__name__} "
            f"was not below zero in any of {_SAMPLES + 1} states around the start. Return a number "
            "that is negative before the event: `x - 1`, not `jnp.maximum(x - 1, 0)`.",
        )


def _check_period(kind: type, start: State, fields: list[np.ndarray], cycle: Any) -> None:
    """Warn once if a cycle is no period of the field: its ends differ, or several are one."""

    def differ(rates: np.ndarray, a: int, b: int) -> bool:
        with np.errstate(all="ignore"):  # rates that overflow are no fault here
            size = np.maximum(abs(rates[1]), abs(rates[a]) + abs(rates[b]))
            return bool(np.any(abs(rates[a] - rates[b]) > _PERIODIC * size))

    several = any(not any(differ(x, 1, k) for x in fields) for k in (4, 5, 6))
    paths = [jtu.keystr(path).lstrip(".") for path, _ in jtu.tree_leaves_with_path(start)]
    parts = [("field", f"rate of its {path or 'state'}") for path in paths]
    parts += [("contacts", f"force on its {path or 'state'}") for path in paths]
    parts += [("prescribed", f"value of its {path}") for path in paths]
    for (member, what), values in zip(parts, fields, strict=False):
        if differ(values, 0, 2) or (several and differ(values, 1, 3)):
            of = {"field": "the field", "contacts": "their loads, levels and slips"}.get(
                member, "prescribed motions"
            )
            _warn_once(
                kind,
                f"The `{member}` of a {kind.__name__} {'are' if member == 'contacts' else 'is'} "
                f"not the same a `cycle` = {cycle:.6g} "
                f"later: the {what} differs. Time restarts from 0 in each cycle: `cycle` must be a "
                f"period of {of}, unless it jumps.",
            )
            return


def _is_definite(masses: np.ndarray) -> bool:
    """Return whether a matrix is symmetric, to rounding, and positive definite."""
    diagonal = np.diag(masses)
    if not (diagonal > 0).all():
        return False
    scaled = masses / np.sqrt(np.outer(diagonal, diagonal))
    even = np.allclose(scaled, scaled.T, rtol=0, atol=1e-9)
    return bool(np.isfinite(scaled).all() and even and np.linalg.eigvalsh(scaled).min() > 0)


# A slip is evaluated at this many instants of a cycle. Then the interval of its greatest change is
# halved this many times. If this share of the change is left, the slip jumps. If it changes by more
# than this share of its range between two instants, it is steep. Choices.
_INSTANTS, _HALVINGS, _JUMP, _STEEP = 1024, 40, 0.5, 0.05


def _check_slips(machine: AbstractMachine, start: State) -> None:
    """Warn once of friction on a surface whose speed changes so fast that steps may be too long.

    **Raises:** `ValueError` if the speed jumps within a cycle.
    """
    for number, friction in enumerate(switches_of(machine)):
        if not isinstance(friction, DryFriction) or not friction.slip_takes_time:
            continue
        try:
            with outside_of_traces():
                time, extent, coarse, fine = map(np.asarray, _steepest(machine, number, start))
        except Exception:  # the error is raised with a better message when the friction is traced
            return
        if coarse > 0 and fine > _JUMP * coarse:
            raise ValueError(
                f"The `slip` of a DryFriction of a {type(machine).__name__} must be continuous in "
                f"time, but it jumps by {fine:.6g} at t = {time:.6g}. Let it jump where a "
                "cycle begins, or make the surface's speed a component of the state, which a "
                "`Reset` changes."
            )
        limit = type(machine).step_limit
        if coarse > _STEEP * extent and limit is AbstractMachine.step_limit:
            _warn_once(
                type(machine),
                f"The `slip` of a DryFriction of a {type(machine).__name__} changes within a "
                f"thousandth of a cycle, at t = {time:.6g}: steps may be too long. Give it "
                "a `step_limit`, or let the surface's speed jump by a `Reset`.",
            )


def _check_frictions(machine: AbstractMachine, s: Scalar, state: State) -> None:
    """**Raises:** `TypeError` if a function of a user's friction cannot be computed, `ValueError`
    if it is `on` a position."""
    frictions = [x for x in contacts_in(machine) if isinstance(x, DryFriction)]
    if is_builtin(type(machine)) or not frictions:
        return
    for friction in frictions:
        for part, law in friction.laws().items():
            label = f"`{part}` of a DryFriction of a {type(machine).__name__}"
            number = lambda x, f=law, y=label: jnp.asarray(
                returned(f(machine, s, x), y, "a number")
            )
            try:
                with explain_errors(label):
                    jax.eval_shape(number, state)
            except (AttributeError, LookupError, TypeError, ValueError) as error:
                if str(error).startswith(label):
                    raise
                raise TypeError(f"{label} must be computable, but: {error}") from None
        if friction.slip is None and not isinstance(machine, Mechanical):
            _check_is_velocity(machine, friction.on, s, state)


# Surfaces are compared in this many random states. Vectors of values whose angle is smaller than
# the second number are multiples of each other. Choices.
_STATES, _PARALLEL = 6, 1e-9


def _check_surfaces(machine: AbstractMachine, state: State) -> None:
    """**Raises:** `ValueError` if two frictions, or two switches with `slides=True`, have functions
    that are multiples of each other: their forces or modes on the surface are not unique."""
    switches = switches_of(machine)
    groups = {
        "dry frictions": (
            [(i, x.speed_of_slip) for i, x in enumerate(switches) if isinstance(x, DryFriction)],
            "Give them the same `on` or `slip`, or write one friction with the sum of their forces",
        ),
        "switches with `slides=True`": (
            [(i, x.function) for i, x in enumerate(switches) if x.blends],
            "Write one switch, and use its mode for the other's, with the sign of the factor",
        ),
    }
    for kind, (functions, advice) in groups.items():
        if len(functions) < 2 or is_builtin(type(machine)):
            continue
        try:
            with outside_of_traces():
                pair = _parallel([f for _, f in functions], machine, state)
        except Exception:  # the error is raised with a better message when the function is traced
            continue
        if pair is not None:
            one, other = (functions[i][0] for i in pair)
            raise ValueError(
                f"The {kind} of a {type(machine).__name__} must have surfaces of their own, but "
                f"the functions of numbers {one} and {other} are multiples of each other. {advice}."
            )


def _parallel(functions: Sequence[Any], machine: Any, state: State) -> tuple[int, int] | None:
    """Return the first two functions of machine, `s` and state that are multiples of each other, or
    `None`. Traced parameters are replaced by random numbers."""
    draw = np.random.default_rng(0).uniform
    known = jtu.tree_map(
        lambda x: draw(0.2, 0.9, jnp.shape(x)) if isinstance(x, Tracer) else x, machine
    )
    states = jtu.tree_map(lambda x: jnp.asarray(draw(-1, 1, (_STATES, *jnp.shape(x)))), state)
    instants = jnp.asarray(draw(0, 1, _STATES))
    values = np.array([
        jax.vmap(lambda s, x, f=f: jnp.asarray(f(known, s, x)))(instants, states) for f in functions
    ])  # fmt: skip
    unit = values / np.linalg.norm(values, axis=1, keepdims=True)
    for i in range(len(unit)):
        for j in range(i):
            across = unit[i] - (unit[i] @ unit[j]) * unit[j]
            if np.linalg.norm(across) < _PARALLEL:
                return j, i
    return None


def _check_is_velocity(machine: AbstractMachine, on: str, s: Scalar, state: State) -> None:
    """**Raises:** `ValueError` if a component is a position: its rate is another component."""
    if has_own_modes(machine) or not isinstance(on, str):
        return
    try:
        flow = machine.field(s, state)
        rate = flow[on] if isinstance(flow, Mapping) else component(on, flow)
    except Exception:  # `check_field` raises it with a better message
        return
    others = components(state)
    velocity = next((name for name, x in others.items() if x is rate and name != on), None)
    if velocity is not None:
        raise ValueError(
            f"Argument `on` of a DryFriction of a {type(machine).__name__} must be the name of a "
            f"velocity, but {on!r} is a position: its rate is {velocity!r}. Write "
            f"`on={velocity!r}`."
        )


def _check_friction_forces(machine: AbstractMachine, start: State) -> None:
    """**Raises:** `ValueError` if the force of a friction is negative in the state of the start, at
    some instant of a cycle."""
    for number, friction in enumerate(switches_of(machine)):
        if not (isinstance(friction, DryFriction) and friction.may_be_negative):
            continue
        try:
            with outside_of_traces():
                forces, instants = map(np.asarray, _friction_forces(machine, number, start))
        except Exception:  # the error is raised with a better message when the friction is traced
            return
        least = np.argmin(forces)
        if forces[least] < -1e-9 * np.abs(forces).max():
            when = f"at t = {instants[least]:.6g}, in the state of " if instants[least] else "at "
            raise ValueError(
                f"The force of a DryFriction of a {type(machine).__name__} must not be negative, "
                f"but is {forces[least]:.6g} {when}the start. `level` and `load` are its size: it "
                "acts against the slip by itself."
            )


@eqx.filter_jit(compiler_options={"xla_backend_optimization_level": "0"})  # pyright: ignore
def _friction_forces(machine: AbstractMachine, number: int, start: State) -> Any:
    friction: Any = switches_of(machine)[number]
    zero = jnp.zeros_like(machine.position(start))
    sign = friction.slip_sign(machine, zero, start)
    s = zero + jnp.asarray(machine.cycle, float) * (np.arange(_INSTANTS) / _INSTANTS)
    return jax.vmap(lambda s: friction.sliding(machine, s, start, sign) + 0 * s)(s), s


@eqx.filter_jit(compiler_options={"xla_backend_optimization_level": "0"})  # pyright: ignore
def _steepest(machine: AbstractMachine, number: int, start: State) -> Any:
    """Return the place in a cycle where a slip changes most, and the range of its values. Also
    return its changes there between two of many instants, and between two far closer ones."""
    friction: Any = switches_of(machine)[number]
    slip = lambda s: jnp.asarray(friction.speed_of_slip(machine, s, start), float)
    s = jnp.asarray(machine.cycle, float) * (np.arange(_INSTANTS) / _INSTANTS)
    values = jax.vmap(slip)(s)
    steps = jnp.abs(jnp.diff(values))
    place = jnp.argmax(steps)

    def halve(_: Any, ends: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = ends
        middle = 0.5 * (low + high)
        is_first = jnp.abs(slip(middle) - slip(low)) > jnp.abs(slip(high) - slip(middle))
        return jnp.where(is_first, low, middle), jnp.where(is_first, middle, high)

    low, high = jax.lax.fori_loop(0, _HALVINGS, halve, (s[place], s[place + 1]))
    extent = jnp.max(values) - jnp.min(values)
    return high, extent, steps[place], jnp.abs(slip(high) - slip(low))


@eqx.filter_jit(compiler_options={"xla_backend_optimization_level": "0"})  # pyright: ignore
def _values(machine: AbstractMachine, zero: Scalar, start: State, ticks: bool) -> Any:
    """Return the cycle; if `ticks`, the rates and prescribed values at the start, within the cycle,
    a cycle after both and up to four cycles after the second; for each event, whether its guard is
    negative in any state around the start. `zero` is an argument: JAX compiles expressions of
    constants alone."""
    zero = zero.astype(jnp.result_type(machine.position(start)))
    modes, cycle = _modes_near(machine, zero, start), zero + machine.cycle
    later = np.arange(1, 5) + INNER_INSTANT
    instants = zero + cycle * np.array([0.0, INNER_INSTANT, 1.0, *later])
    prescribed = getattr(machine, "_with_prescribed", lambda s, state: state)

    def rates(s: Scalar) -> tuple[State, State, State]:
        state = prescribed(s, start)
        own = machine.field(s, state, *shown_modes(machine, modes))
        return like(state, own, "`field`"), field_in(machine, s, state, modes), state

    fields = jax.vmap(rates)(instants) if ticks else ()
    around = _states_around(zero, cycle, start, modes)

    below = ()
    if others_of(machine):
        guards = lambda *here: jnp.stack(_guards(machine, *here))
        below = jnp.any(jax.vmap(guards)(*around) < 0, axis=0)
    return cycle, jtu.tree_leaves(fields), below


def _modes_near(machine: AbstractMachine, s: Scalar, start: State) -> Scalars:
    """Return the modes at a start, without the question which bodies stick: all slide."""
    modes = list(begin_modes(machine, s, start, settles=False))
    for i in frictions_in(machine):
        modes[i] = jnp.where(modes[i] == 0, 1.0, modes[i])
    return tuple(modes)


def _guards(machine: AbstractMachine, s: Scalar, state: State, modes: Scalars) -> list[Array]:
    first, last = len(stops_of(machine)) + len(switches_of(machine)), len(events_of(machine)) - 1
    found = (guard_of(machine, i, s, state, modes) for i in range(first, last))
    return [jnp.asarray(x, s.dtype) for x in found]


def depends_on_time(function: Callable[..., Any], machine: AbstractMachine, state: State) -> bool:
    """Return whether `function(machine, s, state, modes)` may depend on `s`."""
    of_time = lambda s, x: function(machine, s, x, _modes_near(machine, s, x))
    traced = jax.make_jaxpr(of_time)(np.zeros(()), state).jaxpr
    sources = [True] + [False] * len(jtu.tree_leaves(state))
    return any(dependent_results(traced, sources, smooth=False))


@eqx.filter_jit
def _has_timed_field(machine: AbstractMachine, x: State) -> bool:
    """Return whether the field may depend on time, but no guard, as of a timer; traced once."""
    return depends_on_time(field_in, machine, x) and not depends_on_time(_guards, machine, x)


def _masses(machine: AbstractMachine, start: State) -> Any:
    """Return the mass matrix at the start; an empty array if the machine has none."""
    if not isinstance(machine, Mechanical):
        return np.zeros(0)
    places = machine._places(start)
    found = _masses_at(machine, places) if callable(machine.mass) else machine._masses(places)
    return np.zeros(0) if any(machine._q_shapes.values()) else np.array(found, float)


_masses_at = eqx.filter_jit(lambda machine, q: machine._masses(q))


def _states_around(zero: Scalar, cycle: Scalar, start: State, modes: Scalars) -> Any:
    """Return instants, states and modes: those of the start, and random ones around it."""
    random = np.random.default_rng(0)
    distances = np.resize(_DISTANCES, _SAMPLES)
    s = zero + cycle * np.append(0.0, random.uniform(size=_SAMPLES))

    def draw_around(x: Any) -> Array:
        x = jnp.asarray(x)
        shape = (_SAMPLES, *x.shape)
        moved = random.standard_normal(shape) * distances.reshape(-1, *(1 for _ in x.shape))
        return jnp.concatenate([x[None], x + jnp.asarray(moved, x.dtype) * (1 + jnp.abs(x))])

    def draw_modes(mode: Scalar) -> Array:
        choices = np.append(len(_MODES), random.choice(len(_MODES) + 1, size=_SAMPLES))
        values = np.append(_MODES, 0.0)[choices].astype(zero.dtype)
        return jnp.where(choices == len(_MODES), zero + mode, values)

    return s, jtu.tree_map(draw_around, start), tuple(map(draw_modes, modes))


@functools.lru_cache(maxsize=64)
def _warn_once(kind: type, text: str) -> None:
    warn(text)


_CONTACTS = (RigidStop, SoftStop, DryFriction)
_KINDS = {
    "contacts": (
        lambda part: isinstance(part, _CONTACTS),
        "contacts: `RigidStop`s, `SoftStop`s and `DryFriction`s. Others belong to `events`",
    ),
    "events": (
        lambda part: isinstance(part, AbstractEvent) and not isinstance(part, _CONTACTS),
        "`AbstractEvent`s, as `Reset` and `Switch` are. Stops and friction belong to `contacts`",
    ),
}


def _member(machine: AbstractMachine, name: str, what: str) -> Any:
    """Return an attribute. **Raises:** `TypeError` if it is a property that returns `None`."""
    label = f"`{name}` of a {type(machine).__name__}"
    with explain_errors(label):
        found = getattr(machine, name)
    is_property = isinstance(getattr(type(machine), name, None), property)
    return returned(found, label, what) if is_property else found


def check_parts(machine: AbstractMachine) -> None:
    """Check the parts of a machine before anything is traced. **Raises:** `TypeError` or
    `ValueError` for an invalid one."""
    name = type(machine).__name__
    for what, (belongs, words) in _KINDS.items():
        parts = listed(_member(machine, what, "a tuple"))
        if not isinstance(parts, tuple) or not all(map(belongs, parts)):
            hint = " Write `@property` above its `def`." if callable(parts) else ""
            raise TypeError(
                f"`{what}` of a {name} must be a tuple of {words}: got {parts!r}.{hint}"
            )
    _check_names(machine)
    length = _member(machine, "cycle", "a number")
    if callable(length) or isinstance(length, str | bool | None):
        got = "a function" if callable(length) else repr(length)
        raise TypeError(
            f"`cycle` of a {name} must be a number, or a property that gives one, but is {got}."
        )
    if jnp.shape(length):
        raise ValueError(
            f"`cycle` of a {name} must be one number, but has shape {jnp.shape(length)}."
            f"{batch_hint(machine)}"
        )
    cycle = concrete(length)
    if cycle is not None and not (np.isfinite(cycle) & (cycle > 0)).all():
        raise ValueError(f"`cycle` of a {name} must be positive and finite, but is {cycle}.")
    if isinstance(machine, LinearMachine | Scene):
        _check_ignored("Stop", stops_of(machine), name)
        _check_ignored("Soft stop", switches_of(machine), name)
    if len(outcomes_of(machine)) > _MOST_OUTCOMES:
        raise ValueError(
            f"The events of a {name} must have at most {_MOST_OUTCOMES} outcomes (`ends`), but "
            f"have {len(outcomes_of(machine))}."
        )
    count = len(returned(machine.coordinates, f"`coordinates` of a {name}", "a tuple"))
    for i, stop in enumerate(stops_of(machine)):
        for part in ("gap", "restitution"):
            shape = () if callable(getattr(stop, part)) else jnp.shape(getattr(stop, part))
            if shape:
                raise ValueError(
                    f"Stop {i} of a {name} must have one number as `{part}`, but has shape {shape}."
                    f"{batch_hint(machine)}"
                )
        if stop.coordinate >= count:
            raise ValueError(
                f"Stop {i} of a {name} limits coordinate {stop.coordinate}, but there are {count}: "
                "name each in `coordinates`."
            )
        if stop.at is not None and not isinstance(machine, LinearMachine):
            raise ValueError(
                f"Stop {i} of a {name} has an `at`, which only a linear machine "
                "(`vi.machines.Structure`) takes; other machines name what stops limit in "
                "`coordinates`, and stops its number in `coordinate`."
            )


def _check_gap(machine: Mechanical, gap: Callable[..., Any]) -> None:
    label = f"The gap `on` of a contact of a {type(machine).__name__}"
    places = NamedState(**{name: np.zeros(shape) for name, shape in machine._q_shapes.items()})
    try:
        with explain_errors(label):
            returned(jax.eval_shape(gap, places), label, "a number")
    except AttributeError as error:
        raise TypeError(f"{label} must be a function of the coordinates: {error}") from None


def _check_ignored(what: str, parts: Sequence[Any], name: str) -> None:
    for i, part in enumerate(parts):
        for given in ("on", "mass", "friction"):
            if getattr(part, given, None) is not None:
                raise ValueError(
                    f"{what} {i} of a {name} must have no `{given}`. Write a `vi.Mechanical` for a "
                    "machine whose stops have one."
                )


def _check_names(machine: AbstractMachine) -> None:
    """**Raises:** `ValueError` for an invalid coordinate, a stop on an angle of `wrap_angles`, or
    with an invalid `on`."""
    kind = type(machine)
    own = [vars(x).get("section") for x in kind.__mro__ if not is_builtin(x)]
    if any(map(callable, own)):  # a number is a parameter
        _warn_once(
            kind,
            f"The `section` of a {kind.__name__} has no effect. Cycles end by `cycle`: a number, "
            '`vi.rising("u", usual=6.3)` or `vi.turn_of("phi")`.',
        )
    pairs = [x.on for x in contacts_in(machine) if isinstance(getattr(x, "on", None), tuple)]
    for stop in contacts_in(machine):
        on = getattr(stop, "on", None)
        if isinstance(stop, RigidStop) and stop.friction is not None and stop.along == on:
            raise ValueError(
                f"Argument `along` of a stop must be another coordinate than `on`, but is {on!r}."
            )
        names = (on,) if isinstance(on, str) else on if isinstance(on, tuple) else ()
        angles = [x for x in names if is_angle(machine, x)]
        if isinstance(stop, RigidStop) and angles:
            raise ValueError(
                f"A stop is at one value of {angles[0]!r}, which `wrap_angles` changes "
                "by whole turns: leave the angle out there, with a stop at each end of its range."
            )
        if isinstance(machine, Mechanical):
            if getattr(stop, "mass", None) is not None:
                raise ValueError(
                    f"Argument `mass` of a {type(stop).__name__} must be left out in a "
                    f"{type(machine).__name__}, whose own masses are used."
                )
            if callable(on):
                _check_gap(machine, on)
            elif getattr(stop, "push", None) is None:
                machine._names_on(on)
            continue
        is_position = any(on == position for position, *_ in pairs)
        if isinstance(stop, DryFriction) and (isinstance(on, tuple) or is_position):
            raise ValueError(
                f"Argument `on` of a DryFriction of a {type(machine).__name__} must be the name of "
                f'a velocity, `on="u"`, but got {on!r}.'
            )
        is_pair = isinstance(on, tuple) and len(on) == 2 and all(isinstance(x, str) for x in on)
        if isinstance(stop, RigidStop | SoftStop) and on is not None and not is_pair:
            raise ValueError(
                f"Argument `on` of a stop of a {type(machine).__name__} must be the names of "
                f'position and velocity, `on=("x", "u")`, but got {on!r}.'
            )


def check_events(machine: AbstractMachine, s: Scalar, state: State, modes: Scalars) -> None:
    """Check coordinates and events, while the loop is traced, at no cost at run time. **Raises:**
    `TypeError` if one of their functions does not return what it must."""
    name = type(machine).__name__
    for k, coordinate in enumerate(machine.coordinates if stops_of(machine) else ()):
        _check_mass(f"`mass` of coordinate {k} of a {name}", coordinate, s, state)
        label = f"`placed` of coordinate {k} of a {name}"
        place, velocity = coordinate.position(state), coordinate.velocity(state)
        _check_state(label, state, _output_shapes(label, coordinate.placed, state, place, velocity))
    if overridden(machine, AbstractMachine, "renewed"):
        label = f"`renewed` of a {name}"
        _check_state(label, state, _output_shapes(label, machine.renewed, state))
    first = len(stops_of(machine))
    for number, event in enumerate(events_of(machine)[first:-1], start=first):
        _check_event(machine, number, event, (s, state, modes))


def _check_mass(label: str, coordinate: Coordinate, s: Scalar, state: State) -> None:
    mass = coordinate.mass
    if callable(mass):
        mass = _output_shapes(label, lambda: jnp.asarray(coordinate.mass_at(s, state)))
    kind = getattr(mass, "dtype", None) or jnp.result_type(type(mass))
    if jnp.shape(mass) or not jnp.issubdtype(kind, jnp.number):
        raise TypeError(
            f"{label} must be one number, or a function `mass(s, state)` that returns one, but "
            f"is {tree_text(mass)}."
        )


def _check_event(
    machine: AbstractMachine, number: int, event: AbstractEvent, at: tuple[Scalar, State, Scalars]
) -> None:
    s, state, modes = at
    switches, name = len(switches_of(machine)), type(machine).__name__
    i = number - len(stops_of(machine))
    what, i = ("switch", i) if i < switches else ("event", i - switches)
    label = f"{what} {i} ({event.name or type(event).__name__}) of a {name}"
    contact = tuple(jnp.zeros_like(s) for _ in machine.coordinates)
    _, own_modes, keywords = event_of(machine, number, modes, contact)
    arguments = machine, s, state, *modes[own_modes]
    guard = _output_shapes(f"`guard` of {label}", lambda: event.guard(*arguments, **keywords))
    if getattr(guard, "shape", None) != () or not jnp.issubdtype(guard.dtype, jnp.floating):
        raise TypeError(
            f"`guard` of {label} must return one floating-point number, but returned "
            f"{tree_text(guard)}."
        )
    when = _output_shapes(f"`when` of {label}", lambda: event.happens(*arguments))
    if when is not None and (jnp.shape(when) or not jnp.issubdtype(when.dtype, bool)):
        raise TypeError(
            f"`when` of {label} must return a flag, but returned {tree_text(when)}. Compare it "
            "with a number: `state.V > 0`."
        )
    if isinstance(event, Reset):  # `after` evaluates its modes in that state
        new = _output_shapes(f"`reset` of {label}", lambda: event.jump(machine, s, state, *modes))
        _check_state(f"The state after {label}", state, new)
    found = _output_shapes(f"`after` of {label}", lambda: event.after(*arguments, **keywords))
    if type(found) is not tuple or len(found) != 2:
        raise TypeError(
            f"`after` of {label} must return the state and the modes afterwards, but returned "
            f"{tree_text(found)}."
        )
    new, changed = found
    _check_state(f"The state after {label}", state, new)
    number = len(changed) if isinstance(changed, Sequence) else -1
    if not event.holds_mode and number != len(modes):
        raise TypeError(
            f"The modes after {label} must be {len(modes)} in number, as many as the machine has "
            f"(those of its switches, then its own `modes`), but are {tree_text(changed)}."
        )


def _check_state(label: str, state: State, found: Any) -> None:
    def kind(x: Any) -> Any:
        floats = jnp.issubdtype(jnp.result_type(x), jnp.inexact)
        return jnp.shape(x), floats

    same_structure = jtu.tree_structure(state) == jtu.tree_structure(found)
    if not same_structure or jtu.tree_map(kind, state) != jtu.tree_map(kind, found):
        raise TypeError(
            f"{label} must be like its state, {tree_text(state)}, but is {tree_text(found)}."
        )
