"""`simulate`: a scene, a start, a number of cycles and a method give a run."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._checks import concrete, count, one_of
from ..scene import AbstractScene, Scene
from .lane import Plan, Record
from .loop import run_forward, run_reverse
from .methods import AbstractMethod, Adaptive
from .results import ImpactLog, Run, Samples, reason


def simulate(
    scene: AbstractScene,
    start: Any,
    cycles: int,
    *,
    method: AbstractMethod | None = None,
    clock: str | None = None,
    samples: int = 0,
    impact_log: int = 0,
    record: str = "motion",
    adjoint: str = "forward",
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
    - `cycles`: number of drive cycles, at least 1; static.
    - `method`: `Adaptive` (default), `FixedStep` or `ExactFlight`.
    - `clock`: `"phase"` or `"time"`; `None` leaves the scene's own. The phase clock needs a crank
      that turns forward; the time clock carries a start from rest and a stall.
    - `samples`: dense samples per cycle, evenly spaced on the drive's clock. Steps end on them, so
      that they have the method's own accuracy.
    - `impact_log`: number of impacts to log in each cycle; with it comes `Run.clearance`.
    - `record`: `"motion"`, or `"sections"` to leave out extremes, durations and impact speeds
      (then `None`), which is faster.
    - `adjoint`: `"forward"` (fast; `jvp`, `jacfwd`) or `"reverse"` (checkpointed; `vjp`, `grad`).
    - `max_impacts`: impacts in one cycle (or sampling interval) beyond which a lane ends as
      chattering.
    - `max_steps`: steps beyond which a lane ends; by default 65,536 a cycle.
    - `throw`: raise an error if a lane fails, instead of only reporting it in `result`.

    **Returns:** a `Run`.

    **Raises:** `ValueError` or `TypeError` for arguments that cannot be run, before any work.
    Starts and parameters that are being traced cannot be looked at; such a lane ends with
    `RESULTS.bad_start` and harms no other.
    """
    if not isinstance(scene, AbstractScene):
        raise TypeError(
            f"Argument `scene` must be a `Scene` or an `AbstractScene`, but got {scene!r}."
        )
    method = Adaptive() if method is None else method
    if not isinstance(method, AbstractMethod):
        raise TypeError(
            "Argument `method` must be `Adaptive(...)`, `FixedStep(...)` or `ExactFlight()`, but "
            f"got {method!r}."
        )
    cycles = count("cycles", cycles, least=1)
    samples = count("samples", samples)
    impact_log = count("impact_log", impact_log)
    max_impacts = count("max_impacts", max_impacts)
    max_steps = 65536 * cycles if max_steps is None else count("max_steps", max_steps, least=1)
    one_of("record", record, ("motion", "sections"))
    one_of("adjoint", adjoint, ("forward", "reverse"))
    if clock is not None:
        if not isinstance(scene, Scene):
            raise ValueError(
                "Argument `clock` must be left out for a scene of your own, which has its own "
                f"clock, but got {clock!r}."
            )
        scene = scene.in_clock(clock)
    if isinstance(scene, Scene):
        start = scene.adopt(start)
    method.check(scene)
    if isinstance(scene, Scene):
        _check_scalars(scene=scene, start=start)
    _check_start(scene, start)
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        warnings.warn(
            "vi_jax is running in single precision: errors near 1e-6 and tolerances to match. For "
            'double precision call `jax.config.update("jax_enable_x64", True)` first.',
            stacklevel=2,
        )
    plan = Plan(
        scene=scene,
        method=method,
        cycles=cycles,
        parts=max(1, samples),
        motion=record == "motion",
        log=impact_log,
        max_steps=float(max_steps),
        max_impacts=float(max_impacts),
    )
    start = as_floats(scene, start)
    run = _simulate(plan, start, samples > 0, adjoint == "reverse")
    if throw:
        failed = "A lane of the simulation failed; see `RESULTS` and `Run.result`."
        run = eqx.error_if(run, ~run.successful, failed)
    return run


def as_floats(scene: AbstractScene, state: Any) -> Any:
    """`state` in arrays of the one floating-point type that it and the scene's numbers ask for."""
    numbers = jtu.tree_leaves(eqx.filter((scene, state), eqx.is_array_like))
    dtype = jnp.result_type(float, *numbers)
    return jtu.tree_map(lambda x: jnp.asarray(x, dtype), state)


def _check_scalars(**arguments: Any) -> None:
    for name, tree in arguments.items():
        for path, leaf in jtu.tree_leaves_with_path(eqx.filter(tree, eqx.is_array)):
            if leaf.ndim:
                where = jtu.keystr(path).lstrip(".")
                raise ValueError(
                    f"Argument `{name}` must hold scalars (use `jax.vmap` for a batch), but its "
                    f"{where} has shape {leaf.shape}."
                )


def _check_start(scene: AbstractScene, start: Any) -> None:
    for path, leaf in jtu.tree_leaves_with_path(start):
        numbers = concrete(leaf)
        if numbers is not None and not np.isfinite(numbers).all():
            name = jtu.keystr(path).lstrip(".")
            raise ValueError(f"Argument `start` must be finite, but its {name} is {numbers}.")
    scene.check_start(start)
    Y = concrete(scene.position(start))
    for i, stop in enumerate(scene.stops):
        gap = concrete(stop.gap)
        if Y is None or gap is None:
            continue
        depth = np.max(stop.sign * Y - gap)
        if depth > 0:
            raise ValueError(
                f"Argument `start` must not lie beyond a stop, but lies {depth:g} beyond stop {i} "
                f"({stop.side}, gap {gap})."
            )


@eqx.filter_jit
def _simulate(plan: Plan, start: Any, sampled: bool, reverse: bool) -> Run:
    scene = plan.scene
    Y = scene.position(start)
    bad = ~jnp.isfinite(sum(jtu.tree_leaves((start, eqx.filter(scene, eqx.is_inexact_array)))))
    for stop in scene.stops:
        bad = bad | (stop.sign * Y > stop.gap)
    lane, states, records = (run_reverse if reverse else run_forward)(
        plan, plan.launch(start, jax.lax.stop_gradient(bad))
    )
    return _collect(plan, start, sampled, lane, states, records)


def _collect(plan: Plan, start: Any, sampled: bool, lane, states: Any, records: Record) -> Run:
    """The run from what the loop stored for each interval."""
    scene, parts = plan.scene, plan.parts
    points = jtu.tree_map(lambda a, b: jnp.concatenate([a[None], b]), start, states)

    def per_cycle(values, reduce):
        return None if values is None else reduce(values.reshape(plan.cycles, parts), axis=1)

    def whole(values):
        return jnp.where(jnp.isfinite(values), values, 0.0).astype(jnp.int32)

    period = jnp.broadcast_to(scene.period, (plan.cycles,)).astype(scene.position(start).dtype)
    duration = None
    if plan.motion:
        duration = period if records.time is None else per_cycle(records.time, jnp.sum)
    dense = None
    if sampled:
        interval = jnp.repeat(period / parts, parts) if records.time is None else records.time
        time = jnp.concatenate([jnp.zeros_like(interval[:1]), jnp.cumsum(interval)])
        place = jnp.arange(plan.intervals + 1, dtype=time.dtype) / parts
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
        clearance=per_cycle(records.clearance, jnp.min),
        duration=duration,
        frequency_ratio=None if duration is None else scene.frequency_ratio(duration),
        samples=dense,
        impact_log=log,
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
    return ImpactLog(phase, speed, jnp.where(jnp.isnan(stop), -1.0, stop).astype(jnp.int32))
