"""White noise on accelerations, as impulses at equal intervals of a cycle."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.lax import shift_left, shift_right_logical, stop_gradient
from jaxtyping import Array, UInt32

from .._checks import concrete, count, require_real
from .._types import Flag, Scalar, State
from ..lanes import dependent_results
from ..machine import (
    AbstractMachine,
    Prepared,
    Shown,
    cycle_time,
    is_autonomous,
    leaf_names,
    limited_in,
    others_of,
    prepared,
)
from .machine_checks import explain_errors
from .plan import Impulses, Plan, has_fixed_cycle, s_counts_cycles

# Salmon, Moraes, Dror, Shaw: Parallel random numbers: as easy as 1, 2, 3 (SC 2011).
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA


def threefry(key: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Return two words from a key of two words and a counter of two: Threefry-2x32, 20 rounds."""
    keys = key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(_PARITY)
    x, y = first + keys[0], second + keys[1]
    for group in range(5):
        for n in _ROTATIONS[group % 2]:
            x = x + y
            y = x ^ (shift_left(y, jnp.uint32(n)) | shift_right_logical(y, jnp.uint32(32 - n)))
        x = x + keys[(group + 1) % 3]
        y = y + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    return x, y


def normal_pair(key: Array, first: Array, second: Array, dtype) -> tuple[Array, Array]:
    """Return two independent standard normal numbers, by Box and Muller; at most 6.8 in magnitude,
    as each comes from 32 bits."""
    x, y = threefry(key, first, second)
    # The middle of one of 2³² equal parts of (0, 1).
    u = (x.astype(dtype) + jnp.asarray(0.5, dtype)) * jnp.asarray(2.0**-32, dtype)
    angle = y.astype(dtype) * jnp.asarray(2 * jnp.pi * 2.0**-32, dtype)
    # In single precision the sum may round up to 1.
    radius = jnp.sqrt(jnp.maximum(-2.0 * jnp.log(u), 0.0))
    return stop_gradient(radius * jnp.cos(angle)), stop_gradient(radius * jnp.sin(angle))


class WhiteNoise(Shown):
    """White noise on accelerations: dV = … dt + σ dW for the velocities that are named.

    It acts as impulses at `impulses` evenly spaced instants of each cycle, the last at its end. At
    each, a velocity jumps by σ √h N(0, 1). Here h is the time between two instants, and N(0, 1) is
    an independent number for each instant and component. The motion between impulses has no noise,
    so impacts, extremes and derivatives along the path are computed as without noise. The mean gain
    of energy is exact. Other errors decrease with h, so results from two numbers of impulses can be
    extrapolated.

    It is for driven machines, whose cycles end with those of their drive. The instants are equally
    spaced on the clock that counts the cycles. If they are not equally spaced in time (a motor), h
    is the time since the last impulse. Use `machine.observed_every(interval)` for a machine without
    a drive. Machines with resets or user-defined events are refused. An impulse may free a body
    that rests or sticks; the logs of events list no impulses.

    States on record points are those after their impulses; `samples` of a run must divide
    `impulses`. Each lane of a batch has another key (`jax.random.split`). A lane's random numbers
    depend on its key, the cycle and the instant alone, not on the batch, the method or `samples`.
    Cycles are counted from the start, including those of `settle`. A run that continues another one
    needs another key (`jax.random.fold_in`).

    **Arguments:**

    - `amplitudes`: σ of each velocity by its name in the state, as `{"V": 0.5}`, in the units of
      velocity over √time. Each entry of an array gets independent numbers. A function of the state
      returns σ just before an impulse: dV = … dt + σ(state) dW in Itô's sense. It is a compile-time
      constant: define it once.
    - `impulses`: number of impulses in a cycle, at least 1; static.

    **Raises:** `TypeError` or `ValueError` for amplitudes that are not real, not finite or
    negative, and for invalid numbers of impulses.
    """

    amplitudes: dict[str, Any]
    """The amplitudes that are numbers."""
    impulses: int = eqx.field(static=True)
    functions: tuple[tuple[str, Callable], ...] = eqx.field(static=True, init=False)
    """The amplitudes that are functions of the state, by name."""

    def __init__(self, amplitudes: Any, *, impulses: Any = 64):
        if not isinstance(amplitudes, dict) or not amplitudes:
            raise TypeError(
                "Argument `amplitudes` must be a dictionary of at least one velocity's name and "
                f"amplitude, but got {amplitudes!r}."
            )
        self.functions = tuple((name, x) for name, x in amplitudes.items() if callable(x))
        amplitudes = {name: x for name, x in amplitudes.items() if not callable(x)}
        for name, value in amplitudes.items():
            require_real("amplitudes", repr(name), value)
            numbers = concrete(value)
            if numbers is not None and not np.all(
                np.isfinite(numbers) & (np.asarray(numbers) >= 0)
            ):
                raise ValueError(
                    "Argument `amplitudes` must hold finite numbers of at least 0, but that of "
                    f"{name!r} is {value}."
                )
        self.amplitudes = {name: jnp.asarray(x, float) for name, x in amplitudes.items()}
        self.impulses = count("impulses", impulses, least=1, most=2**16)


