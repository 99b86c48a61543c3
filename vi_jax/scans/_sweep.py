"""`sweep`: a parameter changed little by little, the motion carried from value to value."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._checks import concrete, count, fits_records, flag, number, require
from .._messages import Interrupted, at_work, warning_once
from .._programs import compiled, is_outermost
from .._types import State
from ..flow import (
    MethodLike,
    check_noise,
    check_reals,
    check_start,
    chosen,
    machine_of,
    simulate,
)
from ..machine import (
    AbstractMachine,
    bare,
    begun,
    check_again,
    check_leaf,
    replaced,
    stated,
    with_leaf,
)
from ._shaken import Shaken, shaken_by
from ._swept import Sweep
from .grid import LANE
from .regime import REGIMES, impacts_of, least_period

# Values of one call: few, so that an interrupt loses little, but more than a call costs.
_AT_ONCE = 16


@warning_once
def sweep(
    machine: AbstractMachine,
    parameter: str,
    values: Any,
    *,
    start: State = None,
    settle: int = 200,
    cycles: int = 32,
    method: MethodLike = None,
    clock: str | None = None,
    tolerance: float | None = None,
    max_steps: int | None = None,
    noise: Any = None,
    key: Any = None,
    progress: bool = True,
) -> Sweep:
    """Sweep one parameter slowly: run-up with rising values, close-down with falling ones.

    At each value the motion continues from its state at the previous one (the paper's continuation
    method). It keeps to its branch until that ends, so up and down show hysteresis. Works under
    `jit` and `vmap` (over other parameters, starts, or values).

    **Arguments:**

    - `machine`, `parameter`: the machine and the name of the number that is changed, such as
      `"drive.frequency_ratio"`.
    - `values`: its values in the order of the sweep.
    - `start`: state at the first value; by default at rest (a motor at its no-load speed).
    - `settle`, `cycles`: drive cycles at each value before observing, and observed; static.
    - `method`, `clock`: as for `simulate`; by default the `"standard"` preset.
    - `tolerance`: how closely sections must repeat for a period, as in `Regime`.
    - `max_steps`: steps at each value beyond which it counts as failed.
    - `noise`, `key`: a `WhiteNoise`, by default none, and with it one key of JAX's; value number n
      has the key `jax.random.fold_in(key, n)`. Under noise there are no periods: use extremes and
      sections.
    - `progress`: show a bar, in a terminal or a notebook; not within `jit` or `vmap`.

    **Returns:** a `Sweep`. A value that fails is NaN, and the next goes on from the one before it.

    **Raises:** `ValueError` or `TypeError` for an unknown name or values that are no numbers; on
    Ctrl-C `Interrupted`, whose `partial` is the sweep so far.
    """
    machine = machine_of(machine)
    check_leaf(machine, parameter)
    settle, cycles = count("settle", settle), count("cycles", cycles, least=2)
    progress = flag("progress", progress)
    values, numbers = _values(values)
    if max_steps is not None:
        max_steps = count("max_steps", max_steps, least=1)
    fits_records("cycles", values.size * cycles, 4)
    if tolerance is not None:
        require("tolerance", tolerance, low=0.0, open_low=True)
    rests = True
    if numbers is not None:
        ends = [with_leaf(machine, parameter, value) for value in {numbers.min(), numbers.max()}]
        for end in ends:
            check_again(end)
        rests = any(end.may_rest() for end in ends)
    if start is None:
        start = with_leaf(machine, parameter, values[0]).start()
    method = chosen(machine, method)
    if clock is not None:
        machine = machine.in_clock(clock)
    start = replaced(start, machine.adopt(bare(start)))
    check_reals("start", start)
    start = jtu.tree_map(lambda x: jnp.asarray(x, values.dtype), begun(machine, start))
    if numbers is not None:
        check_start(with_leaf(machine, parameter, numbers[0]), bare(start))
    shaken = shaken_by(noise, key, (), (), ())
    if shaken is not None:
        check_noise(machine, bare(start), noise)
    options = (settle, cycles, method, rests, tolerance, max_steps, shaken)
    if not is_outermost(machine, values, start, tolerance, shaken):
        return _sweep(machine, parameter, values, _counted(start, shaken), *options)[1]
    return _in_parts(progress, machine, parameter, values, _counted(start, shaken), *options)


def _counted(start: State, shaken: Shaken | None) -> Any:
    """The start, with noise beside the number of the value, by which each has its own path."""
    return start if shaken is None else (start, jnp.uint32(0))


def _in_parts(progress: bool, machine, parameter, values, start, *options) -> Sweep:
    """Some values at a time, all by one program, so that an interrupt loses few of them.

    **Arguments:** `progress`, whether a bar is shown; all else as `_sweep`.
    """
    if values.size <= _AT_ONCE:
        return _sweep(machine, parameter, values, start, *options)[1]
    missing = -values.size % _AT_ONCE  # filled up by what ends at once
    rows = np.append(np.asarray(values), np.full(missing, np.nan)).reshape(-1, _AT_ONCE)
    parts: list[Sweep] = []

    def kept() -> Interrupted | None:
        return Interrupted("sweep", _row(parts, values.size)) if parts else None

    with at_work("sweep", kept, progress=progress, unit="value", total=values.size) as tell:
        for row in rows:
            start, part = _sweep(machine, parameter, jnp.asarray(row), start, *options)
            parts.append(jax.block_until_ready(part))
            tell(min(_AT_ONCE, values.size - _AT_ONCE * (len(parts) - 1)))
    return _row(parts, values.size)


def _row(parts: list[Sweep], size: int) -> Sweep:
    """The first values of all parts, put together by NumPy: hundreds of them would be a program."""
    return jtu.tree_map(lambda *x: jnp.asarray(np.concatenate(x)[:size]), *parts)


def _values(values: Any) -> tuple[jax.Array, np.ndarray | None]:
    """The values of a sweep, and the same on the host where they are known.

    **Raises:** `ValueError` unless they are finite and in one row.
    """
    values = number("values", values).astype(jnp.result_type(float))
    numbers = concrete(values)
    finite = numbers is None or bool(np.isfinite(numbers).all())
    if values.ndim != 1 or not values.size or not finite:
        infinite = values.ndim == 1 and values.size
        raise ValueError(
            "Argument `values` must be finite numbers in one row, but has shape "
            f"{values.shape}{' and numbers that are not finite' if infinite else ''}."
        )
    return values, numbers


def taken_along(machine: AbstractMachine, state: State) -> State:
    """The state, the body taken along by a stop that has come nearer."""
    here = bare(state)
    for stop in machine.stops:
        body = machine.coordinates[stop.coordinate]
        Y = body.position(here)
        beyond = stop.beyond(Y) > 0
        moved = body.placed(here, stop.place, jnp.zeros_like(Y))
        here = jtu.tree_map(lambda a, b, c=beyond: jnp.where(c, a, b), moved, here)
    return replaced(state, here)


@compiled
def _sweep(
    machine, parameter, values, start, settle, cycles, method, rests, tolerance, max_steps, shaken
) -> tuple[State, Sweep]:
    """The state after the last value, and what was found at each.

    **Arguments:** as `sweep`, all of them checked; `start` as `_counted` has it.
    """

    def one(state, value):
        here, noise = with_leaf(machine, parameter, value), {}
        state, number = (state, None) if shaken is None else state
        if shaken is not None:
            noise = dict(zip(("noise", "key"), shaken.lane({LANE: number}), strict=True))
        state = taken_along(here, state)
        run = simulate(
            here, state, cycles, settle=settle, method=method, rests=rests, max_steps=max_steps,
            **noise,
        )  # fmt: skip
        sections = jtu.tree_map(lambda x: x[1:], run.sections)
        state = jtu.tree_map(lambda a, b: jnp.where(run.successful, a, b), run.last, state)
        onward = state if number is None else (state, number + jnp.uint32(1))
        assert run.y_min is not None and run.y_max is not None
        assert run.impact_speed is not None and run.duration is not None
        period = least_period(
            sections, run.impacts, longest=cycles // 2, tolerance=tolerance, wander=method.wander
        )
        impacts = impacts_of(run.impacts.astype(value.dtype), period)
        return onward, Sweep(
            parameter=parameter,
            values=value,
            y_min=jnp.min(run.y_min),
            y_max=jnp.max(run.y_max),
            period=jnp.where(run.successful, period, REGIMES.failed),
            impacts=jnp.where(run.successful, impacts, jnp.nan),
            frequency_ratio=here.frequency_ratio(jnp.mean(run.duration)),
            impact_speed=jnp.max(run.impact_speed),
            sections=sections,
            result=run.result,
            averages=run.mean_averages(),
            labels=machine.labels,
            units=stated(machine),
            periods=tuple(machine.period_of(n) for n in range(1, cycles // 2 + 1)),
        )

    return jax.lax.scan(one, start, values)
