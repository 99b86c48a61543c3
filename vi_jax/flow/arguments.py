"""What `simulate` was asked, checked and put in the form in which the loop needs it."""

import warnings
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
from ..scene import AbstractScene, RigidStop, Scene
from ._lane import Plan
from .methods import MethodLike, chosen


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
    _check_parts(scene)
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
    plan = Plan(
        scene=scene,
        method=method,
        cycles=cycles,
        parts=max(1, samples),
        motion=record == "motion",
        log=impact_log,
        log_switches=log_switches,
        rests=(scene.may_rest() if rests is None else rests) and bool(scene.stops),
        road=lanes.current_road(),
        settle=_countable(cycles, settle, max(1, samples), dtype),
        max_steps=jnp.asarray(jnp.inf if max_steps is None else max_steps, dtype),
        max_impacts=jnp.asarray(max_impacts, dtype),
    )
    return plan, start


def _check_parts(scene: AbstractScene) -> None:
    """**Raises:** `TypeError` or `ValueError` for a machine whose parts are not what they must."""
    name, stops = type(scene).__name__, scene.stops
    if not isinstance(stops, tuple) or not all(isinstance(stop, RigidStop) for stop in stops):
        raise TypeError(f"`stops` of a {name} must be a tuple of `RigidStop`s, but is {stops!r}.")
    if callable(scene.cycle):
        raise TypeError(f"`cycle` of a {name} must be a number, or a property that gives one.")
    many = len(scene.coordinates)
    for i, stop in enumerate(stops):
        if stop.coordinate >= many:
            raise ValueError(
                f"Stop {i} of a {name} limits coordinate {stop.coordinate}, but there are {many}: "
                "name each in `coordinates`."
            )


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
            f"Argument `start` must be a state of this scene, but got {start!r}. Of a state "
            "without `Y` and `V` a machine of your own says by `position`, `velocity` and "
            "`placed`, or by `coordinates`, what its stops limit."
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
