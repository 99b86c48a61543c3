"""The program of a scan: lanes on a grid, in blocks; their noise, with a path for each lane's
number; and a pytree that is compiled once and can be sent to other processes."""

import dataclasses
import difflib
import functools
import inspect
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Shaped, UInt32

from .._checks import count, strongly_typed, tuple_of_names
from .._types import State
from ..flow import (
    AbstractMethod,
    MethodLike,
    RunOptions,
    WhiteNoise,
    average_names,
    check_noise,
    check_reals,
    check_values,
    chosen,
    has_averages,
    lane_key,
    machine_of,
    number_of,
    simulate_pool,
    words_of,
)
from ..machine import (
    AbstractMachine,
    Mechanical,
    check_again,
    check_leaf,
    check_name,
    components,
    convert_start,
    in_clock,
    leaf,
    leaf_names,
    may_rest,
    overridden,
    replaced,
    with_leaf,
    with_leaves,
    without_modes,
)
from .measures import MEASURES, AbstractMeasure, Average, Numbers
from .statistics import Escape

# The key of a lane's number among its values; it names no axis.
LANE = "lane number"

# Prefixes of the names of axes: of the machine's numbers, of the start's, and of the noise's.
MACHINE, START, NOISE = "", "start.", "noise."


def part_of(name: str) -> str | None:
    """Return the prefix of an axis or derivative (`MACHINE`, `START`, `NOISE`), or `None`."""
    if name == LANE:
        return None
    return next((prefix for prefix in (START, NOISE) if name.startswith(prefix)), MACHINE)


class Blocks:
    """A grid cut into rectangles with at most `lanes` lanes, contiguous in the grid's order. With
    `paired` axes, one lane has the values at one index of all rows. If `numbered`, the index of
    each lane in the grid's order is added to its values."""

    def __init__(
        self,
        axes: Mapping[str, np.ndarray],
        lanes: int,
        *,
        paired: bool = False,
        numbered: bool = False,
    ):
        self.axes, self.paired, self.lanes = dict(axes), paired, lanes
        self.dims = ("sample",) if paired else tuple(axes)
        self.shape = tuple(x.size for x in axes.values())[: 1 if paired else None]
        room = lanes
        block = []
        for size in reversed(self.shape):
            block.append(min(size, room))
            room //= min(size, room)
        self.block = tuple(reversed(block))
        self.numbers = None
        if numbered:
            self.numbers = np.arange(self.total, dtype=np.uint32).reshape(self.shape)

    @property
    def total(self) -> int:
        """The number of lanes in the whole grid."""
        return math.prod(self.shape)

    def dims_of(self, name: str) -> tuple[str]:
        return ("sample",) if self.paired else (name,)

    def __len__(self) -> int:
        return math.prod(map(len, self._edges()))

    def __iter__(self) -> Iterator[tuple[slice, ...]]:
        pairs = zip(self._edges(), self.block, self.shape, strict=True)
        rows = ([slice(i, min(i + n, size)) for i in edges] for edges, n, size in pairs)
        return itertools.product(*rows)

    def _edges(self) -> list[range]:
        return [range(0, size, n) for size, n in zip(self.shape, self.block, strict=True)]

    def values(self, where: tuple[slice, ...]) -> dict[str, np.ndarray]:
        """Return the axes' values of the block's lanes, and their numbers as `LANE`."""
        lane_numbers = {} if self.numbers is None else {LANE: self.numbers[where].ravel()}
        if self.paired:
            return {name: x[where] for name, x in self.axes.items()} | lane_numbers
        rows = [x[part] for x, part in zip(self.axes.values(), where, strict=True)]
        grid = np.meshgrid(*rows, indexing="ij")
        return {name: x.ravel() for name, x in zip(self.axes, grid, strict=True)} | lane_numbers


class LaneNoise(eqx.Module):
    noise: WhiteNoise
    key: UInt32[Array, "2"]
    """The words of the key from which each lane's key is derived."""

    def described(self) -> dict[str, Any]:
        """Return a description for comparison with other noise, in types of JSON."""
        sizes = {name: np.asarray(x).tolist() for name, x in self.noise.amplitudes.items()}
        words = [f"{int(word):08x}" for word in np.asarray(self.key)]
        return {"amplitudes": sizes, "impulses": self.noise.impulses, "key": " ".join(words)}


