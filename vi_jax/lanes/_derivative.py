"""The program of a lane and its forward derivative."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from itertools import compress, islice, pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.interpreters import ad

from ._program import DependentParts, LaneProgram, Part, Widening, dependent_parts, rewritten
from .elementary import elementwise_primitive

# Division with a derivative that divides once for all directions.
#
# JAX divides each tangent of the dividend by the divisor, and each tangent of the divisor by its
# square. Here each is multiplied by one reciprocal. Otherwise divisions would take most of the time
# in derivatives of a machine's motion.


def as_quotient(eqn: Any) -> Any:
    """Return an equation, with this derivative if it divides floating-point numbers."""
    if eqn.primitive.name == "div" and jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.floating):
        return eqn.replace(primitive=quotient_p, params={})
    return eqn


def with_quotients(closed: ClosedJaxpr) -> ClosedJaxpr:
    """Return the jaxpr with this derivative for its divisions of floating-point numbers."""
    return rewritten(closed, as_quotient)


def _jvp(primals, tangents):
    (x, y), (dx, dy) = primals, tangents
    ratio = quotient_p.bind(x, y)
    reciprocal = quotient_p.bind(jnp.ones_like(y), y)
    parts = []
    if type(dx) is not ad.Zero:
        parts.append(dx * reciprocal)
    if type(dy) is not ad.Zero:
        parts.append(dy * -(ratio * reciprocal))
    return ratio, sum(parts[1:], parts[0])


quotient_p = elementwise_primitive("quotient", lambda x, y: x / y, _jvp)


class Derived(NamedTuple):
    """A program of values and derivatives. Its tangents follow the inputs. The derivatives of
    results follow the results, those of a row follow the row."""

    program: LaneProgram
    has: tuple[bool, ...]
    """Flags of the values' results, then of the parts of a row, that have a derivative."""
    values: tuple[int, ...]
    """The places of the values' results and parts of a row."""
    slopes: dict[int, int]
    """The places of their derivatives, by the number of the result or part."""

    @classmethod
    def of(cls, program: LaneProgram, has: tuple[bool, ...], results: int) -> "Derived":
        """Return the places for `results` results, followed by the parts of a row."""
        values, slopes, place = [], {}, 0
        for part in (range(results), range(results, len(has))):
            values += range(place, place + len(part))
            place += len(part)
            for number in part:
                if has[number]:
                    slopes[number], place = place, place + 1
        return cls(program, has, tuple(values), slopes)


@functools.lru_cache(maxsize=64)
def forward(program: LaneProgram, varied: tuple[bool, ...]) -> Derived:
    """Return the program of values and forward derivatives. Parts that cannot depend on a varied
    input are not differentiated."""
    if program.widening is not None:
        return _widened_forward(program, program.widening, varied)
    n = len(program.carry_avals)
    depend = dependent_parts(program, varied, smooth=True)
    both, rows = (*varied, *depend.carry), depend.rows
    wanted, groups = (*depend.carry, False, False, *rows), (n, 2, len(rows))
    before = program.tangents or (False,) * len(varied)
    parts = (
        _with_derivatives(program.begin, varied, wanted, groups),
        _with_derivatives(program.step, both, wanted, groups, len(varied)),
        _with_derivatives(program.end, both, depend.outs, (len(depend.outs),), len(varied)),
    )
    derived = LaneProgram(
        parts=parts,
        tangents=(*before, *(True for m in varied if m)),
        varied=varied,
        base=program,
    )
    return Derived.of(derived, (*depend.outs, *rows), len(depend.outs))


def _widened_forward(program: LaneProgram, widening: Widening, varied: tuple[bool, ...]) -> Derived:
    """Return the same for a widened program, by differentiating its source and widening the result.
    JAX cannot do this in the other order: under `jax.vmap` within a branch, a result with its own
    derivative rule gets an axis if its value has one, even if its derivative has one too."""
    source, batched, number, wide = widening
    derived, has, *_ = forward(source, varied)
    batched_inputs = (*batched, *(b for b, flag in zip(batched, varied, strict=True) if flag))
    outs = len(wide.outs)
    depend = dependent_parts(derived, batched_inputs, smooth=False)._replace(
        outs=_with_its_derivatives(wide.outs, has[:outs]),
        rows=_with_its_derivatives(wide.rows, has[outs:]),
    )
    widened_program = _widened(Widening(derived, batched_inputs, number, depend))
    widened_program = dataclasses.replace(widened_program, varied=varied, base=program)
    return Derived.of(widened_program, has, outs)


