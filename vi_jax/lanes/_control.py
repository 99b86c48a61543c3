"""Conditions and loops: jaxprs that are skipped or repeated."""

from collections.abc import Callable
from typing import Any

import jax
from jax.extend.core import Jaxpr, Literal

from ._array_rules import STRUCTURAL, any_in
from ._arrays import (
    MOST_IN_REGISTERS,
    Array,
    Formula,
    Index,
    Masked,
    Registers,
    Strided,
    addressable,
    counted,
    fill,
    held,
    in_one,
    joined,
    mapped,
    plus,
    replace,
    room,
    same,
    selected,
    settled,
    stored,
    times,
)
from ._operations import kind_of
from ._program import inner, scan_counts, size_of
from ._text import Text, Value

Write = Callable[..., list[Any]]

# The most operations of a loop of known length, all turns together, that are written one after the
# other. A bound on the time of compilation.
_MOST_UNROLLED = 256

# A branch of no more operations than this is computed whether any lane needs it or not.
_CHEAP = 4


def _cond(write: Write, t: Text, params: dict, args: list[Any], mask: Value) -> list[Any]:
    """Each branch is skipped where no lane of the group takes it, but for a cheap one.

    **Arguments:** as for `CONTROL`.
    """
    branches, which, args = params["branches"], args[0].item(), args[1:]
    last = len(branches) - 1
    taken = []
    for i in range(len(branches)):
        how = "sle" if i == 0 else "sge" if i == last else "eq"
        if which.kind == "i1":
            flag = which if i else t.inverse(which)
        else:
            flag = t.binary(f"icmp {how}", which, t.constant(i, which.kind), "i1")
        taken.append(flag)
    # The cheapest comes first: the results of the others replace its own in their lanes.
    order = sorted(range(len(branches)), key=lambda i: size_of(inner(branches[i])))
    result: list[Any] | None = None
    for i in order:
        if result is None and _is_cheap(inner(branches[i])):
            result = [settled(t, x) for x in write(t, branches[i], args, mask)]
            continue
        result = _branch_if_any(write, t, branches[i], args, t.both(mask, taken[i]), result)
    assert result is not None
    return [_opaque(t, x) for x in result]


def _is_cheap(jaxpr: Jaxpr) -> bool:
    """Whether a branch is not worth skipping: few operations, or constants however many, such as
    the zeros that are the cotangents of what a branch does not need."""
    constant = (
        eqn.primitive.name == "broadcast_in_dim" and isinstance(eqn.invars[0], Literal)
        for eqn in jaxpr.eqns
    )
    return size_of(jaxpr) <= _CHEAP or all(constant)


def _branch_if_any(write: Write, t: Text, jaxpr, args, mask: Value, otherwise) -> list[Any]:
    """The results of a jaxpr in the lanes of `mask`, and `otherwise` (or anything, if that is
    `None`) in the others; skipped if `mask` has no lane."""
    inside, skip, after = t.label(), t.label(), t.label()
    # What is large lies in the same memory whichever way was taken.
    rooms = [_room_for(t, v.aval) for v in inner(jaxpr).outvars]
    in_memory = any(r is not None for r in rooms)
    before = t.block
    t.fork(t.any(mask), inside, skip if in_memory else after, rare=True)
    t.open(inside)
    found = write(t, jaxpr, args, mask)
    laid: list[Any] = []
    others: list[Any] = [None] * len(found) if otherwise is None else otherwise
    for x, y, r in zip(found, others, rooms, strict=True):
        if r is not None:
            laid.append(_branch_result(t, x, y, r, args, mask))
        else:
            laid.append(x if y is None else selected(t, mask, x, y))
    end = t.block
    t.line(f"br label %{after}")
    t.close()
    if in_memory:
        t.open(skip)
        for x, y, r in zip(laid, others, rooms, strict=True):
            if r is not None and y is not None and x is r:
                fill(t, r, y)
        before = t.block
        t.line(f"br label %{after}")
        t.close()
    t.follow(after)
    if otherwise is None:
        others = [mapped(t, lambda a: t.zero(a.kind), x) for x in found]

    def either(a: Value, b: Value) -> Value:
        return a if a == b else t.phi(a.kind, (a.text, end), (b.text, before))

    return [
        mapped(t, either, x, y) if r is None else x
        for x, y, r in zip(laid, others, rooms, strict=True)
    ]


def _branch_result(
    t: Text, x: Array, y: Array | None, r: Strided, args: list[Any], mask: Value
) -> Array:
    """A branch's large result in the lanes of `mask`, and that of the others in theirs. Nothing is
    copied that need not be: a derivative's branches hand on whole matrices, or zeros in their
    place.

    **Arguments:** the text; the result `x`; the others', or `None` if it may be anything; memory
    for what has to be stored; the branch's arguments; its lanes.
    """
    mine, other = (a.value if isinstance(a, Formula) else None for a in (x, y))
    if mine is not None and mine.number is not None and (y is None or mine == other):
        return x
    if y is not None and same(x, y):
        return y
    if other == t.zero(r.kind):
        if not (isinstance(x, Strided) and any(same(x, a) for a in args)):
            fill(t, r, x)
            x = r
        return Masked(r.shape, r.kind, x, mask)
    fill(t, r, x if y is None else selected(t, mask, x, y))
    return r


def _opaque(t: Text, x: Array) -> Array:
    """What comes out of a condition or a turn of a loop (see `Text.opaque`)."""
    return mapped(t, t.opaque, x) if isinstance(x, Registers) else x


def _room_for(t: Text, aval: Any) -> Strided | None:
    """Memory for an array that is too large for registers."""
    return room(t, aval.shape, kind_of(aval.dtype)) if aval.size > MOST_IN_REGISTERS else None