def lane_noise_of(
    noise: object, key: object, axes: Iterable[str] = (), derivatives: Iterable[str] = ()
) -> LaneNoise | None:
    """Return the noise of a scan, or `None`; `axes` and `derivatives` are names. **Raises:**
    `TypeError` or `ValueError` for arguments that do not fit together."""
    given = {"axes": axes, "derivatives": derivatives}
    names = [
        (which, name) for which, row in given.items() for name in row if part_of(name) == NOISE
    ]
    if noise is None:
        if key is not None or names:
            what = "`key`" if key is not None else f"`{names[0][0]}`, which names {names[0][1]!r},"
            raise ValueError(f"Argument {what} needs noise: give `noise`, a `WhiteNoise`.")
        return None
    if not isinstance(noise, WhiteNoise):
        raise TypeError(f"Argument `noise` must be a `WhiteNoise`, but got {noise!r}.")
    for which, name in names:
        offered = [NOISE + x for x in (*noise.amplitudes, *(["path"] if which == "axes" else []))]
        if name not in offered:
            raise ValueError(
                f"Argument `{which}` must name a number of the noise ({', '.join(offered)}), but "
                f"got {name!r}."
            )
    return LaneNoise(noise, words_of(key))


class ScanProgram(eqx.Module):
    """The computation for every lane of a scan."""

    machine: AbstractMachine | None
    build: Callable[..., Any] | None = eqx.field(static=True)
    """A function that makes the machine from the axes' values, instead of `machine`."""
    start: State
    """The initial state, or `None` for the machine's own."""
    derivatives: tuple[str, ...] = eqx.field(static=True)
    """Names of the numbers with respect to which variables are differentiated."""
    measures: tuple[AbstractMeasure, ...]
    cycles: int = eqx.field(static=True)
    """The number of observed cycles."""
    options: RunOptions
    """The checked options of each run, with a method as an object."""
    lane_noise: LaneNoise | None = None
    """The noise, if any."""

    @property
    def method(self) -> AbstractMethod:
        assert isinstance(self.options.method, AbstractMethod)
        return self.options.method

    def lane(
        self, values: Mapping[str, Any], perturbation: Array | None = None
    ) -> tuple[AbstractMachine, State]:
        """Return machine and start of the lane with these values on the axes, in the scan's clock;
        `perturbation` is added to the numbers of `derivatives`."""
        of_machine = {name: x for name, x in values.items() if part_of(name) == MACHINE}
        if self.build is not None:
            machine = self.build(**of_machine)
            if not isinstance(machine, AbstractMachine):
                raise TypeError(
                    "Argument `machine` must be a function that returns a `Scene` or an "
                    f"`AbstractMachine`, but it returned {machine!r}."
                )
        else:
            assert self.machine is not None
            machine = with_leaves(self.machine, of_machine)
        machine = self._perturbed(machine, MACHINE, perturbation)
        if self.options.clock is not None:
            machine = in_clock(machine, self.options.clock)
        start = machine.start() if self.start is None else self.start
        if isinstance(machine, Mechanical) and self.start is not None:  # another lane's, perhaps
            start = replaced(start, machine._with_prescribed(0.0, without_modes(start)))
        of_start = {name: x for name, x in values.items() if part_of(name) == START}
        start = replaced(start, start_with(without_modes(start), of_start))
        return machine, self._perturbed(start, START, perturbation)

    def at(self, blocks: Blocks, place: int) -> tuple[AbstractMachine, State]:
        return self.lane({name: jnp.asarray(x[place]) for name, x in blocks.axes.items()})

    def noise_of(
        self, values: Mapping[str, Any], perturbation: Array | None = None
    ) -> tuple[WhiteNoise, Array]:
        """Return noise and key of a lane, whose number is in `values`. **Arguments:** as `lane`."""
        assert self.lane_noise is not None
        noise, number = self.lane_noise.noise, jnp.asarray(values[LANE], jnp.uint32)
        sizes = {name: values.get(NOISE + name, x) for name, x in noise.amplitudes.items()}
        sizes = self._perturbed(sizes, NOISE, perturbation) | dict(noise.functions)
        return dataclasses.replace(noise, amplitudes=sizes), lane_key(self.lane_noise.key, number)

    def _perturbed(self, tree: Any, prefix: str, perturbation: Array | None) -> Any:
        """Return `tree` with `perturbation` added to the numbers of `derivatives`."""
        if perturbation is None:
            return tree
        for name, change in zip(self.derivatives, perturbation, strict=True):
            if part_of(name) == prefix:
                key, part = name.removeprefix(prefix), without_modes(tree)
                tree = replaced(tree, with_leaf(part, key, leaf(part, key) + change))
        return tree

    def __call__(
        self, values: dict[str, Shaped[Array, " lanes"]], wanted: Array
    ) -> dict[str, Array]:
        """Return the numbers of all lanes, by name, with `result` among them."""
        found, state = self._measured(values, wanted, None)
        out = dict(found)
        for measure in self.measures:
            if measure.passes == 1:
                out = self._refined(measure, values, wanted, state, out)
                continue

            def run_pass(number, out, measure=measure):
                return self._refined(measure, values, wanted, state, out, number)

            out = jax.lax.fori_loop(0, measure.passes, run_pass, out)
        if self.derivatives:
            basis = jnp.eye(len(self.derivatives), dtype=jnp.result_type(float))

            def floats(perturbation):
                found, _ = self._measured(values, wanted, perturbation)
                return {n: x for n, x in found.items() if jnp.issubdtype(x.dtype, jnp.floating)}

            slopes = jax.vmap(lambda e: jax.jvp(floats, (jnp.zeros_like(e),), (e,))[1])(basis)
            out |= {f"d_{n}": jnp.moveaxis(x, 0, 1) for n, x in slopes.items()}
        return out

    def _measured(self, values, wanted, perturbation) -> tuple[Numbers, State]:
        def build_lane(values):
            return self.lane(values, perturbation)

        options = dataclasses.replace(self.options, clock=None)  # `lane` has set the clock
        noise_of = None
        if self.lane_noise is not None:
            noise_of = functools.partial(self.noise_of, perturbation=perturbation)
        run = simulate_pool(build_lane, values, self.cycles, options, wanted, noise_of)

        def measured(values, run):
            machine, start = build_lane(values)
            found = {}
            for measure in self.measures:
                new = measure.begun(start)(machine, run)
                _check_variables(measure, new, [*found, "result"])
                # A function may evaluate outcomes. Others lose NaN in their fast minima.
                good = ~run.failed if isinstance(measure, Custom) else run.successful
                for name, x in new.items():
                    is_real = jnp.issubdtype(x.dtype, jnp.floating)
                    # Added, not selected, so that the derivative of a failed lane is NaN as well.
                    found[name] = x + jnp.where(good, 0.0, jnp.nan) if is_real else x
            if run.outcome is not None:
                found["outcome"] = run.outcome.astype(jnp.int8)
                found |= {"outcome_cycle": run.outcome_cycle, "outcome_phase": run.outcome_phase}
            return {**found, "result": number_of(run.result).astype(jnp.int8)}

        return jax.vmap(measured)(values, run), jax.vmap(lambda run: run.last)(run)

    def _refined(
        self, measure: AbstractMeasure, values, wanted, state, out: Numbers, *pass_number: Array
    ) -> Numbers:
        """Return `out` with the results of another pass of a measure, for lanes that need it:
        `wanted` are the lanes that are computed, `state` the states after the observed cycles."""
        needed = jax.vmap(lambda found: measure.needs_refinement(found, *pass_number))(out)
        if needed is None:
            return out

        def one(values, state, out, needed):
            machine, _ = self.lane(values)
            # Other lanes end at once, since their start is NaN.
            state = jtu.tree_map(lambda x: jnp.where(needed, x, jnp.nan), state)
            refined = measure.refine(
                machine, state, self.method, out, *pass_number, rests=self.options.rests
            )
            new = {**out, **refined}
            return jtu.tree_map(lambda a, b: jnp.where(needed, a, b), new, out)

        return jax.vmap(one)(values, state, out, needed & wanted & (out["result"] == 0))


