"""Arguments of `simulate`, checked, and the plan of its loop."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Int

from .. import lanes
from .._checks import (
    concrete,
    count,
    fits_records,
    flag,
    from_host,
    instance_of,
    named_leaves,
    narrow,
    one_of,
    require_ranges,
    require_real,
    require_session,
    returned,
    short,
    strongly_typed,
    warn_of_narrow,
)
from .._messages import count_of, warn
from .._types import Machine, State
from ..machine import (
    AbstractMachine,
    Mechanical,
    Turn,
    begin_modes,
    check_takes,
    components,
    contacts_in,
    convert_start,
    counter_of,
    field_in,
    has_delays,
    has_velocity,
    history_of,
    in_clock,
    is_autonomous,
    may_rest,
    modes_at_start,
    modes_of,
    shown_modes,
    stops_of,
    with_some_past,
    without_history,
    without_modes,
)
from ..machine import State as NamedState
from ..machines import Scene
from ._quantities import average_names, check_units, quantity_names
from .history import check_delays, with_memory
from .machine_checks import (
    INNER_INSTANT,
    check_before_modes,
    check_parts,
    check_values,
    explain_errors,
)
from .methods import AbstractMethod, MethodLike, chosen
from .plan import Plan
from .sizes import rounding_bounds

_TRACED = ["settle", "method", "begin", "until", "stop"]
_STATIC = [
    "clock", "samples", "impact_log", "event_log", "record", "rests", "max_impacts", "max_steps",
]  # fmt: skip


@functools.partial(jax.tree_util.register_dataclass, data_fields=_TRACED, meta_fields=_STATIC)
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RunOptions:
    """The options of a run, with the meanings and defaults of `simulate`.

    It is a pytree. `settle` and the numbers of `method` may be traced, so that other values do not
    compile again. All other options are compile-time constants.
    """

    settle: Any = 0
    method: MethodLike = None
    clock: str | None = None
    samples: int = 0
    impact_log: int = 0
    event_log: int = 0
    record: str = "motion"
    rests: bool | None = None
    max_impacts: int = 1000
    max_steps: int | None = None
    begin: Any = None
    """Clock of the start, if it is not on the section."""
    until: Any = None
    """Clock at which the only cycle of the run ends; by default the machine's own. Neither is
    allowed for a machine whose cycles an event ends."""
    stop: Any = None
    """A condition that ends a lane early, at a record point: `stop(machine, state, record, first)`
    returns a flag, or `None` if it cannot decide; `first`: recording begins there. A pytree."""

    def checked(self, machine: AbstractMachine | None) -> "RunOptions":
        """Return the options after validation, with the method that they choose for the machine
        (`None` if not known yet). **Raises:** `TypeError` or `ValueError` that names the option."""
        max_steps, counts = self.max_steps, ("samples", "impact_log", "event_log", "max_impacts")
        return dataclasses.replace(
            self,
            **{name: count(name, getattr(self, name)) for name in counts},
            method=chosen(machine, self.method),
            settle=self.settle if isinstance(self.settle, Tracer) else count("settle", self.settle),
            rests=None if self.rests is None else flag("rests", self.rests),
            max_steps=None if max_steps is None else count("max_steps", max_steps, least=1),
            record=one_of("record", self.record, ("motion", "sections")),
        )

    def check_limits(self, dtype: object) -> None:
        """**Raises:** `ValueError` for a limit above the largest count in numbers of this type."""
        for name in ("max_impacts", "max_steps"):
            value = getattr(self, name)
            if value is not None and value > largest_count(dtype):
                raise ValueError(
                    f"Argument `{name}` must be at most {largest_count(dtype)}, up to which "
                    f"numbers of type {dtype} count, but got {value}."
                )


def largest_count(dtype: object) -> int:
    """Return the largest integer up to which floating-point numbers of this type can count."""
    return round(2 / float(jnp.finfo(dtype).eps))


def make_plan(
    machine: AbstractMachine, start: State, cycles: int | Int[Array, ""], options: RunOptions
) -> tuple[Plan, State]:
    """Check the arguments of `simulate`. Returns the plan of the loop, and the start as a state of
    this machine. **Raises:** as `simulate`."""
    machine = machine_of(machine)
    start = machine.start() if start is None else start
    cycles = count("cycles", cycles, least=1)
    options = options.checked(machine)
    method, samples = options.method, options.samples
    assert isinstance(method, AbstractMethod)
    if options.clock is not None:
        machine = in_clock(machine, options.clock)
    require_session("machine", machine)
    modes, history = modes_of(start), history_of(start)
    start, memory = convert_start(machine, without_modes(start)), None
    start = jtu.tree_map(strongly_typed, start)
    check_leaves("start", start)
    require_session("start", start)
    if has_delays(machine):
        check_delays(machine, method)
        check_finite("start", start)
        machine, memory = with_memory(machine, as_floats(machine, start), history)
    method.check(machine)
    if samples and is_autonomous(machine, start):
        raise ValueError(
            "Argument `samples` must be 0 for a machine whose cycles end on a section, but got "
            f"{samples}: their lengths are not known beforehand. Observe it at equal intervals: "
            "`simulate(machine.observed_every(interval), ...)`."
        )
    if isinstance(machine, Scene):
        _check_scalars(machine=machine, start=start)
    _check_numbers(machine)
    check_start(machine, start, repeats=bool(cycles > 1 or concrete(options.settle) != 0))
    if options.begin is None:
        check_prescribed(machine, start)
    machine, start = of_one_type(machine, start)
    parts, motion = max(1, samples), options.record == "motion"
    averages = average_names(machine, start) if motion else ()
    check_units(machine, start, averages + quantity_names(machine, start))
    columns = 12 + 5 * options.impact_log + 4 * options.event_log + len(averages)
    fits_records("cycles", cycles * parts, columns)
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        warn(
            "vi_jax is running in single precision: errors near 1e-6 and tolerances to match. For "
            'double precision call `jax.config.update("jax_enable_x64", True)` first.'
        )
    dtype = jax.eval_shape(machine.position, start).dtype
    options.check_limits(dtype)
    max_steps, rests = options.max_steps, options.rests
    plan = Plan(
        machine=machine,
        method=method,
        cycles=cycles,
        parts=parts,
        records_motion=motion,
        log=options.impact_log,
        events=options.event_log,
        averages=averages,
        rests=(may_rest(machine) if rests is None else rests) and bool(stops_of(machine)),
        backend=lanes.current_backend(),
        settle=_checked_settle(cycles, options.settle, parts, dtype),
        max_steps=_as_number(np.inf if max_steps is None else max_steps, dtype),
        max_impacts=_as_number(options.max_impacts, dtype),
        begin=_clock_reading(options.begin, dtype),
        until=_clock_reading(options.until, dtype),
        stop=options.stop,
        start_modes=_own_modes(machine, start, modes, dtype),
        history=jtu.tree_map(lambda x: x.astype(dtype), history),
        memory=memory,
    )
    return plan, start


def _own_modes(machine: AbstractMachine, start: State, modes: Any, dtype: Any) -> Any:
    """Return the machine's own modes of a start as arrays; `None` if it does not contain them.
    **Raises:** `ValueError` unless there are as many as the machine has."""
    if modes is None:
        return None
    wanted = jax.eval_shape(lambda x: modes_at_start(machine, jnp.zeros((), dtype), x), start)
    if len(modes) != len(wanted) or any(jnp.shape(mode) for mode in modes):
        raise ValueError(
            f"Argument `start` must have {count_of(len(wanted), 'mode')}, a number each, as many "
            f"as a {type(machine).__name__} has, but has {tuple(modes)}."
        )
    return tuple(jnp.asarray(mode, dtype) for mode in modes)


def _clock_reading(given: Any, dtype: Any) -> jax.Array | None:
    return None if given is None else _as_number(given, dtype)


def _as_number(given: Any, dtype: Any) -> jax.Array:
    known = concrete(given)
    return jnp.asarray(given, dtype) if known is None else from_host(known.astype(dtype))


def machine_of(machine: Machine) -> AbstractMachine:
    """Return the machine with arrays instead of `float`s, so that other numbers do not compile
    again. **Raises:** `TypeError` for anything else, and as `check_parts`."""
    instance_of("machine", machine, AbstractMachine, "a `Scene` or an `AbstractMachine`")
    check_parts(machine)
    return jtu.tree_map(strongly_typed, machine)


def _checked_settle(cycles: int, settle: Any, parts: int, dtype: Any) -> jax.Array:
    """Return `settle` as an array. It is NaN, with which no lane starts, if it is traced and no
    valid number of cycles. **Raises:** `ValueError` if it is known and too large."""
    most = largest_count(dtype) // parts
    if concrete(settle) is not None:
        if settle + cycles > most:
            raise ValueError(
                f"Arguments `settle` and `cycles` must add up to at most {most} cycles (of {parts} "
                f"interval(s) each), the most that {dtype} can count, but got {settle} + {cycles}."
            )
        return _as_number(settle, dtype)
    settle = jnp.asarray(settle)
    is_valid = (settle >= 0) & (settle == jnp.round(settle)) & (settle <= most - cycles)
    return jnp.where(is_valid, settle.astype(dtype), jnp.nan)


def as_floats(machine: AbstractMachine, state: State) -> State:
    """Return `state` in arrays of the common floating-point type of it and the machine."""
    dtype = _type_of(machine, state)
    return jtu.tree_map(lambda x: jnp.asarray(x, dtype), state)


def of_one_type(machine: AbstractMachine, start: State) -> tuple[AbstractMachine, State]:
    """Return machine and start with all floating-point numbers of one type, the widest among them.
    Numbers of a machine made before double precision was enabled are promoted, with a warning."""
    dtype = _type_of(machine, start)
    for name, tree in {"machine": machine, "start": start}.items():
        found = [part for part, x in named_leaves(tree) if narrow(x)]
        if found:
            warn_of_narrow(f"Argument `{name}` has numbers ({', '.join(found)})")
    machine = jtu.tree_map(lambda x: x.astype(dtype) if narrow(x) else x, machine)
    return machine, as_floats(machine, start)


def _type_of(machine: AbstractMachine, state: State) -> Any:
    numbers = jtu.tree_leaves(eqx.filter((machine, state), eqx.is_array_like))
    return jnp.result_type(jnp.result_type(float), *numbers)


def _check_scalars(**arguments: Any) -> None:
    for name, tree in arguments.items():
        for part, x in named_leaves(eqx.filter(tree, eqx.is_array)):
            if x.ndim:
                raise ValueError(
                    f"Argument `{name}` must hold scalars (use `jax.vmap` for a batch), but its "
                    f"{part} has shape {x.shape}."
                )


def _check_numbers(machine: AbstractMachine) -> None:
    for part, x in named_leaves(machine):
        numbers = concrete(x)
        if numbers is not None and numbers.dtype.kind == "f" and np.isnan(numbers).any():
            where = f"its {part}" if part else "it"
            raise ValueError(
                f"Argument `machine` must hold numbers, but {where} is {short(numbers)}."
            )


def _check_flow(argument: str, machine: AbstractMachine, state: State) -> None:
    """**Raises:** `TypeError` for an invalid state, which only the field can show."""
    whose = f"`field` of a {type(machine).__name__}"
    try:
        check_before_modes(machine, jnp.zeros(()), state)
        modes = shown_modes(machine, begin_modes(machine, jnp.zeros(()), state))
        check_takes(machine.field, whose, "`t`, the state", (0.0, state, *modes), len(modes))
        rate = lambda s, x: field_in(machine, s, x, begin_modes(machine, s, x))
        with explain_errors(whose):
            jax.eval_shape(rate, jnp.zeros(()), state)
    except (AttributeError, TypeError, ValueError, LookupError) as error:
        if str(error).partition(" must ")[0].endswith(f"of a {type(machine).__name__}"):
            raise
        hint = ". Pass `vi.State(x=0.0, ...)`." if isinstance(state, Mapping) else ""
        raise TypeError(
            f"Argument `{argument}` must be a state of this machine, but got {state!r}, whose "
            f"rate cannot be computed: {error}{hint}"
        ) from None


# A start may differ by this share of the prescribed motion from it: a choice, since states at the
# end of a run have the errors of the method.
_PRESCRIBED = 1e-3


def check_leaves(argument: str, state: State) -> None:
    """**Raises:** `ValueError` if an array in a state is empty."""
    for part, x in named_leaves(state):
        if 0 in jnp.shape(x):
            where = f"its {part}" if part else "it"
            raise ValueError(
                f"Argument `{argument}` must hold numbers, but {where} has shape {jnp.shape(x)}."
            )


def check_reals(name: str, state: State) -> None:
    """**Raises:** `TypeError` that names the part of a state that is no real number."""
    for part, x in named_leaves(state):
        require_real(name, part, x)


def check_finite(argument: str, state: State) -> None:
    """**Raises:** `ValueError` that names a part of a state that is not finite."""
    for part, x in named_leaves(state):
        numbers = concrete(x)
        if numbers is not None and not np.isfinite(numbers).all():
            raise ValueError(f"Argument `{argument}` must be finite, but its {part} is {numbers}.")


def shape_of(argument: str, machine: AbstractMachine, state: State) -> tuple[int, ...]:
    """Return the shape of position and velocity in a state, `()` in a single one. **Raises:**
    `TypeError` for an invalid state of this machine."""
    returned(state, f"`start` of a {type(machine).__name__}", "a state")  # others are not `None`
    check_reals(argument, state)
    if isinstance(machine, Mechanical):
        q = machine._q_shapes
        wanted = q | {f"v.{name}": shape for name, shape in q.items()}
        own = without_history(machine, state) if isinstance(state, NamedState) else state
        given = {part: jnp.shape(x) for part, x in named_leaves(own)}
        if not isinstance(state, NamedState) or given != wanted:
            words = (
                f"{name} of shape {shape}" if shape else name for name, shape in wanted.items()
            )
            other = next((x for x in given if given[x] != wanted.get(x, given[x])), None)
            if other is not None:
                raise TypeError(
                    f"Argument `{argument}` must be one state (use `jax.vmap` for a batch), but "
                    f"its {other} has shape {given[other]}, not {wanted[other]}."
                )
            raise TypeError(
                f"Argument `{argument}` must be a state with {', '.join(words)}, as "
                f"`machine.at(...)` returns, but got {state!r}."
            )
    try:
        both = lambda x, z: (jnp.asarray(x.position(z)), jnp.asarray(x.velocity(z)))
        shapes_of = lambda function: functools.partial(eqx.filter_eval_shape, function)
        place, velocity = _evaluated(machine, both, state, shapes_of)
        shape = place.shape or velocity.shape
    except (AttributeError, TypeError, LookupError) as error:
        raise TypeError(
            f"Argument `{argument}` must be a state of this machine, but got {state!r}: "
            f"{str(error).rstrip('.')}. "
            'Contacts name position and velocity by `on=("x", "u")`, and act on `Y` and `V` if '
            "they name none; `position` and `velocity` of a machine pick other numbers."
        ) from None
    if not shape and not has_velocity(machine, state):
        _check_flow(argument, machine, state)
    return shape


def _evaluated(
    machine: AbstractMachine, function: Callable[[Any, State], Any], state: State,
    transform: Callable[..., Any] = eqx.filter_jit,
) -> Any:  # fmt: skip
    """Return `function(machine, state)`: of a machine with gaps that are functions transformed, by
    default to one program, not one for each operation."""
    has_functions = any(callable(getattr(x, "on", None)) for x in contacts_in(machine))
    return (transform(function) if has_functions else function)(machine, state)


def _check_turn(machine: AbstractMachine, start: State) -> None:
    counter = counter_of(machine)
    if not isinstance(counter, Turn):
        return
    angle, begin = concrete(counter.value(machine, start)), concrete(counter.start)
    beyond = None if angle is None or begin is None else angle - begin - 2 * np.pi
    if beyond is not None and np.any(beyond > -1e-9):  # rounding
        raise ValueError(
            f"Argument `start` must have {counter.name} before the end of a turn, but it is "
            f"{np.max(beyond):.6g} beyond. Subtract whole turns."
        )


def check_prescribed(machine: AbstractMachine, start: State) -> None:
    """**Raises:** `ValueError` if a start does not have the prescribed motion of its machine."""
    if not isinstance(machine, Mechanical) or not isinstance(start, NamedState):
        return
    if type(machine).prescribed is Mechanical.prescribed:
        return
    times = 0.0, INNER_INSTANT * machine.cycle
    given, later = (components(machine._with_prescribed(t, start)) for t in times)
    for name, x in components(start).items():
        number, wanted, other = concrete(x), concrete(given[name]), concrete(later[name])
        if number is None or wanted is None or other is None:
            continue
        if np.any(abs(number - wanted) > _PRESCRIBED * np.maximum(abs(wanted), abs(other))):
            raise ValueError(
                f"Argument `start` must have the prescribed {name} = {wanted:.6g} at time 0, but "
                f"has {number:.6g}. `machine.at(...)` returns such a state."
            )


def check_start(machine: AbstractMachine, start: State, repeats: bool = True) -> None:
    """Warn as `check_values`. **Raises:** `ValueError` or `TypeError` for an invalid concrete
    start."""
    check_reals("start", start)
    start = as_floats(machine, start)  # derivatives of a coordinate need them
    machine = with_some_past(machine, start)
    shape = shape_of("start", machine, start)
    if shape and not contacts_in(machine):
        raise ValueError(
            "Argument `start` must be one state (use `jax.vmap` for a batch), but its first "
            f"component has shape {shape}. If it is one, name the number whose extremes are "
            f"recorded: `def position(self, z): return z.x[0]` in a {type(machine).__name__}, and "
            "`velocity` in the same way."
        )
    if shape:
        raise ValueError(
            "Argument `start` must be one state (use `jax.vmap` for a batch), in which position "
            f"and velocity are numbers, but there they have shape {shape}. A contact names numbers "
            'of arrays, `on=("x[0]", "v[0]")`, or `position` and `velocity` of the machine pick '
            "them."
        )
    check_finite("start", start)
    if isinstance(machine, Scene):
        machine.check_start(start)
    if isinstance(start, eqx.Module):
        require_ranges(start)
    _check_turn(machine, start)
    positions = lambda machine, x: [each.position(x) for each in machine.coordinates]
    places = _evaluated(machine, positions, start)
    for i, stop in enumerate(stops_of(machine)):
        gap, Y = concrete(stop.gap), concrete(places[stop.coordinate])
        if Y is None or gap is None:
            continue
        depth = np.max(stop.sign * Y - gap)
        slack = concrete(rounding_bounds(machine, stop.coordinate, start)[0]) if depth > 0 else None
        if slack is not None and depth > np.max(slack):
            raise ValueError(
                f"Argument `start` must not lie beyond a stop, but lies {depth:g} beyond stop {i} "
                f"({stop.name or stop.side}, gap {gap}). A stop is at +gap on the right, at -gap "
                "on the left."
            )
    check_values(machine, start, repeats)
