"""Loops whose number of turns varies, backward.

JAX has no transpose of a `while`, whose turns it would have to keep. Here its beginning is kept,
and before each turn that is taken back, those before it are taken again: n turns cost n²/2 more.
The loops of a step (blows of one instant, terms of a series) take a few.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Primitive
from jax.interpreters import ad

from ._program import dependent_results, evaluated, fixed_point, rewritten

loop_p = Primitive("loop")
loop_p.multiple_results = True
slopes_p = Primitive("loop_slopes")
slopes_p.multiple_results = True


def with_loops(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The same jaxpr, its loops with a derivative that has a transpose."""
    return _exchanged(closed, jax.lax.while_p, loop_p)


def without_loops(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The same jaxpr, those loops that are not differentiated as they were."""
    return _exchanged(closed, loop_p, jax.lax.while_p)


def _exchanged(closed: ClosedJaxpr, old: Primitive, new: Primitive) -> ClosedJaxpr:
    return rewritten(closed, lambda e: e.replace(primitive=new) if e.primitive is old else e)


@loop_p.def_abstract_eval
def _(*args, cond_nconsts, body_nconsts, **_):
    return list(args[cond_nconsts + body_nconsts :])


@slopes_p.def_abstract_eval
def _(*args, varied, body_jaxpr, body_nconsts, **_):
    moved = varied[body_nconsts:]
    avals = zip(body_jaxpr.out_avals, moved, strict=True)
    return [ShapedArray(a.shape, a.dtype) for a, here in avals if here]


def _jvp(primals, tangents, **params):
    """The carry after the last turn, and the tangents of what of it varies."""
    first, fixed = params["cond_nconsts"], params["body_nconsts"]
    body = params["body_jaxpr"].jaxpr
    has = [type(x) is not ad.Zero for x in tangents[first:]]
    moved = fixed_point(
        lambda carry: dependent_results(body, [*has[:fixed], *carry], smooth=True), has[fixed:]
    )
    varied = (*has[:fixed], *moved)
    values = loop_p.bind(*primals, **params)
    given = zip(tangents[first:], varied, strict=True)
    along = [ad.instantiate_zeros(x) for x, here in given if here]
    slopes = iter(slopes_p.bind(*primals, *along, varied=varied, **params) if along else ())
    return values, [
        next(slopes) if here else ad.Zero(jax.typeof(x).to_tangent_aval())
        for x, here in zip(values, moved, strict=True)
    ]


def _transposed(cotangents, *args, varied, cond_nconsts, cond_jaxpr, body_nconsts, body_jaxpr):
    """The cotangents of what varies, turn by turn from the last to the first."""
    number = cond_nconsts + len(varied)
    asked, fixed = args[:cond_nconsts], args[cond_nconsts : cond_nconsts + body_nconsts]
    begin = (jnp.zeros((), jnp.int32), tuple(args[cond_nconsts + body_nconsts : number]))
    moved = varied[body_nconsts:]

    def taken(x: tuple) -> tuple:
        return x[0] + 1, tuple(evaluated(body_jaxpr, *fixed, *x[1]))

    def before(x: tuple) -> tuple:
        turn, shares, weights = x
        _, carry = jax.lax.while_loop(lambda y: y[0] < turn - 1, taken, begin)
        new = _one_back(body_jaxpr, (*fixed, *carry), varied, moved, weights)
        count = len(shares)
        return turn - 1, tuple(map(jnp.add, shares, new[:count])), tuple(new[count:])

    turns, _ = jax.lax.while_loop(lambda x: evaluated(cond_jaxpr, *asked, *x[1])[0], taken, begin)
    shares = tuple(jnp.zeros_like(x) for x, here in zip(fixed, varied, strict=False) if here)
    weights = tuple(map(ad.instantiate_zeros, cotangents))
    _, shares, weights = jax.lax.while_loop(lambda x: x[0] > 0, before, (turns, shares, weights))
    found = zip((*shares, *weights), args[number:], strict=True)
    return [None] * number + [x if ad.is_undefined_primal(a) else None for x, a in found]


def _one_back(
    body: ClosedJaxpr, at: Sequence[Any], varied: Sequence[bool], moved: Sequence[bool],
    weights: Sequence[Any],
) -> list[Any]:  # fmt: skip
    """The cotangents of what varies of a turn's arguments, from those of its results."""

    def along(*changing: Any) -> list[Any]:
        some = iter(changing)
        out = evaluated(body, *(next(some) if v else x for x, v in zip(at, varied, strict=True)))
        return [x for x, here in zip(out, moved, strict=True) if here]

    changing = [x for x, here in zip(at, varied, strict=True) if here]
    tangents: Callable[..., list[Any]] = lambda *t: jax.jvp(along, changing, list(t))[1]
    return list(jax.linear_transpose(tangents, *changing)(list(weights)))


ad.primitive_jvps[loop_p] = _jvp
ad.primitive_transposes[slopes_p] = _transposed