def make_program(
    machine: AbstractMachine | Callable[..., AbstractMachine],
    names: tuple[str, ...],
    options: RunOptions,
    *,
    measure: Any,
    start: State = None,
    cycles: int | None = None,
    derivatives: str | Iterable[str] = (),
    noise: Any = None,
    key: Any = None,
) -> ScanProgram:
    """Return the program of a scan, checked as far as possible without the values of its axes."""
    build, machine_names = None, [name for name in names if part_of(name) == MACHINE]
    template = machine_of(machine) if isinstance(machine, AbstractMachine) else None
    if template is not None:
        method, _, averages = _properties(template, options.method, start)
        rests = True  # preliminary: `check_corners` decides
    elif callable(machine):
        build = machine
        method, rests, averages = _properties_of_made(build, machine_names, options.method, start)
    else:
        raise TypeError(
            "Argument `machine` must be a `Scene`, an `AbstractMachine` or a function that makes "
            f"one, but got {machine!r}."
        )
    measures = measures_of(measure, averages)
    derivatives = tuple_of_names("derivatives", derivatives)
    lane_noise = lane_noise_of(noise, key, names, derivatives)
    for measure in measures if lane_noise is not None else ():
        if overridden(measure, AbstractMeasure, "refine"):
            raise ValueError(
                f"Argument `measure` must not contain {type(measure).__name__} with noise: a "
                "motion under noise has no period, and the cycles that the measure adds have no "
                'noise. Use others, such as `measure="extremes"`.'
            )
    cycles = cycles_for(measures, cycles)
    settle = count("settle", options.settle)
    if template is not None:
        first = template.start() if start is None else start
        for name in names:
            check_leaf_name(template, first, name, "axes", lane_noise)
    measures = tuple(measure.under(method) for measure in measures)
    motion = any(measure.record == "motion" for measure in measures)
    # An escaped lane ends early if there is no other measure.
    only_measure = measures[0] if len(measures) == 1 and not derivatives else None
    stop = jtu.Partial(Escape.leaves, only_measure) if isinstance(only_measure, Escape) else None
    options = dataclasses.replace(
        options, settle=settle, method=method, rests=rests,
        record="motion" if motion else "sections", samples=samples_for(measures),
        impact_log=max((m.listed for m in measures), default=0), stop=stop,
    ).checked(template)  # fmt: skip
    return ScanProgram(
        machine=_as_arrays(template),
        build=build,
        start=_as_arrays(start),
        derivatives=derivatives,
        measures=_as_arrays(measures),
        cycles=cycles,
        options=dataclasses.replace(_as_arrays(options), settle=jnp.asarray(settle)),
        lane_noise=lane_noise,
    )


