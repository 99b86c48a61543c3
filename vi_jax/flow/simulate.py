"""`simulate`: a scene, a start, a number of cycles and a method give a run."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import lanes
from .._checks import (
    concrete,
    count,
    count_or_traced,
    fits_records,
    flag,
    narrow,
    one_of,
    warn_of_narrow,
)
from .._programs import compiled
from ..scene import AbstractScene, Scene
from .choice import MethodLike, chosen
from .lane import Plan, Record
from .loop import Ends, run_forward, run_reverse
from .results import Errors, ImpactLog, Run, Samples, reason
from .spoil import spoiled

# Steps in a cycle that reverse mode makes room for, unless the caller says otherwise.
_STEPS = 65536


def simulate(
    scene: AbstractScene,
    start: Any,
    cycles: int,
    *,
    settle: Any = 0,
    method: MethodLike = None,
    clock: str | None = None,
    samples: int = 0,
    impact_log: int = 0,
    record: str = "motion",
    estimate: bool = False,
    adjoint: str = "forward",
    rests: bool | None = None,
    max_impacts: int = 1000,
    max_steps: int | None = None,
    throw: bool = False,
) -> Run:
    """Simulate `scene` from `start` for a number of drive cycles.

    Works under `jit`, under `vmap` over any leaf of the scene and the start, and is differentiable
    through impacts. Outside of a transformation it compiles itself, once for each structure.

    **Arguments:**

    - `scene`: a `Scene`, or an `AbstractScene` of your own.
    - `start`: the state on the first section, from `scene.start(...)`.
    - `cycles`: number of drive cycles to record, at least 1; static.
    - `settle`: drive cycles before them, of which nothing is kept; another number is not another
      program.
    - `method`: `Adaptive(...)`, `FixedStep(...)`, `ExactFlight()`, or the name of a `preset`,
      by default `"standard"`.
    - `clock`: `"phase"` or `"time"`; `None` leaves the scene's own. The phase clock needs a crank
      that turns forward; the time clock carries a start from rest and a stall.
    - `samples`: dense samples per cycle, evenly spaced on the drive's clock. Steps end on them, so
      that they have the method's own accuracy.
    - `impact_log`: number of impacts to log in each cycle; with it comes `Run.clearance`.
    - `record`: `"motion"`, or `"sections"` to leave out extremes, durations and impact speeds
      (then `None`), which is faster.
    - `estimate`: run it again by a tighter method (`AbstractMethod.tighter`) and give the
      differences as `Run.errors`, for two to three times the work.
    - `adjoint`: `"forward"` (fast; `jvp`, `jacfwd`) or `"reverse"` (checkpointed; `vjp`, `grad`).
    - `rests`: whether the body may come to rest on a stop; `False` leaves that out of the program,
      which is a fifth faster. By default it is left out if all gaps are known and greater than 1,
      so that nothing can press the body on.
    - `max_impacts`: impacts in one cycle (or sampling interval) beyond which a lane ends as
      chattering.
    - `max_steps`: steps beyond which a lane ends, apart from 65,536 in any one cycle (or sampling
      interval).
    - `throw`: raise an error if a lane fails, instead of only reporting it in `result`.

    **Returns:** a `Run`.

    **Raises:** `ValueError` or `TypeError` for arguments that cannot be run, before any work.
    Starts and parameters that are being traced cannot be looked at; such a lane ends with
    `RESULTS.bad_start` and harms no other.
    """
    one_of("adjoint", adjoint, ("forward", "reverse"))
    estimate, throw = flag("estimate", estimate), flag("throw", throw)
    plan, start = planned(
        scene, start, cycles, settle=settle, method=method, clock=clock, samples=samples,
        impact_log=impact_log, record=record, reverse=adjoint == "reverse", rests=rests,
        max_impacts=max_impacts, max_steps=max_steps,
    )  # fmt: skip
    with lanes.interruptible():
        run = _simulate(plan, start, samples > 0)
    if estimate:
        tighter = dataclasses.replace(plan, method=plan.method.tighter())
        errors = _errors(run, _simulate(tighter, start, False))
        run = dataclasses.replace(run, errors=errors)
    if throw:
        failed = "A lane of the simulation failed; see `RESULTS` and `Run.result`."
        run = eqx.error_if(run, ~run.successful, failed)
    return run


def planned(
    scene: AbstractScene,
    start: Any,
    cycles: int,
    *,
    settle: Any = 0,
    method: MethodLike = None,
    clock: str | None = None,
    samples: int = 0,
    impact_log: int = 0,
    record: str = "motion",
    reverse: bool = False,
    rests: bool | None = None,
    max_impacts: int = 1000,
    max_steps: int | None = None,
    log_switches: bool = False,
) -> tuple[Plan, Any]:
    """The arguments of `simulate`, checked and put in the form in which the loop needs them."""
    if not isinstance(scene, AbstractScene):
        raise TypeError(
            f"Argument `scene` must be a `Scene` or an `AbstractScene`, but got {scene!r}."
        )
    method = chosen(scene, method)
    cycles = count("cycles", cycles, least=1)
    samples = count("samples", samples)
    impact_log = count("impact_log", impact_log)
    max_impacts = count("max_impacts", max_impacts)
    settle = count_or_traced("settle", settle)
    if rests is not None:
        rests = flag("rests", rests)
    if max_steps is not None:
        max_steps = count("max_steps", max_steps, least=1)
    one_of("record", record, ("motion", "sections"))
    if clock is not None:
        scene = scene.in_clock(clock)
    start = scene.adopt(start)
    method.check(scene)
    if samples and scene.section(start) is not None:
        raise ValueError(
            "Argument `samples` must be 0 for a machine whose cycles end on a section, but got "
            f"{samples}: their lengths are not known beforehand. Observe it at equal intervals: "
            "`simulate(scene.observed_every(interval), ...)`."
        )
    if isinstance(scene, Scene):
        _check_scalars(scene=scene, start=start)
    check_start(scene, start)
    fits_records("cycles", cycles * max(1, samples), 12 + 3 * impact_log)
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        warnings.warn(
            "vi_jax is running in single precision: errors near 1e-6 and tolerances to match. For "
            'double precision call `jax.config.update("jax_enable_x64", True)` first.',
            stacklevel=3,
        )
    scene, start = of_one_type(scene, start)
    dtype = scene.position(start).dtype
    for name, value in (("max_impacts", max_impacts), ("max_steps", max_steps)):
        if value is not None and value > _most(dtype):
            raise ValueError(
                f"Argument `{name}` must be at most {_most(dtype)}, up to which numbers of type "
                f"{dtype} count, but got {value}."
            )
    bound = 0
    if reverse:
        if max_steps is None and concrete(settle) is None:
            raise ValueError("Argument `max_steps` must be given where `settle` is traced.")
        bound = int(_STEPS * (cycles + settle) if max_steps is None else max_steps)
    plan = Plan(
        scene=scene,
        method=method,
        cycles=cycles,
        parts=max(1, samples),
        motion=record == "motion",
        log=impact_log,
        log_switches=log_switches,
        rests=(scene.may_rest() if rests is None else rests) and bool(scene.stops),
        bound=bound,
        road=lanes.current_road(),
        settle=_countable(cycles, settle, max(1, samples), dtype),
        max_steps=jnp.asarray(jnp.inf if max_steps is None else max_steps, dtype),
        max_impacts=jnp.asarray(max_impacts, dtype),
    )
    return plan, start


def _most(dtype: Any) -> int:
    """The loop counts in floating-point numbers, which do so up to here."""
    return round(2 / float(jnp.finfo(dtype).eps))


def _countable(cycles: int, settle: Any, parts: int, dtype: Any) -> jax.Array:
    """`settle` as the loop needs it: NaN, with which no lane starts, if it is traced and no number
    of cycles that can be counted.

    **Raises:** `ValueError` if it is known and cannot be counted.
    """
    most = _most(dtype) // parts
    if concrete(settle) is not None:
        if settle + cycles > most:
            raise ValueError(
                f"Arguments `settle` and `cycles` must add up to at most {most} cycles (of {parts} "
                f"interval(s) each), up to which numbers of type {dtype} count, but got "
                f"{settle} + {cycles}."
            )
        return jnp.asarray(settle, dtype)
    settle = jnp.asarray(settle)
    counts = (settle >= 0) & (settle == jnp.round(settle)) & (settle <= most - cycles)
    return jnp.where(counts, settle.astype(dtype), jnp.nan)


def as_floats(scene: AbstractScene, state: Any) -> Any:
    """`state` in arrays of the one floating-point type that it and the scene's numbers ask for."""
    dtype = _type_of(scene, state)
    return jtu.tree_map(lambda x: jnp.asarray(x, dtype), state)


