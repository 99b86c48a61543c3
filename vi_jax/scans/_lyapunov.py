"""Lyapunov exponents, through the impacts."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from .._checks import count, flag
from .._messages import in_parts, warning_once
from .._programs import compiled, is_outermost
from .._types import Number, Scalar, State, xr
from ..flow import (
    RESULTS,
    MethodLike,
    batch_names,
    chosen,
    has_averages,
    has_fixed_cycle,
    in_names,
    machine_of,
    means,
    present,
    row_sizes,
    simulate,
    states,
    tidy,
)
from ..machine import (
    AbstractMachine,
    Mechanical,
    Stated,
    Summarized,
    angles_in,
    attributes,
    components,
    cycle_time,
    has_delays,
    in_rows,
    in_unit,
    is_autonomous,
    modes_of,
    number_in_words,
    raveled,
    renews,
    stated,
    unit_of,
    units_of,
    with_modes,
    with_unit,
    with_units,
    without_modes,
)
from ..orbit import (
    ROUNDINGS,
    CycleMap,
    as_chain,
    cycle_map,
    digits_of,
    map_state,
    weights,
    without_angles,
)


class Lyapunov(Summarized):
    """Lyapunov exponents of a motion. Under `vmap` batch axes come first."""

    exponents: Float[Array, "... states"]
    """The spectrum, greatest first: growth rates per unit of time (`unit`, for a `Scene` ω)."""
    per_cycle: Float[Array, "... states"]
    """The same per cycle (dimensionless): ln|multipliers|/n on an orbit of n cycles. NaN if events
    end the cycles of the machine, but the motion has none."""
    spread: Float[Array, "..."]
    """Difference of the greatest exponent between the two halves of the run."""
    state: State
    """Section state at the end."""
    result: RESULTS
    """The end of the run: `successful`, or a reason for which the numbers are NaN."""
    averages: dict[str, Float[Array, "..."]] = eqx.field(default_factory=dict)
    """The machine's own averages over the time of the observed cycles, by name."""
    units: Stated = eqx.field(static=True, default=())
    """The units that the machine states."""
    unit: str = eqx.field(static=True, default="")
    """The unit of the exponents; "" if the machine states none."""

    @property
    def successful(self) -> Bool[Array, "..."]:
        """True if the run was simulated to its end."""
        return self.result == RESULTS.successful

    def to_xarray(
        self, dims: Sequence[str] | None = None, *, along: str | None = None
    ) -> "xr.Dataset":
        """Return the exponents, or a batch, as an `xarray.Dataset`. The final state has a variable
        for each component (`state_Y`), and `result` is the reason's name. `dims` and `along` are as
        in `Run.to_xarray`; `along` is `"exponent"`, or a batch axis."""
        batch = batch_names(dims, self.exponents.ndim - 1)
        each = *batch, "exponent"
        variables = present({"exponents": self.exponents, "per_cycle": self.per_cycle}, each)
        variables |= states("state", self.state, batch)
        variables |= present(self.averages, batch)
        alone = {"spread": self.spread, "result": in_names(self.result)}
        data = xr.Dataset(variables | present(alone, batch))
        names = "Lyapunov exponents", "difference of the greatest between both halves"
        for name, words in zip(("exponents", "spread"), names, strict=True):
            data[name].attrs |= {"long_name": f"{words}, per unit of time", **attributes(self.unit)}
        data["per_cycle"].attrs |= {"long_name": "Lyapunov exponents", "units": "1/cycle"}
        by_name = {name: name for name in self.averages}
        return tidy(with_units(data, dict(self.units), by_name) if by_name else data, along)

    def summary(self) -> str:
        """Return the exponents as text; for a batch the range of the greatest."""
        if self.exponents.ndim > 1:
            lanes, good = self.spread.shape, int(jnp.sum(self.successful))
            greatest = number_in_words(self.exponents[..., 0].ravel(), self.unit)
            return f"Lyapunov exponents of lanes {lanes}, {good} successful; greatest: {greatest}"
        numbers = ", ".join(f"{x:.9g}" for x in self.exponents)
        ended = "" if bool(self.successful) else f"; ended: {RESULTS[self.result]}"
        numbers = with_unit(numbers, self.unit)
        rate = "" if self.unit else "per unit of time, "
        first = f"Lyapunov exponents {numbers} ({rate}halves differ by {self.spread:.1g}){ended}"
        lines = (
            f"  mean {name}: {in_unit(f'{float(x):.6g}', dict(self.units), name)}"
            for name, x in self.averages.items()
        )
        return "\n".join([first, *lines])