# Properties of all machines of a scan: method, whether a body may come to rest, names of averages.
_Properties = tuple[AbstractMethod, bool, tuple[str, ...]]


def _properties(machine: AbstractMachine, method: MethodLike, start: State) -> _Properties:
    averages: tuple[str, ...] = ()
    if has_averages(machine):
        first = machine.start() if start is None else convert_start(machine, start)
        averages = average_names(machine, first)
    return chosen(machine, method), may_rest(machine), averages


def _properties_of_made(
    build: Callable[..., Any], names: list[str], method: MethodLike, start: State
) -> _Properties:
    """Return `_Properties` of the machines that a function makes. **Raises:** `ValueError` if the
    function does not take these names."""
    try:
        inspect.signature(build).bind(**dict.fromkeys(names))
    except TypeError as error:
        raise ValueError(
            "Argument `axes` must match the arguments of the function in argument `machine`, but: "
            f"{error}."
        ) from None
    except ValueError:
        pass  # its arguments are unknown
    found: list[_Properties] = []

    def inspect_machine(values):
        machine = build(**values)
        is_one = isinstance(machine, AbstractMachine)  # else `lane` raises an error
        unknown = chosen(None, method), True, ()
        found.append(_properties(machine, method, start) if is_one else unknown)

    jax.eval_shape(inspect_machine, {name: jnp.zeros(()) for name in names})
    return found[0]


def _check_variables(measure: AbstractMeasure, new: Iterable[str], taken: list[str]) -> None:
    owner = getattr(measure, "function", measure)
    owner = getattr(owner, "__name__", type(owner).__name__)
    for name in new:
        if not isinstance(name, str) or not name or "/" in name or name.startswith("__"):
            raise ValueError(f"Measure {owner} must name its numbers by words, but has {name!r}.")
        if name in taken:
            raise ValueError(f"Measure {owner} must not return {name!r}, a name in use.")


def _as_arrays(tree: Any) -> Any:
    """Return numbers as arrays, so that other numbers use the same program."""
    return jtu.tree_map(
        lambda x: strongly_typed(jnp.asarray(x) if isinstance(x, np.ndarray | float) else x), tree
    )


def check_leaf_name(
    machine: AbstractMachine, start: State, name: str, argument: str, lane_noise: LaneNoise | None
) -> None:
    """Raise `ValueError` if machine, start and noise have no number with this name."""
    if part_of(name) == NOISE and lane_noise is not None:
        return  # checked with the noise
    of_start, names = part_of(name) == START, [START + n for n in components(without_modes(start))]
    tree, key = (without_modes(start), name.removeprefix(START)) if of_start else (machine, name)
    if key not in leaf_names(tree):
        names = names if of_start else [*components(machine), *names]
        check_name(names, name, argument, machine)
    elif not of_start:
        check_leaf(machine, name)


def start_with(start: State, values: Mapping[str, Any]) -> State:
    return with_leaves(start, {name.removeprefix(START): x for name, x in values.items()})