def of_one_type(scene: AbstractScene, start: Any) -> tuple[AbstractScene, Any]:
    """Scene and start with all their floating-point numbers of one type, the widest among them.

    Numbers of a scene made before double precision was switched on are promoted, with a warning.
    """
    dtype = _type_of(scene, start)
    for name, tree in {"scene": scene, "start": start}.items():
        short = [path for path, x in jtu.tree_leaves_with_path(tree) if narrow(x)]
        if short:
            names = ", ".join(jtu.keystr(path).lstrip(".") for path in short)
            warn_of_narrow(f"Argument `{name}` has numbers ({names})")
    scene = jtu.tree_map(lambda x: x.astype(dtype) if narrow(x) else x, scene)
    return scene, as_floats(scene, start)


def _type_of(scene: AbstractScene, state: Any) -> Any:
    numbers = jtu.tree_leaves(eqx.filter((scene, state), eqx.is_array_like))
    return jnp.result_type(jnp.result_type(float), *numbers)


def _check_scalars(**arguments: Any) -> None:
    for name, tree in arguments.items():
        for path, leaf in jtu.tree_leaves_with_path(eqx.filter(tree, eqx.is_array)):
            if leaf.ndim:
                where = jtu.keystr(path).lstrip(".")
                raise ValueError(
                    f"Argument `{name}` must hold scalars (use `jax.vmap` for a batch), but its "
                    f"{where} has shape {leaf.shape}."
                )