def with_noise(plan: Plan, start: State, noise: Any, key: Any, samples: int) -> Plan:
    """Return the plan of a run with its noise. **Raises:** `TypeError` or `ValueError` as
    `simulate` for noise, key or samples that do not fit together or do not fit the machine."""
    machine = plan.machine
    check_noise(machine, start, noise)
    if samples and noise.impulses % samples:
        raise ValueError(
            "Argument `samples` must divide the number of impulses in a cycle, "
            f"{noise.impulses}, but got {samples}."
        )
    amplitudes, functions = _by_leaf(start, noise)
    dtype = machine.position(start).dtype
    duration = _duration(machine, start)
    step = 1.0 if duration is None else jnp.asarray(duration, dtype) / noise.impulses
    root = jnp.sqrt(jnp.asarray(step, dtype))
    scales = tuple(None if x is None else jnp.asarray(x, dtype) * root for x in amplitudes)
    impulses = Impulses(words_of(key), scales, noise.impulses, functions, duration is None)
    return dataclasses.replace(plan, noise=impulses)


def in_modes_of(form: Prepared, noise: Impulses, start: State) -> Impulses:
    """Return the noise of a machine that is simulated in its natural modes: its impulses act on the
    machine's own velocities. `start` is a state of the machine itself."""
    leaves, tree = jtu.tree_flatten(start)

    def matrix_to_modes(i: int) -> Array:
        with_leaf = lambda x: tree.unflatten([*leaves[:i], x, *leaves[i + 1 :]])
        return jax.jacfwd(lambda x: jtu.tree_leaves(form.inward(with_leaf(x)))[i])(leaves[i])

    modes = [None if x is None else matrix_to_modes(i) for i, x in enumerate(noise.scales)]
    return dataclasses.replace(noise, modes=tuple(modes))


def check_noise(machine: AbstractMachine, start: State, noise: Any) -> None:
    """**Raises:** `TypeError` or `ValueError` as `simulate` for noise that does not fit the machine
    in the state `start`."""
    if not isinstance(noise, WhiteNoise):
        raise TypeError(f"Argument `noise` must be a `WhiteNoise`, but got {noise!r}.")
    if machine.delays:
        raise ValueError(
            f"Argument `noise` must be left out for a {type(machine).__name__}, which has delays: "
            "impulses would leave a jump in its history at each instant."
        )
    _check_machine(machine, start)
    amplitudes, functions = _by_leaf(start, noise)
    _check_velocities(machine, start, amplitudes)
    if noise.functions and prepared(machine).machine is not machine:
        raise ValueError(
            "Argument `noise` must have numbers as amplitudes for a machine that is followed in "
            f"its natural modes, but has functions for a {type(machine).__name__}."
        )
    for leaf, function in zip(jtu.tree_leaves(start), functions, strict=True):
        if function is not None:
            with explain_errors("A function in argument `noise`"):
                found = jax.eval_shape(lambda x, f=function: _real_amplitude(f(x)), start)
            if found.shape not in ((), jnp.shape(leaf)):
                raise ValueError(
                    "Argument `noise` must have functions that return one amplitude, or an array "
                    f"of shape {jnp.shape(leaf)}, but one returns shape {found.shape}."
                )


def _real_amplitude(amplitude: Any) -> Array:
    """Return the amplitude from a function. **Raises:** `TypeError` if it is no real number."""
    require_real("noise", "amplitude by a function", amplitude)
    return jnp.asarray(amplitude)


def _duration(machine: AbstractMachine, start: State) -> Scalar | float | None:
    """Return the duration of each cycle; `None` if it is not known in advance."""
    if has_fixed_cycle(machine, start):
        return cycle_time(machine)
    if not s_counts_cycles(machine, start):
        return None
    # s is proportional to time if the pace depends neither on s nor on the state.
    zero = jnp.zeros_like(machine.position(start))
    traced = jax.make_jaxpr(machine.pace)(zero, start).jaxpr
    if any(dependent_results(traced, [True] * len(traced.invars), smooth=False)):
        return None
    pace = machine.pace(zero, start)
    assert pace is not None
    return pace * machine.cycle


def _check_machine(machine: AbstractMachine, start: State) -> None:
    name = type(machine).__name__
    if is_autonomous(machine, start):
        raise ValueError(
            "Argument `noise` needs a machine whose cycles end with its drive's, but got a "
            f"{name}. Observe it at equal intervals, as `machine.observed_every(interval)`."
        )
    if others_of(machine):
        raise ValueError(
            "Argument `noise` needs a machine without resets and user-defined events, which its "
            f"velocities may pass in a jump, but got a {name}."
        )


