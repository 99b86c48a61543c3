"""`suggest_method`: the fastest method for an error, measured on the user's own computer."""

import contextlib
import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .._checks import count, host_side, require
from .._messages import warning_once
from .._programs import compiled
from .._types import Scalar, State
from ..machine import AbstractMachine, convert_start, in_rows, longest_step, size_of, without_modes
from ._simulate import jit, simulate
from .arguments import check_start, machine_of
from .methods import AbstractMethod, Adaptive, ExactFlight, FixedStep, Taylor, preset
from .methods.verner import Verner9
from .sizes import row_sizes

# Tried numbers of steps in a cycle, each a tenth to a third more than the last, and tolerances.
# Times are medians of this many rounds. All are choices.
_STEPS = (5, 6, 7, 8, 10, 12, 16, 20, 24, 32, 48, 64)
_TOLERANCES = tuple(10.0**-n for n in range(3, 15))
_ROUNDS = 5

# A machine is stiff if its fastest decay needs steps this many times shorter than its motion; then
# implicit methods are tried. A choice.
_STIFF = 20.0


class Tried(NamedTuple):
    """A method that was measured."""

    method: AbstractMethod
    name: str
    error: float
    seconds: float
    """Run time of all lanes; NaN if the error was too large and the method was not timed."""


class Suggestion(NamedTuple):
    """The method that `suggest_method` found, and the measurements of all methods."""

    method: AbstractMethod
    """The fastest method within the error, or the most accurate if none is."""
    reached: bool
    """True if its error is small enough."""
    error: float
    """The error of that method, as measured in the calibration."""
    tried: tuple[Tried, ...]

    def __str__(self) -> str:
        best = next(t for t in self.tried if t.method is self.method)
        note = "" if self.reached else "; no method tried is within the error allowed"
        lines = [f"{best.name}: error {self.error:.1e}{note}", "  tried:"]
        for t in self.tried:
            timing = "" if np.isnan(t.seconds) else f", {1e3 * t.seconds:.3g} ms"
            lines.append(f"    {t.name}: error {t.error:.1e}{timing}")
        return "\n".join(lines)


@host_side
@warning_once
def suggest_method(
    machine: AbstractMachine,
    *,
    error: float = 1e-6,
    start: State = None,
    cycles: int = 20,
    lanes: int = 256,
) -> Suggestion:
    """Find the fastest method within an error, by a short calibration on the machine itself.

    It takes a few seconds, mainly for compiling. A few methods of each kind are compared with
    `ExactFlight`, or else with `Adaptive` at its tightest. Methods within the error are timed.
    Lanes differ in their first velocity. For a stiff machine implicit methods replace fixed steps.

    **Arguments:**

    - `machine`: the machine; its parameters may not be traced.
    - `error`: the largest error of the last section state that is allowed, relative to the size of
      each number, for 95 of 100 lanes.
    - `start`: the first state; by default `machine.start()`.
    - `cycles`: drive cycles of the calibration; in a chaotic motion errors grow with them.
    - `lanes`: the size of the batches for which the method is needed; 1 for a single motion.

    **Returns:** a `Suggestion`. Pass its `method` to other functions; print it for all timings.

    **Raises:** `ValueError` or `TypeError` for invalid arguments.
    """
    if not isinstance(error, int | float | np.floating):
        raise TypeError(f"Argument `error` must be a number, but got {error!r}.")
    require("error", error, low=0.0, open_low=True)
    cycles, lanes = count("cycles", cycles, least=1), count("lanes", lanes, least=1)
    machine = machine_of(machine)
    if start is None:
        start = machine.start()
    start = convert_start(machine, start)
    check_start(machine, start)
    decay_time, longest, speed = _times_and_speed(machine, start)
    bench = _Bench(machine, start, cycles, lanes, float(speed))
    best = preset(machine, "reference")
    exact = isinstance(best, ExactFlight)
    # Does something decay much faster than the motion?
    stiff = not exact and decay_time is not None and float(longest) > _STIFF * float(decay_time)
    if exact:
        reference = best.tighter()
    elif stiff:
        reference = Adaptive(_stiff_solver(), rtol=1e-12, steps_per_cycle=10)
    else:  # at most half as long as the shortest steps that are tried
        reference = Adaptive(rtol=1e-14, steps_per_cycle=2 * max(_STEPS))
    bench.set_reference(reference)
    failed = int(np.sum(~np.isfinite(bench.reference[:, 0])))
    if failed:
        raise ValueError(
            f"Argument `machine` must run for {cycles} cycles, but {failed} of {lanes} lanes of "
            "the calibration failed. See `simulate(...).result`."
        )
    if exact:
        tried = [bench.tried(best, "ExactFlight()")]
    else:
        tried = [] if stiff else _fixed(bench, error)
        tried += _until(bench, error, _adaptive(Verner9()))
        tried += _until(bench, error, _adaptive(_stiff_solver())) if stiff else []
        series = contextlib.suppress(NotImplementedError)  # a primitive has no recursion
        with series if not machine.delays else contextlib.suppress(ValueError):
            tried += _until(bench, error, _series(error))
    accurate = [t for t in tried if t.error <= error]
    timed = bench.measure_times(accurate)
    tried = [timed.get(t.name, t) for t in tried]
    if timed:
        found = min(timed.values(), key=lambda t: t.seconds)
    else:
        found = min(tried, key=lambda t: t.error)
    return Suggestion(found.method, bool(timed), found.error, tuple(tried))