def check_start(scene: AbstractScene, start: Any) -> None:
    """**Raises:** `ValueError` if a concrete start cannot be simulated."""
    try:
        _ = scene.position(start), scene.velocity(start)
    except (AttributeError, TypeError, LookupError):
        raise TypeError(
            f"Argument `start` must be a state of this scene, but got {start!r}."
        ) from None
    for path, leaf in jtu.tree_leaves_with_path(start):
        numbers = concrete(leaf)
        if numbers is not None and not np.isfinite(numbers).all():
            name = jtu.keystr(path).lstrip(".")
            raise ValueError(f"Argument `start` must be finite, but its {name} is {numbers}.")
    scene.check_start(start)
    for i, stop in enumerate(scene.stops):
        gap = concrete(stop.gap)
        Y = concrete(scene.coordinates[stop.coordinate].position(start))
        if Y is None or gap is None:
            continue
        depth = np.max(stop.sign * Y - gap)
        if depth > 0:
            raise ValueError(
                f"Argument `start` must not lie beyond a stop, but lies {depth:g} beyond stop {i} "
                f"({stop.side}, gap {gap})."
            )


@compiled
def _simulate(plan: Plan, start: Any, sampled: bool) -> Run:
    run = run_reverse if plan.bound else run_forward
    return spoiled(plan, start, collect(plan, sampled, *run(plan, start)))


