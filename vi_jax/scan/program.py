"""What a scan computes of its lanes: a pytree that is compiled once and can be sent away."""

import contextlib
import dataclasses
import inspect
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._checks import count, tuple_of
from .._numbers import strongly_typed
from ..flow import AbstractMethod
from ..flow.arguments import check_period, check_reals, machine_of, refuse_arrays
from ..flow.methods import MethodLike, chosen
from ..flow.named import average_names, has_averages
from ..flow.results import number_of
from ..flow.simulate import simulate_pool
from ..machine import AbstractMachine
from ..machine.numbers import check_again, check_name, leaf, leaf_names, with_leaf
from ._asked import measures_of
from .grid import Blocks
from .measures import AbstractMeasure, Numbers

START = "start."


class ScanProgram(eqx.Module):
    """What is computed of every lane of a scan."""

    machine: AbstractMachine | None
    build: Callable[..., Any] | None = eqx.field(static=True)
    """Makes the machine of the axes' values, in place of `machine`."""
    start: Any
    """The first state, or `None` for the machine's own."""
    derivatives: tuple[str, ...] = eqx.field(static=True)
    measures: tuple[AbstractMeasure, ...]
    method: AbstractMethod
    clock: str | None = eqx.field(static=True)
    cycles: int = eqx.field(static=True)
    settle: Array
    max_impacts: int = eqx.field(static=True)
    max_steps: int | None = eqx.field(static=True)
    rests: bool = eqx.field(static=True, default=True)
    """Whether the body may come to rest on a stop."""

    @property
    def record(self) -> str:
        """What the measures must see of the cycles."""
        return "motion" if any(m.record == "motion" for m in self.measures) else "sections"

    def lane(self, values: dict[str, Any], nudge: Any = None) -> tuple[AbstractMachine, Any]:
        """Scene and start of the lane with these values on the axes."""
        of_scene = {name: x for name, x in values.items() if not name.startswith(START)}
        if self.build is not None:
            machine = self.build(**of_scene)
            if not isinstance(machine, AbstractMachine):
                raise TypeError(
                    "Argument `machine` must be a function that returns a `Scene` or an "
                    f"`AbstractMachine`, but it returned {machine!r}."
                )
        else:
            machine = self.machine
            for name, value in of_scene.items():
                machine = with_leaf(machine, name, value)
        assert machine is not None
        machine = self._nudged(machine, "", nudge)
        if self.clock is not None:
            machine = machine.in_clock(self.clock)
        start = self.start
        if start is None:
            start = machine.start()
        for name, value in values.items():
            if name.startswith(START):
                start = with_leaf(start, name.removeprefix(START), value)
        return machine, self._nudged(start, START, nudge)

    def first(self, blocks: Blocks) -> tuple[AbstractMachine, Any]:
        """Scene and start of the first lane."""
        return self.lane({name: jnp.asarray(x[0]) for name, x in blocks.axes.items()})

    def _nudged(self, tree: Any, prefix: str, nudge: Any) -> Any:
        """`tree` with the numbers moved that derivatives are asked for."""
        if nudge is None:
            return tree
        for name, change in zip(self.derivatives, nudge, strict=True):
            if name.startswith(START) == bool(prefix):
                own = name.removeprefix(prefix)
                tree = with_leaf(tree, own, leaf(tree, own) + change)
        return tree

    def __call__(
        self, values: dict[str, Float[Array, " lanes"]], wanted: Array
    ) -> dict[str, Array]:
        """The numbers of all lanes, by name; `result` among them."""
        found, state = self._first(values, wanted, None)
        out = dict(found)
        for measure in self.measures:
            if measure.passes == 1:
                out = self._again(measure, values, wanted, state, out)
                continue

            def again(number, out, measure=measure):
                return self._again(measure, values, wanted, state, out, number)

            out = jax.lax.fori_loop(0, measure.passes, again, out)
        if self.derivatives:
            basis = jnp.eye(len(self.derivatives), dtype=jtu.tree_leaves(values)[0].dtype)

            def floats(nudge):
                found, _ = self._first(values, wanted, nudge)
                return {n: x for n, x in found.items() if jnp.issubdtype(x.dtype, jnp.floating)}

            slopes = jax.vmap(lambda e: jax.jvp(floats, (jnp.zeros_like(e),), (e,))[1])(basis)
            out |= {f"d_{n}": jnp.moveaxis(x, 0, 1) for n, x in slopes.items()}
        return out

    def _first(self, values, wanted, nudge) -> tuple[Numbers, Any]:
        def lane_of(values):
            return self.lane(values, nudge)

        run = simulate_pool(
            lane_of, values, self.cycles,
            wanted=wanted, method=self.method, settle=self.settle,
            max_impacts=self.max_impacts, max_steps=self.max_steps, rests=self.rests,
            record=self.record,
        )  # fmt: skip

        def measured(values, run):
            machine, _ = lane_of(values)
            found = {}
            for measure in self.measures:
                new = measure(machine, run)
                _check_variables(measure, new, [*found, "result"])
                found |= new
            for name, x in found.items():
                if jnp.issubdtype(x.dtype, jnp.floating):  # fast minima lose NaN
                    # Added, not chosen: the derivative of a failed lane stays NaN as well.
                    found[name] = x + jnp.where(run.successful, 0.0, jnp.nan)
            return {**found, "result": number_of(run.result).astype(jnp.int8)}

        return jax.vmap(measured)(values, run), jax.vmap(lambda run: run.last)(run)

    def _again(
        self, measure: AbstractMeasure, values, wanted, state, out: Numbers, *pass_number: Array
    ) -> Numbers:
        """`out` with what `measure` finds at another pass, at the lanes that need it only."""
        needs_refinement = jax.vmap(lambda found: measure.needs_refinement(found, *pass_number))(
            out
        )
        if needs_refinement is None:
            return out

        def one(values, state, out, needs_refinement):
            machine, _ = self.lane(values)
            # Another lane ends at once, its start being no number.
            state = jtu.tree_map(lambda x: jnp.where(needs_refinement, x, jnp.nan), state)
            refined = measure.refine(
                machine, state, self.method, out, *pass_number, rests=self.rests
            )
            new = {**out, **refined}
            return jtu.tree_map(lambda a, b: jnp.where(needs_refinement, a, b), new, out)

        return jax.vmap(one)(values, state, out, needs_refinement & wanted & (out["result"] == 0))