def _with_its_derivatives(wide: tuple[bool, ...], has: tuple[bool, ...]) -> tuple[bool, ...]:
    """Return flags of results and derivatives. A derivative has the axis if its value has it."""
    return (*wide, *(w for w, flag in zip(wide, has, strict=True) if flag))


def _with_derivatives(
    closed: ClosedJaxpr,
    varied: tuple[bool, ...],
    wanted: tuple[bool, ...],
    groups: tuple[int, ...],
    split: int | None = None,
) -> Part:
    """Return a function of values and derivatives. Flags mark the arguments with a tangent and the
    results whose derivatives are `wanted`. Each of the `groups` of results is followed by its
    derivatives. The tangents of the first `split` arguments precede the other arguments (`None`:
    all)."""
    ends = [0, len(varied) if split is None else split, len(varied)]

    def both(*args):
        remaining = iter(args)
        primals: list[Any] = []
        tangents: list[Any] = []
        for begin, end in pairwise(ends):
            primals += [next(remaining) for _ in varied[begin:end]]
            tangents += [next(remaining) for flag in varied[begin:end] if flag]

        function = jaxpr_as_fun(with_quotients(closed))
        values, slopes = values_and_slopes(function, varied, wanted, primals, tangents)
        return grouped(values, slopes)

    def grouped(values: Sequence[Any], slopes: Sequence[Any]) -> list[Any]:
        remaining, changes, flags, out = iter(values), iter(slopes), iter(wanted), []
        for size in groups:
            out += islice(remaining, size)
            out += islice(changes, sum(islice(flags, size)))
        return out

    shapes: list[Any] = []
    for begin, end in pairwise(ends):
        part = closed.in_avals[begin:end]
        shapes += part + [s for s, m in zip(part, varied[begin:end], strict=True) if m]
    results = closed.out_avals
    return Part(both, shapes, grouped(results, list(compress(results, wanted))))


def values_and_slopes(
    function: Callable[..., Sequence[Any]],
    varied: Sequence[bool],
    wanted: Sequence[bool],
    primals: Sequence[Any],
    tangents: Sequence[Any],
) -> tuple[Sequence[Any], Sequence[Any]]:
    """Return the results of a function, and the derivatives of the `wanted` ones."""

    def of_varied(*changing):
        inputs = iter(changing)
        out = function(*(next(inputs) if v else x for x, v in zip(primals, varied, strict=True)))
        return [x for x, w in zip(out, wanted, strict=True) if w], out

    changing = [x for x, v in zip(primals, varied, strict=True) if v]
    _, slopes, out = jax.jvp(of_varied, changing, [*tangents], has_aux=True)
    return out, slopes


@functools.lru_cache(maxsize=64)
def widened(
    program: LaneProgram, batched: tuple[bool, ...], number: int
) -> tuple[LaneProgram, DependentParts]:
    """Return the program with `number` values of its `batched` inputs in one lane, and flags of its
    parts with such a leading axis. Other parts are computed once, so that several directions of a
    derivative share one motion."""
    depend = _parts_that_tangents_widen(program, batched)
    depend = depend or dependent_parts(program, batched, smooth=False)
    return _widened(Widening(program, batched, number, depend)), depend


def _parts_that_tangents_widen(
    program: LaneProgram, batched: tuple[bool, ...]
) -> DependentParts | None:
    """Return flags of the derivatives in the parts of a program, if exactly the tangents of all its
    varied inputs are batched; else `None`. No trace of the program is needed."""
    base, varied = program.base, program.varied
    if (
        base is None
        or not varied
        or batched != (*(False for _ in base.in_avals), *filter(None, varied))
    ):
        return None
    depend = dependent_parts(base, varied, smooth=True)
    of = lambda flags: (*(False for _ in flags), *(True for flag in flags if flag))
    return DependentParts(of(depend.carry), False, of(depend.rows), of(depend.outs))


def _widened(widening: Widening) -> LaneProgram:
    program, batched, number, _ = widening

    def over(name: str, part: Part) -> Part:
        axes = inputs, results = widening.axes(name)
        shapes = [
            [
                jax.ShapeDtypeStruct((number, *v.shape) if wide else v.shape, v.dtype)
                for v, wide in zip(avals, flags, strict=True)
            ]
            for avals, flags in zip((part.in_avals, part.out_avals), axes, strict=True)
        ]
        return Part(lambda *args: widening.over(part.function, args, inputs, results), *shapes)

    base = program.base
    if base is not None and any(batched[: len(base.in_avals)]):
        base = None
    parts = tuple(map(over, ("begin", "step", "end"), program.parts))
    return dataclasses.replace(program, parts=parts, varied=(), base=base, widening=widening)