def _while(write: Write, t: Text, params: dict, args: list[Any], mask: Value) -> list[Any]:
    """Until no lane of `mask` goes on; a lane that has ended keeps its carry."""
    n, m = params["cond_nconsts"], params["body_nconsts"]
    cond_args, body_args, first = args[:n], args[n : n + m], args[n + m :]
    first = [x if isinstance(x, Registers) else stored(t, x) for x in first]
    head, inside, after = t.label(), t.label(), t.label()
    before = t.block
    t.line(f"br label %{head}")
    t.open(head)
    place = len(t.lines)
    carry = [
        mapped(t, lambda a: Value(t.fresh(), a.kind), x) if isinstance(x, Registers) else x
        for x in first
    ]
    live = Value(t.fresh(), "i1")
    # Under `vmap` within a lane several loops are one, as long as any of them goes on.
    asked = settled(t, write(t, params["cond_jaxpr"], [*cond_args, *carry], live)[0])
    going = t.both(live, any_in(t, asked))
    t.fork(t.any(going), inside, after)
    t.open(inside)
    new = write(t, params["body_jaxpr"], [*body_args, *carry], going)
    if asked.ndim:
        new = [_chosen_by(t, asked, x, y) for x, y in zip(new, carry, strict=True)]
    replace(t, carry, new, going)
    new = [
        selected(t, going, x, y) if isinstance(x, Registers) else x
        for x, y in zip(new, carry, strict=True)
    ]
    end = t.block
    t.line(f"br label %{head}")
    t.close()
    t.close()
    begun, back = ([*_flat(first), mask], before), ([*_flat(new), going], end)
    t.join([*_flat(carry), live], begun, back, at=place)
    t.follow(after)
    return carry


def _chosen_by(t: Text, flags: Array, a: Array, b: Array) -> Array:
    """The first array where a flag of its leading axes holds, else the second."""
    number = lambda i: t.select(flags.at(t, i[: flags.ndim]), a.at(t, i), b.at(t, i))
    return held(t, Formula(a.shape, a.kind, number, cuts=joined(a.cuts, b.cuts)))


def _flat(arrays: list[Any]) -> list[Value]:
    """The numbers of those arrays that are in registers."""
    return [v for x in arrays if isinstance(x, Registers) for v in x.values.flat]


def _unflat(t: Text, arrays: list[Any], values: list[Value]) -> list[Any]:
    """Arrays like those given, with other numbers in registers."""
    left = iter(values)
    return [mapped(t, lambda _: next(left), x) if isinstance(x, Registers) else x for x in arrays]


def _scan(write: Write, t: Text, params: dict, args: list[Any], mask: Value) -> list[Any]:
    """A loop of known length: its turns one after the other, unless they are many."""
    body, length = inner(params["jaxpr"]), params["length"]
    n, m = scan_counts(params)
    if length and size_of(body) * length > _MOST_UNROLLED:
        return _counted_loop(write, t, params, args, mask)
    fixed, carry, rows = args[:n], args[n : n + m], args[n + m :]
    order = range(length)[::-1] if params["reverse"] else range(length)
    kept: dict[int, list[Any]] = {}
    for i in order:
        row = [_row_of(t, x, i) for x in rows]
        out = write(t, params["jaxpr"], [*fixed, *carry, *row], mask)
        carry, kept[i] = [_opaque(t, x) for x in out[:m]], [settled(t, x) for x in out[m:]]
    columns = []
    for j, var in enumerate(body.outvars[m:]):
        aval: Any = var.aval
        column = [kept[i][j] for i in range(length)]
        whole = jax.ShapeDtypeStruct((length, *aval.shape), aval.dtype)
        columns.append(held(t, STRUCTURAL["stack"](t, {"axis": 0}, [whole], *column)))
    return [*carry, *columns]


def _row_of(t: Text, x: Array, i: Index) -> Array:
    return held(t, Formula(x.shape[1:], x.kind, lambda j: x.at(t, (i, *j)), cheap=True))


def _counted_loop(write: Write, t: Text, params: dict, args: list[Any], mask: Value) -> list[Any]:
    """A loop of known length with a scalar counter; its rows lie in memory."""
    (n, m), length = scan_counts(params), params["length"]
    fixed, rows = args[:n], [addressable(t, in_one(t, x)) for x in args[n + m :]]
    first = [x if isinstance(x, Registers) else stored(t, x) for x in args[n : n + m]]
    made: list[Any] = [v.aval for v in inner(params["jaxpr"]).outvars[m:]]
    columns = [room(t, (length, *a.shape), kind_of(a.dtype)) for a in made]

    def turn(i: Index, values: list[Value]) -> list[Value]:
        carry = _unflat(t, first, values)
        place = plus(t, length - 1, times(t, i, -1)) if params["reverse"] else i
        row = [_row_of(t, x, place) for x in rows]
        out = write(t, params["jaxpr"], [*fixed, *carry, *row], mask)
        for column, x in zip(columns, out[m:], strict=True):
            steps = column.strides[1:]
            fill(t, column, x, offset=times(t, place, column.strides[0]), strides=steps)
        replace(t, carry, out[:m])
        return _flat(out[:m])

    carry = [_opaque(t, x) for x in _unflat(t, first, counted(t, length, turn, _flat(first)))]
    return [*carry, *(held(t, x) for x in columns)]


CONTROL: dict[str, Callable[..., list[Any]]] = {"cond": _cond, "while": _while, "scan": _scan}
"""By the primitive's name, functions of what writes a jaxpr (`_vector.write`); the text; the
equation's parameters; its arguments, none of them a formula that is dear; and which lanes need the
results. They return those."""