# Cycles of one call if there are more than twice as many: some tenths of a second. A choice, and an
# even number, as the windows of `_window` are.
_AT_ONCE = 512

# Places of a mean over the weights, whose sum over many cycles it gives to rounding: a choice.
_NODES = 512


@warning_once
def lyapunov(
    machine: AbstractMachine,
    start: State = None,
    cycles: int = 400,
    *,
    settle: object = 200,
    number: int | None = None,
    method: MethodLike = None,
    rests: bool | None = None,
    progress: bool = True,
) -> Lyapunov:
    """Compute the Lyapunov spectrum of the motion that `start` settles on.

    Tangent vectors are carried through the flow and its impacts (the saltation matrix) and made
    orthogonal after each drive cycle (Benettin's method). Rates are averaged with weights that
    vanish smoothly at both ends (Das, Saiki, Sander and Yorke 2017). On periodic and quasi-periodic
    motions this converges faster than any power of the number of cycles, after some tens of the
    motion's periods. The exponent 0 along the motion is not included, unless the machine is
    autonomous: then it is observed at intervals of its usual `cycle`. Impacts that cross the ends
    of these intervals slow the convergence (2,000 of a rotor with two stops left 3e-7). A motion
    that rests on a stop forgets its past at once: its exponent is -∞, or very negative if rounding
    remains at the release. Works under `jit` and `vmap`.

    **Arguments:**

    - `machine`, `start`: as for `simulate`, by default the machine's own start; runs in the phase
      clock.
    - `cycles`: the number of observed drive cycles, at least 8; static.
    - `settle`: the number of drive cycles before that.
    - `number`: the number of exponents, greatest first; all by default, but none of coordinates
      with given motion (`prescribed`), and as many as the machine's own states for one with delays,
      which is replaced by its `delay_chain`. Each costs about as much as the simulation itself.
    - `method`: by default the `"standard"` preset.
    - `rests`: as for `simulate`.
    - `progress`: show a bar for more than 1024 cycles, in a terminal or a notebook; not in `jit`.

    **Returns:** a `Lyapunov`, with exponents per unit of time, and per cycle in `per_cycle`.

    **Raises:** as `simulate`; `ValueError` for a machine with both a section and a `renewed`; on
    Ctrl-C, with more than 1024 cycles, `Interrupted`, whose `partial` are the exponents so far.
    """
    cycles, progress = count("cycles", cycles, least=8), flag("progress", progress)
    machine = machine_of(machine)
    start = machine.start() if start is None else start
    count_of_own = len(components(without_modes(start))) if has_delays(machine) else None
    own, start = as_chain(machine, start)
    the_map, start = _observed_map(own, start, method, rests)
    machine = the_map.machine
    states = int(_is_free(machine, start).sum())
    number = (count_of_own or states) if number is None else count("number", number, least=1)
    if number > states:
        raise ValueError(
            f"Argument `number` must be at most {states}, the free states of the machine, but got "
            f"{number}."
        )
    if cycles > 2 * _AT_ONCE and is_outermost(the_map, start, settle):
        window = _window(cycles) if number == 1 else 1
        pieces = (min(_AT_ONCE, cycles - done) for done in range(0, cycles, _AT_ONCE))

        def step(carry, windows):
            carry, observed = _observe_windows(the_map, start, carry, jnp.asarray(windows), window)
            return carry, jtu.tree_map(lambda x: x[:windows], observed)

        def joined(carry, parts) -> Lyapunov:
            observed = jtu.tree_map(lambda *x: jnp.concatenate(x), *parts)
            return _compiled_result(the_map, start, carry, observed, duration)

        begin = _initial_carry(the_map, start, settle, number)
        duration = _mean_duration(the_map, own, start, begin, 2 * _AT_ONCE)
        return in_parts(
            "observation of exponents", step, begin,
            ((size, size // window) for size in pieces), joined, progress=progress, unit="cycle",
            total=cycles,
        )  # fmt: skip
    return _lyapunov(the_map, own, start, cycles, settle, number)


def _observed_map(
    machine: AbstractMachine, start: State, method: MethodLike, rests: bool | None,
    on_section: bool = False,
) -> tuple[CycleMap, State]:  # fmt: skip
    """Return the map whose exponents are computed, and the start in its form."""
    machine = machine_of(machine)
    start = machine.start() if start is None else start
    if not on_section and is_autonomous(machine, without_modes(start)):
        if renews(machine):
            raise ValueError(
                "Argument `machine` must not have both a section and a `renewed`, as a "
                f"{type(machine).__name__} has: at equal intervals it would be renewed there. The "
                "exponents of its periodic motions are ln|multiplier|/duration of an `Orbit`."
            )
        # States on a section do not show the exponent 0 along the motion.
        machine = machine.observed_every(machine.cycle)
    method = chosen(machine, method)
    the_map = cycle_map(machine, method=method)
    if rests is not None:
        the_map = dataclasses.replace(the_map, rests=flag("rests", rests))
    return the_map, map_state(the_map.machine, start, "start")


class Growth(NamedTuple):
    """The greatest exponent of a motion, and how well averages over its sections agree."""

    exponent: Scalar
    per_cycle: Scalar
    digits: Scalar
    """See `agreement`."""
    nearest: Scalar
    """The least distance of a later section from the first, relative to the spread of all."""
    successful: Array


def observe_growth(
    machine: AbstractMachine, start: State, cycles: Any, *, settle: Any, method: MethodLike,
    rests: bool | None, wander: Number = 0.0,
) -> Growth:  # fmt: skip
    """Compute the greatest exponent as `lyapunov` does, over a number of cycles that may be traced,
    a multiple of 4; on an autonomous machine's own section, without the 0 along the motion. Sums
    replace lists of sections, so one program serves any number."""
    the_map, start = _observed_map(machine, start, method, rests, on_section=True)
    angles = angles_in(the_map.machine, without_modes(start))
    window, half = 2, jnp.asarray(cycles // 2, float)
    observe = _observer(the_map, start, window, rows=True)
    carry = _initial_carry(the_map, start, settle, 1)

    def bump(place):
        inside = (place > 0) & (place < 1)
        safe = jnp.where(inside, place, 0.5)
        return jnp.where(inside, jnp.exp(-1 / (safe * (1 - safe))), 0.0)

    def step(i, state):
        carry, (rate, time, duration), (total, squares, first, second), near = state
        carry, (rates, durations, _, rows) = observe(carry, None)
        place = window * i + 0.5 + jnp.arange(window)
        weight = bump(place / (2 * half))
        lost = jnp.any(rates == -jnp.inf)  # where a weight underflows, 0 · ∞ is NaN
        rate = jnp.where(lost, -jnp.inf, rate + weight @ jnp.where(lost, 0.0, rates.ravel()))
        seen = without_angles(rows, sizes, angles)
        values = jnp.concatenate([seen, seen**2], axis=1)
        parts = (bump(place / half) @ values, bump(place / half - 1) @ values)
        sums = (total + values.sum(0), squares + (values**2).sum(0))
        sums = (*sums, first + parts[0], second + parts[1])
        near = jnp.minimum(near, jnp.min(jnp.linalg.norm(seen - origin, axis=1)))
        return carry, (rate, time + weight @ durations, duration + durations.sum()), sums, near

    sizes = row_sizes(the_map.machine, start)
    origin = without_angles(carry[0][0][None], sizes, angles)
    zeros = jnp.zeros(2 * origin.size, origin.dtype)
    zero = jnp.zeros((), origin.dtype)
    state = (carry, (zero, zero, zero), (zeros, zeros, zeros, zeros), zero + jnp.inf)
    found = jax.lax.fori_loop(0, half.astype(int), step, state)
    carry, (rate, time, duration), (total, squares, first, second), near = found
    mean = total / (2 * half)
    spread = jnp.sqrt(jnp.maximum(squares / (2 * half) - mean**2, 0.0))
    unit = bump((jnp.arange(_NODES) + 0.5) / _NODES).mean() * half
    digits = digits_of((first - second) / unit, spread, mean, wander)
    near = near / jnp.linalg.norm(spread[: origin.size])
    good = carry[-1] == RESULTS.successful
    exponent = jnp.where(good, rate / time, jnp.nan)
    return Growth(exponent, exponent * duration / (2 * half), digits, near, good)


@compiled
def _lyapunov(the_map: CycleMap, own, start, cycles: int, settle, number: int) -> Lyapunov:
    carry = _initial_carry(the_map, start, settle, number)
    duration = _mean_duration(the_map, own, start, carry, cycles)
    window = _window(cycles) if number == 1 else 1
    carry, found = jax.lax.scan(_observer(the_map, start, window), carry, length=cycles // window)
    return _result_of(the_map, start, carry, found, duration)


@compiled
def _mean_duration(the_map: CycleMap, own, start, carry, cycles: int) -> Scalar | None:
    """Return the mean duration of the cycles that events of the machine `own` end, after the one in
    which the observation begins, or NaN without such cycles; `None` if the clock ends them."""
    if not is_autonomous(own, without_modes(start)):
        return None
    (x, modes), *_ = carry
    state = with_modes(ravel_pytree(without_modes(start))[1](x), modes)
    run = simulate(own, state, cycles + 1, method=the_map.method, rests=the_map.rests)
    assert run.duration is not None  # by default it is recorded
    duration = run.duration[1:]
    mean = _weighted(duration[:, None], jnp.ones_like(duration))[0][0]
    return jnp.where(run.successful, mean, jnp.nan)


@compiled
def _initial_carry(the_map: CycleMap, start, settle, number: int) -> Any:
    """Return the carry where the observation begins: the state as a row with the machine's own
    modes (or `None`), the first tangent vectors, and the result of the run so far."""
    machine, method, rests = the_map.machine, the_map.method, the_map.rests
    before = simulate(
        machine, start, 1, settle=settle, method=method, rests=rests, record="sections"
    )
    x = raveled(before.last)[0]
    modes = modes_of(before.last)
    # In general position: directions of single components would never change if a component does
    # not act on the others, and could miss the greatest exponent.
    free, frame = _is_free(machine, start), np.zeros((x.size, number))
    drawn = np.random.default_rng(0).normal(size=(free.sum(), free.sum()))
    frame[free] = np.linalg.qr(drawn)[0][:, :number]
    return (x, modes), jnp.asarray(frame, x.dtype), before.result


def _is_free(machine: AbstractMachine, start: State) -> np.ndarray:
    """Return flags of the components of a state that are not of coordinates with given motion."""
    names = [name.removeprefix("v.").split("[")[0] for name in components(without_modes(start))]
    given = set()
    if isinstance(machine, Mechanical):
        given = {*machine._q_names} - {*machine._free_names}
    return np.array([name not in given for name in names])


@compiled
def _observe_windows(the_map: CycleMap, start, carry, windows, window: int) -> Any:
    """Return the observations in the first `windows` windows, and zeros up to `_AT_ONCE` cycles."""
    observe = _observer(the_map, start, window)
    absent = jtu.tree_map(jnp.zeros_like, jax.eval_shape(observe, carry, None)[1])

    def observe_one(carry, i):
        return jax.lax.cond(
            i < windows, lambda carry: observe(carry, None), lambda carry: (carry, absent), carry
        )

    return jax.lax.scan(observe_one, carry, jnp.arange(_AT_ONCE // window))


def _observer(the_map: CycleMap, start, window: int, rows: bool = False) -> Any:
    """Return a `scan` function of rates, durations, integrals and, if asked for, section states."""
    machine, method, rests = the_map.machine, the_map.method, the_map.rests
    unravel = ravel_pytree(without_modes(start))[1]
    # Directions are relative to the sizes of components. With units of very different sizes,
    # rounding of large components would hide small ones.
    unit = row_sizes(machine, start)

    # With cycles of equal duration, turning points are not needed.
    fixed_cycles = has_fixed_cycle(machine, without_modes(start)) and not has_averages(machine)
    record = "sections" if fixed_cycles else "motion"

    def image(x, modes):
        state = with_modes(unravel(x), modes)
        run = simulate(machine, state, window, method=method, rests=rests, record=record)
        duration = run.duration
        if duration is None:
            duration = jnp.full(window, cycle_time(machine), x.dtype)
        integrals = {name: x * duration for name, x in run.averages.items()}
        return in_rows(run.sections)[1:], (duration, integrals, run.result, modes_of(run.last))

    def observe(carry, _):
        (x, modes), frame, result = carry

        def along(direction):
            images = jax.jvp(lambda x: image(x, modes), (x,), (unit * direction,), has_aux=True)
            return images[0], images[1] / unit, images[2]

        new, tangents, (duration, integrals, ended, modes) = jax.vmap(
            along, in_axes=1, out_axes=(None, 2, None)
        )(frame)
        frame, sizes = _orthonormalize(tangents[-1])
        is_single = frame.shape[1] == 1
        vanished = sizes == 0  # their logarithm has no derivative, not even times zero
        logarithms = jnp.where(vanished, -jnp.inf, jnp.log(jnp.where(vanished, 1.0, sizes)))
        rates = _growth(tangents[..., 0])[:, None] if is_single else logarithms[None]
        result = RESULTS.where(result == RESULTS.successful, ended, result)
        found = (rates, duration, integrals, new) if rows else (rates, duration, integrals)
        return ((new[-1], modes), frame, result), found

    return observe


def _result_of(the_map: CycleMap, start, carry, observed, length) -> Lyapunov:
    """Return the exponents. **Arguments:** `carry` and `observed`, from `_observer`'s function;
    `length`, the mean duration of a cycle if events end them."""
    ((x, modes), _, result), (rates, duration, integrals) = carry, observed
    rates, duration, machine = rates.reshape(-1, rates.shape[-1]), duration.ravel(), the_map.machine
    mean, halves = _weighted(rates, duration)
    good = result == RESULTS.successful
    exponents = jnp.sort(jnp.where(good, mean, jnp.nan), descending=True)
    sums = jtu.tree_map(lambda x: jnp.where(good, jnp.sum(x), jnp.nan), integrals)
    return Lyapunov(
        exponents=exponents,
        per_cycle=exponents * (jnp.mean(duration) if length is None else length),
        spread=jnp.where(halves[0] == halves[1], 0.0, jnp.abs(halves[0] - halves[1])),
        state=with_modes(ravel_pytree(without_modes(start))[1](x), modes),
        result=result,
        averages=means(sums, jnp.sum(duration)),
        unit=unit_of(units_of(machine), "rate"),
        units=stated(machine),
    )


_compiled_result = compiled(_result_of)


def _window(cycles: int) -> int:
    """Return the number of cycles after which a direction is normalized. In one its length may
    change by the range of floats; in several long ones it would underflow or overflow."""
    return 2 if cycles % 2 == 0 else 1


def _length(vector: Float[Array, " states"]) -> Scalar:
    """Return the norm of a vector, also if squares of its components underflow or overflow."""
    largest = jnp.max(jnp.abs(vector))
    unit = jnp.where((largest > 0) & (largest < jnp.inf), largest, 1.0)
    # The norm of zero has no derivative, not even times zero.
    norm = jnp.linalg.norm(jnp.where(largest == 0, 1.0, vector / unit))
    return jnp.where(largest == 0, 0.0, unit * norm)


def _growth(directions: Float[Array, "cycles states"]) -> Float[Array, " cycles"]:
    """Return the logarithm of the growth of a direction in each cycle; it begins with length 1."""
    sizes = jax.vmap(_length)(directions)
    before = jnp.concatenate([jnp.ones_like(sizes[:1]), sizes[:-1]])
    # A direction that vanished stays zero.
    return jnp.where(before > 0, jnp.log(sizes / jnp.where(before > 0, before, 1.0)), -jnp.inf)


def _orthonormalize(
    frame: Float[Array, "states number"],
) -> tuple[Float[Array, "states number"], Float[Array, " number"]]:
    """Return the frame made orthonormal (Gram and Schmidt, twice), and its lengths before that."""

    def orthogonal(basis: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
        k, column = given
        before = _length(column)
        for _ in range(2):
            column = column - (basis @ column) @ basis
        size = _length(column)
        # A direction that vanishes, as in a rest, contains only rounding.
        vanished = size <= ROUNDINGS * jnp.finfo(size.dtype).eps * before
        column = jnp.where(vanished, 0.0, column / jnp.where(vanished, 1.0, size))
        return basis.at[k].set(column), jnp.where(vanished, 0.0, size)

    columns = frame.T
    # Unrolled, the loops of a delay chain with 33 numbers compiled in 25 s.
    given = jnp.arange(len(columns)), columns
    basis, sizes = jax.lax.scan(orthogonal, jnp.zeros_like(columns), given)
    return basis.T, sizes


def _weighted(rates, duration):
    """Return mean rates in time, and those of the greatest exponent in both halves."""

    def mean(rates, duration):
        weight = jnp.asarray(weights(duration.size), duration.dtype)
        # At both ends weights underflow, and 0 · ∞ is NaN.
        lost = jnp.any(rates == -jnp.inf, axis=0)
        return jnp.where(lost, -jnp.inf, weight @ jnp.where(lost, 0.0, rates)) / (weight @ duration)

    half = duration.size // 2
    halves = [mean(rates[part, :1], duration[part])[0] for part in (slice(half), slice(half, None))]
    return mean(rates, duration), halves