def _corners(blocks: Blocks) -> np.ndarray:
    """Return the lanes at which the axes have their least and greatest values, as rows."""
    rows = list(blocks.axes.values())
    if blocks.paired:
        ends = {int(place) for x in rows for place in (x.argmin(), x.argmax())}
        return np.stack([x[sorted(ends)] for x in rows], axis=-1)
    corners: Any = [np.unique([x.min(), x.max()]) for x in rows]
    return np.stack(np.meshgrid(*corners, indexing="ij"), axis=-1).reshape(-1, len(rows))


def check_corners(program: ScanProgram, blocks: Blocks) -> ScanProgram:
    """Return the program after checks of machine, start and method at the corners of the grid;
    paired axes have none, so all their lanes are checked. The gaps at the corners decide whether a
    body may come to rest anywhere on the grid; if not, the program omits rests. (If a function
    makes the machines, this is known already.)"""
    rests = False
    if blocks.paired and program.machine is not None:
        rows = {name: x for name, x in blocks.axes.items() if part_of(name) == MACHINE}
        check_again(with_leaves(program.machine, rows))  # all lanes at a time
    for values in _corners(blocks):
        lane = {name: jnp.asarray(x) for name, x in zip(blocks.axes, values, strict=True)}
        machine, start = program.lane(lane)
        check_again(machine)
        rests = rests or may_rest(machine)
        for name in program.derivatives:
            check_leaf_name(machine, start, name, "derivatives", program.lane_noise)
        program.method.check(machine)
        start = convert_start(machine, start)
        check_reals("start", start)
        check_values(machine, start)
        if program.lane_noise is not None:
            check_noise(machine, start, program.noise_of({LANE: 0, **lane})[0])
    if program.build is not None:
        return program
    return dataclasses.replace(program, options=dataclasses.replace(program.options, rests=rests))


class Custom(AbstractMeasure):
    function: Callable[..., Any] = eqx.field(static=True)

    def __call__(self, machine, run):
        found = self.function(machine, run)
        if not isinstance(found, Mapping):
            raise TypeError(
                "A function in argument `measure` must return a mapping of names to numbers, but "
                f"returned {type(found).__name__}."
            )
        numbers = {}
        for name, value in found.items():
            try:
                numbers[name] = jnp.asarray(value)
            except (TypeError, ValueError):
                raise TypeError(
                    "A function in argument `measure` must return numbers, but its "
                    f"{name!r} is {value!r}."
                ) from None
        return numbers


def measures_of(measure: object, averages: Sequence[str] = ()) -> tuple[AbstractMeasure, ...]:
    """Return measures by name, as objects, or functions; `averages` come first."""
    if isinstance(measure, str) or callable(measure) or not isinstance(measure, Iterable):
        measure = (measure,)
    return tuple(_measure(one, averages) for one in measure)


def _measure(one: object, averages: Sequence[str]) -> AbstractMeasure:
    if isinstance(one, AbstractMeasure):
        return one
    if isinstance(one, str):
        if one in averages:
            return Average(one)
        if one in MEASURES:
            return MEASURES[one]()
        names = [*averages, *MEASURES]
        near = difflib.get_close_matches(one, names, n=2, cutoff=0.6)
        hint = f"near names: {', '.join(near)}" if near else f"there are: {', '.join(names)}"
        raise ValueError(f"Argument `measure` must name a measure, but got {one!r}; {hint}.")
    if callable(one):
        return Custom(one)
    raise TypeError(f"Argument `measure` must be a name or a function, but got {one!r}.")


def cycles_for(measures: Iterable[AbstractMeasure], cycles: int | None) -> int:
    """Return the number of cycles to observe: the given one, or what these measures need."""
    needed = max((m.cycles for m in measures), default=1)
    cycles = max(32, needed) if cycles is None else count("cycles", cycles, least=1)
    if cycles < needed:
        name = next(type(m).__name__ for m in measures if m.cycles > cycles)
        raise ValueError(
            f"Argument `cycles` must be at least {needed} for the measure {name}, but got "
            f"{cycles}. Argument `measure` chooses others."
        )
    return cycles


def samples_for(measures: Iterable[AbstractMeasure]) -> int:
    """Return the samples in a cycle. **Raises:** `ValueError` if measures need different ones."""
    found = {m.instants for m in measures if m.instants}
    if len(found) > 1:
        raise ValueError(
            f"Argument `measure` must ask for one number of samples, but asks for {sorted(found)}."
        )
    return max(found, default=0)