def make_program(
    machine: Any,
    names: tuple[str, ...],
    *,
    measure: Any,
    start: Any = None,
    settle: Any = 200,
    cycles: int | None = None,
    method: MethodLike = None,
    clock: str | None = None,
    derivatives: Iterable[str] = (),
    max_impacts: int = 1000,
    max_steps: int | None = None,
) -> ScanProgram:
    """The work for each lane, its arguments checked as far as they can be without the axes."""
    measures = measures_of(measure, _averages_of(machine, names, start))
    needed = max(m.cycles for m in measures)
    cycles = max(32, needed) if cycles is None else count("cycles", cycles, least=1)
    if cycles < needed:
        who = next(type(m).__name__ for m in measures if m.cycles > cycles)
        raise ValueError(
            f"Argument `cycles` must be at least {needed} for the measure {who}, but got {cycles}."
        )
    settle = count("settle", settle)
    derivatives = (derivatives,) if isinstance(derivatives, str) else derivatives
    if isinstance(machine, AbstractMachine):
        template, build, rests = machine_of(machine), None, True
        method = chosen(template, method)
    elif callable(machine):
        template, build = None, machine
        own = [name for name in names if not name.startswith(START)]
        _check_names_of(machine, own)
        method, rests = _suited(build, own, method)
    else:
        raise TypeError(
            "Argument `machine` must be a `Scene`, an `AbstractMachine` or a function that makes "
            f"one, but got {machine!r}."
        )
    first = start
    if template is not None and start is None:
        first = template.start()
    if first is not None:
        refuse_arrays("start", "scan", first)
    if template is not None:
        for name in names:
            _check_name(template, first, name, "axes")
    measures = tuple(measure.under(method) for measure in measures)
    return ScanProgram(
        machine=_as_arrays(template),
        build=build,
        start=_as_arrays(start),
        derivatives=tuple_of("derivatives", derivatives, str),
        measures=_as_arrays(measures),
        method=_as_arrays(method),
        clock=clock,
        cycles=cycles,
        settle=jnp.asarray(settle),
        max_impacts=count("max_impacts", max_impacts),
        max_steps=None if max_steps is None else count("max_steps", max_steps, least=1),
        rests=rests,
    )