def _errors(run: Run, tighter: Run) -> Errors:
    """What two runs differ by."""

    def apart(a: Any, b: Any) -> Any:
        both = run.successful & tighter.successful
        return jtu.tree_map(lambda a, b: jnp.where(both, jnp.abs(a - b), jnp.nan), a, b)

    return Errors(
        sections=apart(run.sections, tighter.sections),
        y_max=apart(run.y_max, tighter.y_max),
        y_min=apart(run.y_min, tighter.y_min),
        impacts=jnp.abs(run.impacts - tighter.impacts),
    )


def simulate_pool(
    lane_of: Callable[[Any], tuple[AbstractScene, Any]],
    values: Any,
    cycles: int,
    *,
    wanted: Any = None,
    **options: Any,
) -> Run:
    """As `simulate` under `vmap`, for lanes some of which are not wanted; forward mode only.

    **Arguments:** scene and start of one lane from its values; the values of all lanes, a pytree
    with one leading axis; flags of the lanes that are wanted (the others are not run and come
    back as failed); `options` as for `simulate`.
    """

    def one(value, wanted):
        plan, start = planned(*lane_of(value), cycles, **options)
        return spoiled(plan, start, collect(plan, False, *run_forward(plan, start, wanted)))

    if wanted is None:
        wanted = jnp.ones(jtu.tree_leaves(values)[0].shape[0], bool)
    return jax.vmap(one)(values, wanted)


def collect(plan: Plan, sampled: bool, lane: Ends, points: Any, records: Record) -> Run:
    """The run from what the loop stored for each interval."""
    scene, parts = plan.scene, plan.parts
    records = jtu.tree_map(lambda x: x[1:], records)

    def per_cycle(values, reduce):
        return None if values is None else reduce(values.reshape(plan.cycles, parts), axis=1)

    def whole(values):
        return jnp.where(jnp.isfinite(values), values, 0.0).astype(jnp.int32)

    period = jnp.broadcast_to(scene.period, (plan.cycles,)).astype(lane.done.dtype)
    duration = None
    if plan.motion:
        duration = period if records.time is None else per_cycle(records.time, jnp.sum)
    dense = None
    if sampled:
        interval = jnp.repeat(period / parts, parts) if records.time is None else records.time
        time = jnp.concatenate([jnp.zeros_like(interval[:1]), jnp.cumsum(interval)])
        place = jnp.arange(plan.kept + 1, dtype=time.dtype) / parts
        dense = Samples(place, time, points)
    log = None
    if plan.log:
        log = _log(plan, records.log)
    return Run(
        sections=jtu.tree_map(lambda x: x[::parts], points),
        y_max=per_cycle(records.y_max, jnp.max),
        y_min=per_cycle(records.y_min, jnp.min),
        impacts=whole(per_cycle(records.impacts, jnp.sum)),
        impact_speed=per_cycle(records.speed, jnp.max),
        rests=whole(per_cycle(records.rests, jnp.sum)) if records.rests is not None else None,
        impact_energy=per_cycle(records.loss, jnp.sum),
        clearance=per_cycle(records.clearance, jnp.min),
        duration=duration,
        frequency_ratio=None if duration is None else scene.frequency_ratio(duration),
        samples=dense,
        impact_log=log,
        errors=None,
        result=reason(lane.fault),
        steps=lane.steps.astype(jnp.int32),
        rejected=lane.rejected.astype(jnp.int32),
    )


def _log(plan: Plan, entries: Any) -> ImpactLog:
    """The first `plan.log` impacts of each cycle, from those of its intervals."""
    entries = entries.reshape(plan.cycles, plan.parts, 3, plan.log)
    entries = jnp.moveaxis(entries, 2, 0).reshape(3, plan.cycles, plan.parts * plan.log)
    order = jnp.argsort(jnp.isnan(entries[2]), axis=1, stable=True)[:, : plan.log]
    phase, speed, stop = (jnp.take_along_axis(x, order, axis=1) for x in entries)
    phase = plan.scene.as_logged(phase)
    return ImpactLog(phase, speed, jnp.where(jnp.isnan(stop), -1.0, stop).astype(jnp.int32))