@compiled
def _times_and_speed(machine: AbstractMachine, start: State) -> tuple[Any, Any, Scalar]:
    """Return the time of the fastest decay (`None` if unknown), the longest step, and the size of
    the first velocity, all at the start."""
    s, numbers = jnp.zeros(()), without_modes(start)
    row, unravel = ravel_pytree(numbers)
    sizes = unravel(row_sizes(machine, start, row))
    # Stops limit everything except velocities.
    speed = size_of(machine.coordinates[0].velocity, numbers, sizes)
    return machine.relaxation(s, start), longest_step(machine, s, start), speed


def _until(bench: "_Bench", error: float, methods: list[tuple[str, AbstractMethod]]) -> list[Tried]:
    """Try methods from loose to tight, up to the first whose error is small enough."""
    tried: list[Tried] = []
    for name, method in methods:
        tried.append(bench.tried(method, name))
        if tried[-1].error <= error:
            break
    return tried


def _stiff_solver() -> Any:
    import diffrax  # slow to load

    return diffrax.Kvaerno5()


def _adaptive(solver: Any) -> list[tuple[str, AbstractMethod]]:
    name = f"Adaptive({type(solver).__name__}(), rtol="
    return [(f"{name}{x:.0e})", Adaptive(solver, rtol=x)) for x in _TOLERANCES[:-1]]


def _series(error: float) -> list[tuple[str, AbstractMethod]]:
    """Return Taylor methods of an order for the error; another tolerance does not compile again."""
    order = int(np.clip(round(1.2 * -np.log10(error)), 6, 20))
    tolerances = np.clip(np.array([100.0, 10.0, 1.0, 0.1]) * error, 1e-15, 0.1).tolist()
    return [(f"Taylor({order}, rtol={x:.0e})", Taylor(order, rtol=x)) for x in tolerances]


def _fixed(bench: "_Bench", error: float) -> list[Tried]:
    """Find the fewest fixed steps within the error, by bisection."""
    tried, low, high = [], 0, len(_STEPS) - 1
    while low <= high:
        middle = (low + high) // 2
        steps = _STEPS[middle]
        method = FixedStep(Verner9(), steps)
        tried.append(bench.tried(method, f"FixedStep(Verner9(), {steps})"))
        if tried[-1].error <= error:
            high = middle - 1
        else:
            low = middle + 1
    return tried