def _by_leaf(start: State, noise: WhiteNoise) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return the amplitude of each array of the state (`None` without noise; 1 for a function), and
    the functions, or `None`."""
    functions = dict(noise.functions)
    amplitudes = {**noise.amplitudes, **dict.fromkeys(functions, 1.0)}
    names = leaf_names(start)
    for name in amplitudes:
        if name not in names:
            raise ValueError(
                f"Argument `noise` must name parts of the state ({', '.join(names)}), but got "
                f"{name!r}."
            )
    leaves = jtu.tree_leaves(start)
    for name, leaf in zip(names, leaves, strict=True):
        shape = jnp.shape(amplitudes.get(name, 0.0))
        if shape not in ((), jnp.shape(leaf)):
            raise ValueError(
                f"Argument `noise` must have for {name!r} one amplitude, or an array of shape "
                f"{jnp.shape(leaf)}, but got shape {shape}."
            )
    of_leaves = tuple(amplitudes.get(name) for name in names)
    return of_leaves, tuple(functions.get(name) for name in names)


def _check_velocities(machine: AbstractMachine, start: State, amplitudes: tuple) -> None:
    """**Raises:** `ValueError` if noise changes more of what a stop limits than its velocity."""
    leaves, tree = jtu.tree_flatten(start)
    direction = [
        jnp.zeros_like(x) if a is None else jnp.ones_like(x)
        for x, a in zip(leaves, amplitudes, strict=True)
    ]
    for k in limited_in(machine):
        place = machine.coordinates[k].position
        velocity = concrete(jax.jvp(place, (start,), (tree.unflatten(direction),))[1])
        if velocity is not None and np.any(velocity):
            raise ValueError(
                "Argument `noise` must change velocities only, but it moves coordinate number "
                f"{k}, which a stop limits."
            )


def lane_key(key: UInt32[Array, "2"], number: UInt32[Array, ""]) -> UInt32[Array, "2"]:
    """Return the words of the key of lane `number` (`jax.random.fold_in`), from those of `key`."""
    return jnp.stack(threefry(key, jnp.uint32(0), number))


def words_of(key: Any) -> UInt32[Array, "2"]:
    """Return the two words of a JAX key. **Raises:** `TypeError` or `ValueError` without one."""
    what = "one key of JAX's Threefry generator, as `jax.random.key(0)` makes it"
    if key is None:
        raise TypeError(f"Argument `key` must be {what}, where there is noise.")
    data = key
    if isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        data = jax.random.key_data(key)
    if not isinstance(data, jax.Array | np.ndarray) or data.dtype != jnp.uint32:
        raise TypeError(f"Argument `key` must be {what}, but got {key!r}.")
    if data.shape != (2,):
        raise ValueError(f"Argument `key` must be {what}, but got {key!r}; use `jax.vmap`.")
    return jnp.asarray(data)


def with_impulse(
    noise: Impulses, when: Flag, cycle: Scalar, instant: Scalar, state: State,
    elapsed: Scalar | None,
) -> State:  # fmt: skip
    """Return the state after impulse number `instant` of `cycle` if `when` is true. Cycles are
    counted from the start of the run, `settle` included. `elapsed` is the time since the last
    impulse, `None` if it is known in advance."""
    leaves, tree = jtu.tree_flatten(state)
    sizes = [0 if x is None else leaf.size for x, leaf in zip(noise.scales, leaves, strict=True)]
    words = cycle.astype(jnp.uint32), instant.astype(jnp.uint32)
    dtype = next(leaf.dtype for leaf, n in zip(leaves, sizes, strict=True) if n)

    def draw(words: tuple[Array, Array]) -> tuple[Array, ...]:
        numbers: list[Array] = []
        for pair in range((sum(sizes) + 1) // 2):
            # The instant takes 16 bits of the second word, the pair those above.
            second = words[1] + jnp.uint32(pair << 16)
            numbers += normal_pair(noise.key, words[0], second, dtype)
        return tuple(numbers[: sum(sizes)])

    def zeros(words: tuple[Array, Array]) -> tuple[Array, ...]:
        return tuple(jnp.zeros((), dtype) for _ in range(sum(sizes)))

    numbers = list(jax.lax.cond(when, draw, zeros, words))
    sqrt_elapsed = None
    if elapsed is not None:
        sqrt_elapsed = jnp.sqrt(jnp.where(when & (elapsed > 0), elapsed, 1.0))
    new = []
    for i, (leaf, scale, n) in enumerate(zip(leaves, noise.scales, sizes, strict=True)):
        if scale is not None and n:
            drawn, numbers = numbers[:n], numbers[n:]
            normal = drawn[0] if leaf.ndim == 0 else jnp.stack(drawn).reshape(leaf.shape)
            f = noise.functions[i]
            size = scale if f is None else scale * f(state)
            jump = normal * (size if sqrt_elapsed is None else size * sqrt_elapsed)
            matrix = noise.modes[i] if noise.modes else None
            jump = jump if matrix is None else matrix @ jump
            leaf = jnp.where(when, leaf + jump, leaf)
        new.append(leaf)
    return tree.unflatten(new)
