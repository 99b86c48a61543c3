"""The program that carries a lane and its forward derivative along together."""

import functools
from itertools import pairwise
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from ._program import LaneProgram, Spread, spread
from ._quotient import with_quotients


@functools.lru_cache(maxsize=64)
def forward(program: LaneProgram, moving: tuple[bool, ...]) -> tuple[LaneProgram, tuple[bool, ...]]:
    """The program of value and derivative, and which results and parts of the rows have one.

    **Arguments:** the program; which inputs have a derivative. Theirs follow the inputs, those of
    the results follow the results, those of a row follow the row. What cannot depend on a moving
    input is not differentiated.
    """
    n = len(program.carry_avals)
    there = spread(program, moving, smooth=True)
    both, rows = (*moving, *there.carry), there.rows
    wanted, groups = (*there.carry, False, False, *rows), (n, 2, len(rows))
    slopes = program.slopes or (False,) * len(moving)
    derived = LaneProgram(
        begin=_derived(program.begin, moving, wanted, groups),
        step=_derived(program.step, both, wanted, groups, len(moving)),
        end=_derived(program.end, both, there.outs, (len(there.outs),), len(moving)),
        rows=program.rows,
        block=program.block,
        slopes=(*slopes, *(True for m in moving if m)),
        base=program,
    )
    return derived, (*there.outs, *rows)


def _derived(
    closed: ClosedJaxpr,
    moving: tuple[bool, ...],
    wanted: tuple[bool, ...],
    groups: tuple[int, ...],
    split: int | None = None,
) -> ClosedJaxpr:
    """A jaxpr with derivatives: after each group of results (inputs: before and from `split` on)
    come those that are wanted (that move)."""
    function = jaxpr_as_fun(with_quotients(closed))
    ends = [0, len(moving) if split is None else split, len(moving)]

    def both(*args):
        given = iter(args)
        primals: list[Any] = []
        tangents: list[Any] = []
        for begin, end in pairwise(ends):
            primals += [next(given) for _ in moving[begin:end]]
            tangents += [next(given) for there in moving[begin:end] if there]

        def of_moving(*changing):
            given = iter(changing)
            return function(
                *(next(given) if m else p for m, p in zip(moving, primals, strict=True))
            )

        changing = [p for m, p in zip(moving, primals, strict=True) if m]
        values, slopes = jax.jvp(of_moving, changing, tangents)
        out, at = [], 0
        for size in groups:
            here = slice(at, at + size)
            out += values[here]
            out += [s for s, want in zip(slopes[here], wanted[here], strict=True) if want]
            at += size
        return out

    shapes: list[Any] = []
    for begin, end in pairwise(ends):
        part = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in closed.in_avals[begin:end]]
        shapes += part + [s for s, m in zip(part, moving[begin:end], strict=True) if m]
    return jax.make_jaxpr(both)(*shapes)


@functools.lru_cache(maxsize=64)
def widened(
    program: LaneProgram, many: tuple[bool, ...], number: int
) -> tuple[LaneProgram, Spread]:
    """The program with `number` of some of its inputs in one lane, and what there are so many of.

    All that does not depend on them is computed once, so that several directions of a derivative
    share one motion.
    """
    there = spread(program, many, smooth=False)

    def over(closed: ClosedJaxpr, axes: tuple[bool, ...], wide: tuple[bool, ...]) -> ClosedJaxpr:
        def function(*args):
            places = [0 if a else None for a in axes]
            out = jax.vmap(jaxpr_as_fun(closed), places, axis_size=number)(*args)
            return [x if w else x[0] for x, w in zip(out, wide, strict=True)]

        shapes = [
            jax.ShapeDtypeStruct((number, *v.shape) if a else v.shape, v.dtype)
            for v, a in zip(closed.in_avals, axes, strict=True)
        ]
        return jax.make_jaxpr(function)(*shapes)

    flags = (*there.carry, False, False, *there.rows)
    base = program.base
    if base is not None and any(many[: len(base.in_avals)]):
        base = None
    wide = LaneProgram(
        begin=over(program.begin, many, flags),
        step=over(program.step, (*many, *there.carry), flags),
        end=over(program.end, (*many, *there.carry), there.outs),
        rows=program.rows,
        block=program.block,
        slopes=program.slopes,
        base=base,
    )
    return wide, there