class _AnyFixedStep(FixedStep):
    """`FixedStep` whose number of steps is an argument of the compiled program."""

    steps_per_cycle: Any = 10


class _AnyAdaptive(Adaptive):
    steps_per_cycle: Any = eqx.field(kw_only=True, default=5)


_SHARED: dict[type, Any] = {FixedStep: _AnyFixedStep, Adaptive: _AnyAdaptive}


class _Bench:
    """The run by which methods are compared, for lanes that differ in their first velocity."""

    reference: np.ndarray
    sizes: np.ndarray

    def __init__(
        self, machine: AbstractMachine, start: State, cycles: int, lanes: int, speed: float
    ):
        self.machine, self.start, self.cycles = machine, start, cycles
        self.offsets = speed * (np.linspace(-0.1, 0.1, lanes) if lanes > 1 else np.zeros(1))
        self.compiled: dict[Any, Callable] = {}

    def lane(self, method: AbstractMethod, offset: Scalar) -> tuple[Array, Array]:
        """Return the compared numbers, as one vector, of the lane whose first velocity differs by
        `offset`, and their sizes. The first number is infinite if the lane failed."""
        machine, body = self.machine, self.machine.coordinates[0]
        velocity = body.velocity(self.start) + offset
        start = body.placed(self.start, body.position(self.start), velocity)
        run = simulate(machine, start, self.cycles, method=method)
        found = in_rows(without_modes(run.last), 0)
        sizes = row_sizes(machine, start, in_rows(without_modes(run.sections)))
        ended = jnp.where(run.successful, jnp.zeros_like(offset), jnp.inf)
        return jnp.append(ended, found), jnp.append(jnp.ones_like(offset), sizes)

    def program(self, method: AbstractMethod) -> Callable[[], Any]:
        """Return a function that runs all lanes; other tolerances and numbers of steps do not
        compile again."""
        shared = _SHARED.get(type(method))
        if shared is not None:
            values = {f.name: getattr(method, f.name) for f in dataclasses.fields(method)}
            steps = np.asarray(float(method.steps_per_cycle))
            method = eqx.tree_at(lambda m: m.steps_per_cycle, shared(**values), steps)
        numbers, rest = eqx.partition(method, lambda x: isinstance(x, np.ndarray))
        key = jtu.tree_structure(rest), tuple(map(repr, jtu.tree_leaves(rest)))
        if key not in self.compiled:
            self.compiled[key] = jit(
                jax.vmap(
                    lambda numbers, offset: self.lane(eqx.combine(numbers, rest), offset),
                    in_axes=(None, 0),
                )
            )
        run = self.compiled[key]
        return lambda: jax.block_until_ready(run(numbers, self.offsets))

    def set_reference(self, method: AbstractMethod) -> None:
        self.reference, sizes = map(np.asarray, self.program(method)())
        self.sizes = np.where(sizes > 0, sizes, 1.0).max(axis=0)

    def tried(self, method: AbstractMethod, name: str) -> Tried:
        found, reference = np.asarray(self.program(method)()[0]), self.reference
        difference = np.abs(found - reference) / (self.sizes + np.abs(reference))
        difference = np.where(np.isnan(found) & np.isnan(reference), 0.0, difference)
        worst = np.where(np.isfinite(difference), difference, np.inf).max(axis=1)
        return Tried(method, name, float(np.quantile(worst, 0.95, method="higher")), np.nan)

    def measure_times(self, tried: list[Tried]) -> dict[str, Tried]:
        """Return these methods with their times, measured in interleaved rounds."""
        runs = [self.program(t.method) for t in tried]
        times: list[list[float]] = [[] for _ in runs]
        for _ in range(_ROUNDS):
            for run, seconds in zip(runs, times, strict=True):
                begin = time.perf_counter()
                run()
                seconds.append(time.perf_counter() - begin)
        return {
            t.name: t._replace(seconds=float(np.median(seconds)))
            for t, seconds in zip(tried, times, strict=True)
        }