def _averages_of(machine: Any, axes: Iterable[str], start: Any) -> tuple[str, ...]:
    """The names of the averages of a machine, or of those that a function makes."""
    if isinstance(machine, AbstractMachine):
        return _names_of(machine, start)
    found: list[tuple[str, ...]] = []

    def made(values):
        found.append(_names_of(machine(**values), start))

    # What cannot be made is told where the method is looked for.
    with contextlib.suppress(Exception):
        jax.eval_shape(made, {x: jnp.zeros(()) for x in axes if not x.startswith(START)})
    return found[0] if found else ()


def _names_of(machine: Any, start: Any) -> tuple[str, ...]:
    if not isinstance(machine, AbstractMachine) or not has_averages(machine):
        return ()
    return average_names(machine, machine.start() if start is None else machine.adopt(start))


def _suited(
    build: Callable[..., Any], names: list[str], method: MethodLike
) -> tuple[AbstractMethod, bool]:
    """The method for the machines that a function makes, and whether a body can come to rest in
    them, whatever its values."""
    found: list[tuple[AbstractMethod, bool]] = []

    def made(values):
        machine = build(**values)
        if isinstance(machine, AbstractMachine):
            found.append((chosen(machine, method), machine.may_rest()))
        else:  # refused once there are lanes
            found.append((chosen(None, method), True))

    jax.eval_shape(made, {name: jnp.zeros(()) for name in names})
    return found[0]


def _check_names_of(build: Callable[..., Any], names: list[str]) -> None:
    """**Raises:** `ValueError` if the function that makes machines does not take these names."""
    try:
        inspect.signature(build).bind(**dict.fromkeys(names))
    except TypeError as error:
        raise ValueError(
            "Argument `axes` must give the function in argument `machine` what it takes, but: "
            f"{error}."
        ) from None
    except ValueError:
        return  # its arguments are not known


def _check_variables(measure: AbstractMeasure, new: Iterable[str], taken: list[str]) -> None:
    """**Raises:** `ValueError` if a name is none for a variable, or another's."""
    who = getattr(measure, "function", measure)
    who = getattr(who, "__name__", type(who).__name__)
    for name in new:
        if not isinstance(name, str) or not name or "/" in name or name.startswith("__"):
            raise ValueError(f"Measure {who} must name its numbers by words, but gives {name!r}.")
        if name in taken:
            raise ValueError(f"Measure {who} must not give {name!r}, which is another's name.")


def _as_arrays(tree: Any) -> Any:
    """Numbers as arrays, so that others are not another program."""
    return jtu.tree_map(
        lambda x: strongly_typed(jnp.asarray(x) if isinstance(x, np.ndarray | float) else x), tree
    )


def _check_name(machine: AbstractMachine, start: Any, name: str, argument: str) -> None:
    names = leaf_names(machine) + [START + n for n in leaf_names(start)]
    check_name(names, name, argument)


def _corners(blocks: Blocks) -> np.ndarray:
    """The lanes in which the axes have their least and greatest values, one in a row."""
    rows = list(blocks.axes.values())
    if blocks.paired:
        ends = {int(place) for x in rows for place in (x.argmin(), x.argmax())}
        return np.stack([x[sorted(ends)] for x in rows], axis=-1)
    corners: Any = [np.unique([x.min(), x.max()]) for x in rows]
    return np.stack(np.meshgrid(*corners, indexing="ij"), axis=-1).reshape(-1, len(rows))


def check_corners(job: ScanProgram, blocks: Blocks) -> ScanProgram:
    """The job, after the checks of machine, start and method on the corners of the grid.

    What the corners say about the gaps holds for the grid, unless a function makes the machines, of
    which it is known already: if no body can rest, that is left out.
    """
    rests = False
    if blocks.paired and job.machine is not None:
        lanes = {name: jnp.asarray(x) for name, x in blocks.axes.items() if name[:6] != START}
        machine = job.machine
        for name, x in lanes.items():
            machine = with_leaf(machine, name, x)
        check_again(machine)  # all lanes at a time
    for values in _corners(blocks):
        lane = {name: jnp.asarray(x) for name, x in zip(blocks.axes, values, strict=True)}
        machine, start = job.lane(lane)
        check_again(machine)
        rests = rests or machine.may_rest()
        for name in job.derivatives:
            _check_name(machine, start, name, "derivatives")
        job.method.check(machine)
        start = machine.adopt(start)
        check_reals("start", start)
        check_period(machine, start)
        refuse_arrays("start", "scan", start)
    return job if job.build is not None else dataclasses.replace(job, rests=rests)
