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
from ..scene import AbstractScene
from ..scene.numbers import check_again, check_name, leaf, leaf_names, with_leaf
from ._asked import measures_of
from .grid import Blocks
from .measures import AbstractMeasure, Numbers

START = "start."


class Job(eqx.Module):
    """What is computed of every lane of a scan."""

    scene: AbstractScene | None
    build: Callable[..., Any] | None = eqx.field(static=True)
    """Makes the scene of the axes' values, in place of `scene`."""
    start: Any
    """The first state, or `None` for the scene's own."""
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

    def lane(self, values: dict[str, Any], nudge: Any = None) -> tuple[AbstractScene, Any]:
        """Scene and start of the lane with these values on the axes."""
        of_scene = {name: x for name, x in values.items() if not name.startswith(START)}
        if self.build is not None:
            scene = self.build(**of_scene)
            if not isinstance(scene, AbstractScene):
                raise TypeError(
                    "Argument `scene` must be a function that returns a `Scene` or an "
                    f"`AbstractScene`, but it returned {scene!r}."
                )
        else:
            scene = self.scene
            for name, value in of_scene.items():
                scene = with_leaf(scene, name, value)
        assert scene is not None
        scene = self._nudged(scene, "", nudge)
        if self.clock is not None:
            scene = scene.in_clock(self.clock)
        start = self.start
        if start is None:
            start = scene.start()
        for name, value in values.items():
            if name.startswith(START):
                start = with_leaf(start, name.removeprefix(START), value)
        return scene, self._nudged(start, START, nudge)

    def first(self, blocks: Blocks) -> tuple[AbstractScene, Any]:
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
            if measure.looks == 1:
                out = self._again(measure, values, wanted, state, out)
                continue

            def look(number, out, measure=measure):
                return self._again(measure, values, wanted, state, out, number)

            out = jax.lax.fori_loop(0, measure.looks, look, out)
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
            scene, _ = lane_of(values)
            found = {}
            for measure in self.measures:
                new = measure(scene, run)
                _check_variables(measure, new, [*found, "result"])
                found |= new
            for name, x in found.items():
                if jnp.issubdtype(x.dtype, jnp.floating):  # fast minima lose NaN
                    # Added, not chosen: the derivative of a failed lane stays NaN as well.
                    found[name] = x + jnp.where(run.successful, 0.0, jnp.nan)
            return {**found, "result": number_of(run.result).astype(jnp.int8)}

        return jax.vmap(measured)(values, run), jax.vmap(lambda run: run.last)(run)

    def _again(
        self, measure: AbstractMeasure, values, wanted, state, out: Numbers, *look: Array
    ) -> Numbers:
        """`out` with what `measure` finds at another look, at the lanes that need it only."""
        unclear = jax.vmap(lambda found: measure.unclear(found, *look))(out)
        if unclear is None:
            return out

        def one(values, state, out, unclear):
            scene, _ = self.lane(values)
            # Another lane ends at once, its start being no number.
            state = jtu.tree_map(lambda x: jnp.where(unclear, x, jnp.nan), state)
            later = measure.later(scene, state, self.method, out, *look, rests=self.rests)
            new = {**out, **later}
            return jtu.tree_map(lambda a, b: jnp.where(unclear, a, b), new, out)

        return jax.vmap(one)(values, state, out, unclear & wanted & (out["result"] == 0))


