"""`simulate`: the motion of a machine from a start, for a number of cycles, as a `Run`."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jax.interpreters import ad
from jaxtyping import Array, Int

from .. import lanes
from .._checks import flag
from .._messages import warning_once
from .._programs import compiled
from .._types import State
from ..lanes import elementwise_primitive
from ..machine import (
    AbstractMachine,
    as_logged,
    cycle_time,
    frequency_ratio,
    in_rows,
    labels_in,
    limited_in,
    modes_of,
    others_of,
    outcomes_of,
    size_of,
    stated,
    stop_in_words,
    stops_of,
    switches_of,
    without_modes,
)
from ._quantities import has_quantities
from .arguments import RunOptions, make_plan
from .lane import Record
from .loop import Ends, run_lane
from .methods import MethodLike
from .noise import with_noise
from .plan import Plan
from .results import Errors, EventLog, ImpactLog, Run, Samples, outcome_of, raised, reason_of
from .sizes import row_sizes
from .smooth import TIME, means

_CPU_OPTIONS = {
    # Small kernels lose more time by being split over threads than they gain.
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner",
    # The widest available vectors; XLA's default is half of that.
    "xla_cpu_prefer_vector_width": 512,
}


def jit(function: Callable, **options: Any) -> jax.stages.Wrapped:
    """Compile as `jax.jit`, with compiler options for batches of simulations on a CPU.

    On other backends it is plain `jax.jit`. All options of `jax.jit` are accepted. On 1,024 lanes
    with a motor on one core it saves 10 to 33 % of the time. Use it outermost only: JAX refuses
    compiler options within another `jit`.
    """
    return jax.jit(function, **{**compiling(), **options})


def compiling() -> dict[str, Any]:
    """Return compiler options as keyword arguments of `jax.jit` for the default backend."""
    return {"compiler_options": _CPU_OPTIONS} if jax.default_backend() == "cpu" else {}


@warning_once
def simulate(
    machine: AbstractMachine,
    start: State = None,
    cycles: int | Int[Array, ""] = 1,
    *,
    settle: Any = 0,
    method: MethodLike = None,
    clock: str | None = None,
    samples: int = 0,
    impact_log: int = 0,
    event_log: int = 0,
    record: str = "motion",
    estimate: bool = False,
    rests: bool | None = None,
    max_impacts: int = 1000,
    max_steps: int | None = None,
    throw: bool = False,
    noise: Any = None,
    key: Any = None,
) -> Run:
    """Simulate `machine` from `start` for a number of drive cycles.

    Works under `jit`, and under `vmap` over any leaf of machine and start. It is differentiable
    through impacts to any order, forward and in reverse. A gradient with respect to more than four
    numbers goes back along the stored motion and costs about four simulations. It runs forward
    along each number if there are at most four, on XLA's backend, or if a step has no transpose (a
    loop of varying length). Outside of a transformation `simulate` compiles itself, once for each
    structure.

    **Arguments:**

    - `machine`: a `Scene`, or an `AbstractMachine` of your own.
    - `start`: the state on the first section, from `machine.start(...)`; or `last` of another run,
      to continue it with its discrete modes (see `HybridState`). Default: `machine.start()`.
    - `cycles`: number of drive cycles to record, 1 by default; static.
    - `settle`: number of drive cycles simulated before them, which are not recorded. A new value
      does not compile again.
    - `method`: `Adaptive(...)`, `FixedStep(...)`, `Taylor(...)`, `ExactFlight()`, or the name of a
      `preset`, by default `"standard"`.
    - `clock`: `"phase"` or `"time"`; `None` leaves the machine's own. The phase clock needs a crank
      that turns forward; the time clock also allows a start from rest and a stall.
    - `samples`: dense samples per cycle, evenly spaced on the drive's clock. Steps end on them, so
      that they are as accurate as the method.
    - `impact_log`: number of impacts to log in each cycle. It also records `Run.clearance`.
    - `event_log`: number of events of any kind to log in each cycle (`EVENTS`): impacts, coming to
      rest, releases, changes of mode, resets.
    - `record`: `"motion"`, or `"sections"` to leave out extremes, durations and impact speeds (then
      `None`), which is faster.
    - `estimate`: repeat the run with a tighter method (`AbstractMethod.tighter`) and return the
      differences as `Run.errors`, for two to three times the work.
    - `rests`: True if the body may come to rest on a stop. `False` leaves rests out of the program,
      which is a fifth faster. They are left out by default if all gaps are known and greater than
      1, so that nothing can press the body on.
    - `max_impacts`: greatest number of impacts in one cycle (or sampling interval). A lane with
      more ends as chattering.
    - `max_steps`: greatest number of steps of a lane. In addition, no cycle (or sampling interval)
      may have more than 65,536.
    - `throw`: raise an error if a lane fails, instead of only reporting it in `result`.
    - `noise`, `key`: a `WhiteNoise`, by default none, and with it one JAX key for each lane.

    **Returns:** a `Run`.

    **Raises:** `ValueError` or `TypeError` for invalid arguments, before the simulation. Traced
    starts and parameters cannot be checked then. An invalid one ends its lane as
    `RESULTS.bad_start`, without effect on the others.
    """
    estimate, throw = flag("estimate", estimate), flag("throw", throw)
    options = RunOptions(
        settle=settle, method=method, clock=clock, samples=samples, impact_log=impact_log,
        event_log=event_log, record=record, rests=rests, max_impacts=max_impacts,
        max_steps=max_steps,
    )  # fmt: skip
    plan, start = make_plan(machine, start, cycles, options)
    plan = plan if noise is None else with_noise(plan, start, noise, key, samples)
    with lanes.interruptible():
        run = _simulate(plan, start, samples > 0)
    if estimate:
        tighter = dataclasses.replace(plan, method=plan.method.tighter())
        errors = _errors(run, _simulate(tighter, start, False))
        run = dataclasses.replace(run, errors=errors)
    return raised(run, run.failed, "The simulation failed", run.result) if throw else run


def simulate_states(machine: AbstractMachine, start: State, cycles: int, **options: Any) -> Run:
    """Simulate as `simulate`, within a program. Only the states of the run have derivatives, which
    keeps a program of values and derivatives small. `options` are those of `RunOptions`."""
    plan, start = make_plan(machine, start, cycles, RunOptions(**options))
    plan = dataclasses.replace(plan, constant_records=True)
    run = collect(plan, options.get("samples", 0) > 0, *run_lane(plan, start))
    return failed_derivatives(run)


@compiled
def _simulate(plan: Plan, start: State, sampled: bool) -> Run:
    return failed_derivatives(collect(plan, sampled, *run_lane(plan, start)))


@compiled
def _errors(run: Run, tighter: Run) -> Errors:
    """Return the differences between a run and one by a tighter method; NaN if either failed."""

    def difference(a: Any, b: Any) -> Any:
        both = run.successful & tighter.successful
        return jtu.tree_map(lambda a, b: jnp.where(both, jnp.abs(a - b), jnp.nan), a, b)

    return Errors(
        sections=difference(run.sections, tighter.sections),
        y_max=difference(run.y_max, tighter.y_max),
        y_min=difference(run.y_min, tighter.y_min),
        impacts=jnp.abs(run.impacts - tighter.impacts),
    )


def simulate_pool(
    lane_of: Callable[[Any], tuple[AbstractMachine, Any]],
    values: Any,
    cycles: int,
    options: RunOptions,
    wanted: Array | None = None,
    noise_of: Callable[[Any], tuple[Any, Any]] | None = None,
) -> Run:
    """Simulate as `simulate` under `vmap`, in forward mode only. Lanes that are not `wanted` are
    not run, and are returned as failed.

    **Arguments:** `lane_of`, returns machine and start of one lane from its values; `values` of all
    lanes, with one leading axis; `wanted`, a flag for each lane, by default all true; `noise_of`,
    returns noise and key of one lane from its values.
    """

    def run_one(value, wanted):
        plan, start = make_plan(*lane_of(value), cycles, options)
        if noise_of is not None:
            plan = with_noise(plan, start, *noise_of(value), options.samples)
        run = collect(plan, options.samples > 0, *run_lane(plan, start, wanted))
        return failed_derivatives(run)

    if wanted is None:
        wanted = jnp.ones(jtu.tree_leaves(values)[0].shape[0], bool)
    return jax.vmap(run_one)(values, wanted)


def collect(plan: Plan, sampled: bool, lane: Ends, points: State, records: Record) -> Run:
    """Return the run of a lane from its ends, and the states (`points`) and records of its
    intervals, as `run_lane` returns them. If `sampled`, the states are also returned as samples."""
    machine, parts = plan.machine, plan.parts
    points, modes = without_modes(points), modes_of(points) or ()
    records = jtu.tree_map(lambda x: x[1:], records)

    def per_cycle(values, reduce):
        if values is None or parts == 1:
            return values
        return reduce(values.reshape(plan.cycles, parts), axis=1)

    integrals = dict(records.integrals)
    times = integrals.pop(TIME, None)

    def as_counts(values) -> Any:
        if values is None:
            return None
        return jnp.where(jnp.isfinite(values), values, 0.0).astype(jnp.int32)

    period = jnp.broadcast_to(cycle_time(machine), (plan.cycles,)).astype(lane.steps.dtype)
    duration = None
    if plan.records_motion:
        reached = per_cycle(jnp.isfinite(records.impacts), jnp.all)
        fixed = jnp.where(reached, period, jnp.nan)
        duration = fixed if times is None else per_cycle(times, jnp.sum)
    averages = {}
    if integrals:
        # If s is proportional to time but does not measure it, the integrals are over s.
        length = jnp.asarray(machine.cycle, period.dtype) if times is None else duration
        sums = {name: per_cycle(x, jnp.sum) for name, x in integrals.items()}
        averages = means(sums, length)
    quantities, clearance = _quantities(plan, points), None
    if records.clearance is not None:
        distances = [per_cycle(x, jnp.min) for x in records.clearance]
        clearance = _nearest(machine, points, distances)
    dense = None
    if sampled:
        interval = jnp.repeat(period / parts, parts) if times is None else times
        time = jnp.concatenate([jnp.zeros_like(interval[:1]), jnp.cumsum(interval)])
        place = jnp.arange(plan.recorded_intervals + 1, dtype=time.dtype) / parts
        dense = Samples(place, time, points, quantities, modes)
    return Run(
        sections=jtu.tree_map(lambda x: x[::parts], points),
        y_max=per_cycle(records.y_max, jnp.max),
        y_min=per_cycle(records.y_min, jnp.min),
        impacts=as_counts(per_cycle(records.impacts, jnp.sum)),
        impact_speed=per_cycle(records.impact_speed, jnp.max),
        rests=as_counts(per_cycle(records.rests, jnp.sum)),
        reduced=as_counts(per_cycle(records.reduced, jnp.sum)),
        impact_energy=per_cycle(records.impact_energy, jnp.sum),
        clearance=clearance,
        duration=duration,
        frequency_ratio=None if duration is None else frequency_ratio(machine, duration),
        samples=dense,
        impact_log=_impact_log(plan, records.log) if plan.log else None,
        event_log=_event_log(plan, records.events) if plan.events else None,
        errors=None,
        result=reason_of(lane.fault),
        steps=lane.steps.astype(jnp.int32),
        rejected=lane.rejected.astype(jnp.int32),
        averages=averages,
        quantities={name: x[::parts] for name, x in quantities.items()},
        labels=labels_in(machine, jtu.tree_map(lambda x: x[0], points)),
        units=stated(machine),
        modes=tuple(x[::parts] for x in modes),
        history=lane.history,
        outcomes=outcomes_of(machine),
        **_outcome(machine, lane),
    )


def _nearest(machine: AbstractMachine, points: State, distances: list[Any]) -> Array:
    """Return the distances (of each coordinate that stops limit, by cycle) of the coordinate that
    comes nearest to one of its stops, as a share of its motion: others may have another unit."""
    if len(distances) == 1:
        return distances[0]
    start = jtu.tree_map(lambda x: x[0], points)
    size, unravel = row_sizes(machine, start, in_rows(points)), ravel_pytree(start)[1]
    of_coordinates = [
        size_of(machine.coordinates[k].position, start, unravel(size)) for k in limited_in(machine)
    ]
    found = jnp.stack(distances)
    shares = jnp.nanmin(found, axis=1) / jnp.stack(of_coordinates)
    return found[jnp.argmin(jax.lax.stop_gradient(shares))]


def _outcome(machine: AbstractMachine, lane: Ends) -> dict[str, Any]:
    """Return the outcome of a run, and where an event ended it."""
    if lane.at is None:
        return {}
    number, (cycle, clock, state) = outcome_of(lane.fault), lane.at
    clock, state = jtu.tree_map(
        lambda x: jnp.where(number < 0, jnp.nan, x), (as_logged(machine, clock), state)
    )
    cycle = jnp.where(number < 0, -1, cycle).astype(jnp.int32)
    return {
        "outcome": number, "outcome_cycle": cycle, "outcome_phase": clock, "outcome_state": state,
    }  # fmt: skip


def _quantities(plan: Plan, points: State) -> dict[str, Array]:
    machine = plan.machine
    if not has_quantities(machine):
        return {}
    first = jtu.tree_map(lambda x: x[0], points)
    parts = jnp.arange(plan.recorded_intervals + 1) % plan.parts
    s = parts.astype(machine.position(first).dtype) * (jnp.asarray(machine.cycle) / plan.parts)
    if not plan.s_counts_cycles(first):
        s = jnp.zeros_like(s)
    found = jax.vmap(machine.quantities)(s, points)
    return {name: jnp.asarray(x, s.dtype) for name, x in found.items()}


def _impact_log(plan: Plan, entries: Any) -> ImpactLog:
    phase, speed, stop, *impulses = _by_cycle(plan, entries, used=2)
    clock, stops = as_logged(plan.machine, phase), _stop_names(plan.machine)
    return ImpactLog(clock, speed, _as_integers(stop), *impulses, stop_names=stops)


def _stop_names(machine: AbstractMachine) -> tuple[str, ...]:
    return tuple(stop_in_words(machine, stop) for stop in stops_of(machine))


def _event_log(plan: Plan, entries: Any) -> EventLog:
    phase, code, number, value = _by_cycle(plan, entries, used=1)
    names = tuple(event.name for event in others_of(plan.machine))
    switches, modes = switches_of(plan.machine), []
    for i, switch in enumerate(switches):
        index = sum(other.word == switch.word for other in switches[:i])
        modes.append(switch.name or f"{switch.word} {index}")
    clock, stops = as_logged(plan.machine, phase), _stop_names(plan.machine)
    places = clock, _as_integers(code), _as_integers(number), value
    return EventLog(*places, names, tuple(modes), stops)


def _by_cycle(plan: Plan, entries: Array, *, used: int) -> list[Array]:
    """Return the rows of a log (intervals, rows, size), each as (cycles, size): the first entries
    of each cycle in their order. Row `used` is NaN in unused places, the last of an interval."""
    rows, size = entries.shape[1:]
    if plan.parts == 1:
        return list(jnp.moveaxis(entries, 1, 0))
    entries = entries.reshape(plan.cycles, plan.parts, rows, size)
    counts = jnp.sum(~jnp.isnan(entries[:, :, used]), axis=2)
    begins = jnp.cumsum(jnp.pad(counts, ((0, 0), (1, 0))), axis=1)

    def first_entries(entries: Array, begins: Array) -> Array:
        # A sort of all places took four fifths of a scan with 2,048 intervals.
        place = jnp.arange(size)
        part = jnp.searchsorted(begins[1:], place, side="right")
        return entries.at[part, :, place - begins[part]].get(mode="fill", fill_value=jnp.nan)

    return list(jnp.moveaxis(jax.vmap(first_entries)(entries, begins), 2, 0))


def _as_integers(x: Array) -> Array:
    return jnp.where(jnp.isnan(x), -1.0, x).astype(jnp.int32)


# A failed lane has no derivatives: they are NaN. The loop would return zeros, since nothing is
# computed after a failure, and an optimiser would take that for a stationary point.


def failed_derivatives(run: Run) -> Run:
    """Return the same run, with derivatives that are NaN if it failed."""
    numbers, rest = eqx.partition(run, eqx.is_inexact_array)
    marked = _with_nan_derivatives(run.successful, numbers)
    if run.outcome is not None:
        outcome = {name: getattr(numbers, name) for name in ("outcome_phase", "outcome_state")}
        marked = dataclasses.replace(marked, **_with_nan_derivatives(run.outcome >= 0, outcome))
    return eqx.combine(marked, rest)


@jax.custom_jvp
def _with_nan_derivatives(succeeded: object, numbers: object) -> Any:
    return numbers


@_with_nan_derivatives.defjvp
def _(primals, tangents):
    (good, numbers), (_, rates) = primals, tangents

    def marked(rate):
        flags = jnp.reshape(good, good.shape + (1,) * (rate.ndim - good.ndim))
        return _fail.bind(jnp.broadcast_to(flags, rate.shape), rate, back=False)

    return numbers, jtu.tree_map(marked, rates)


def _value(succeeded, x, *, back: bool):
    return jnp.where(succeeded | (x == 0) if back else succeeded, x, jnp.nan)


def _jvp(primals, tangents, *, back: bool):
    (succeeded, x), (_, rate) = primals, tangents
    out = _fail.bind(succeeded, x, back=back)
    return out, rate if type(rate) is ad.Zero else _fail.bind(succeeded, rate, back=back)


def _transpose(weight, succeeded, _, *, back: bool):
    return None, weight if type(weight) is ad.Zero else _fail.bind(succeeded, weight, back=not back)


# Linear for JAX, with a transpose that arithmetic cannot have: a zero cotangent stays zero. So a
# loss that leaves failed lanes out has a finite gradient.
_fail = elementwise_primitive("fail_derivatives", _value, _jvp)
ad.primitive_transposes[_fail] = _transpose