def make_job(
    scene: Any,
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
) -> Job:
    """The work for each lane, its arguments checked as far as they can be without the axes."""
    measures = measures_of(measure, _averages_of(scene, names, start))
    needed = max(m.cycles for m in measures)
    cycles = max(32, needed) if cycles is None else count("cycles", cycles, least=1)
    if cycles < needed:
        who = next(type(m).__name__ for m in measures if m.cycles > cycles)
        raise ValueError(
            f"Argument `cycles` must be at least {needed} for the measure {who}, but got {cycles}."
        )
    settle = count("settle", settle)
    derivatives = (derivatives,) if isinstance(derivatives, str) else derivatives
    if isinstance(scene, AbstractScene):
        template, build, rests = machine_of(scene), None, True
        method = chosen(template, method)
    elif callable(scene):
        template, build = None, scene
        own = [name for name in names if not name.startswith(START)]
        _check_names_of(scene, own)
        method, rests = _suited(build, own, method)
    else:
        raise TypeError(
            "Argument `scene` must be a `Scene`, an `AbstractScene` or a function that makes one, "
            f"but got {scene!r}."
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
    return Job(
        scene=_as_arrays(template),
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


def _averages_of(scene: Any, axes: Iterable[str], start: Any) -> tuple[str, ...]:
    """The names of the averages of a machine, or of those that a function makes."""
    if isinstance(scene, AbstractScene):
        return _names_of(scene, start)
    found: list[tuple[str, ...]] = []

    def made(values):
        found.append(_names_of(scene(**values), start))

    # What cannot be made is told where the method is looked for.
    with contextlib.suppress(Exception):
        jax.eval_shape(made, {x: jnp.zeros(()) for x in axes if not x.startswith(START)})
    return found[0] if found else ()


def _names_of(scene: Any, start: Any) -> tuple[str, ...]:
    if not isinstance(scene, AbstractScene) or not has_averages(scene):
        return ()
    return average_names(scene, scene.start() if start is None else scene.adopt(start))


def _suited(
    build: Callable[..., Any], names: list[str], method: MethodLike
) -> tuple[AbstractMethod, bool]:
    """The method for the scenes that a function makes, and whether a body can come to rest in
    them, whatever its values."""
    found: list[tuple[AbstractMethod, bool]] = []

    def made(values):
        scene = build(**values)
        if isinstance(scene, AbstractScene):
            found.append((chosen(scene, method), scene.may_rest()))
        else:  # refused once there are lanes
            found.append((chosen(None, method), True))

    jax.eval_shape(made, {name: jnp.zeros(()) for name in names})
    return found[0]


def _check_names_of(build: Callable[..., Any], names: list[str]) -> None:
    """**Raises:** `ValueError` if the function that makes the scenes does not take these names."""
    try:
        inspect.signature(build).bind(**dict.fromkeys(names))
    except TypeError as error:
        raise ValueError(
            "Argument `axes` must give the function in argument `scene` what it takes, but: "
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


def _check_name(scene: AbstractScene, start: Any, name: str, argument: str) -> None:
    names = leaf_names(scene) + [START + n for n in leaf_names(start)]
    check_name(names, name, argument)


def _corners(blocks: Blocks) -> np.ndarray:
    """The lanes in which the axes have their least and greatest values, one in a row."""
    rows = list(blocks.axes.values())
    if blocks.paired:
        ends = {int(place) for x in rows for place in (x.argmin(), x.argmax())}
        return np.stack([x[sorted(ends)] for x in rows], axis=-1)
    corners: Any = [np.unique([x.min(), x.max()]) for x in rows]
    return np.stack(np.meshgrid(*corners, indexing="ij"), axis=-1).reshape(-1, len(rows))


def check_corners(job: Job, blocks: Blocks) -> Job:
    """The job, after the checks of scene, start and method on the corners of the grid.

    What the corners say about the gaps holds for the grid, unless a function makes the scenes, of
    which it is known already: if no body can rest, that is left out.
    """
    rests = False
    if blocks.paired and job.scene is not None:
        lanes = {name: jnp.asarray(x) for name, x in blocks.axes.items() if name[:6] != START}
        scene = job.scene
        for name, x in lanes.items():
            scene = with_leaf(scene, name, x)
        check_again(scene)  # all lanes at a time
    for values in _corners(blocks):
        lane = {name: jnp.asarray(x) for name, x in zip(blocks.axes, values, strict=True)}
        scene, start = job.lane(lane)
        check_again(scene)
        rests = rests or scene.may_rest()
        for name in job.derivatives:
            _check_name(scene, start, name, "derivatives")
        job.method.check(scene)
        start = scene.adopt(start)
        check_reals("start", start)
        check_period(scene, start)
        refuse_arrays("start", "scan", start)
    return job if job.build is not None else dataclasses.replace(job, rests=rests)
