"""A jaxpr of one lane's scalars and small arrays as vector code for a group of lanes."""

from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from ._arrays import STRUCTURAL, Values, each
from ._operations import ELEMENTWISE, kind_of
from ._program import CALLS, inner
from ._text import Text, Value

# The most operations of a loop of known length, all turns together, that are written one after the
# other because it has rows; a sixteenth of that if it has none. A bound on the time of compilation.
_MOST_UNROLLED = 4096

# A branch of no more operations than this is computed whether any lane needs it or not.
_CHEAP = 4


class Unsupported(Exception):
    """A program that has no vector form; the argument says what stopped it."""


def check(jaxpr: Jaxpr) -> None:
    """**Raises:** `Unsupported` naming the first primitive, or type, that has no vector form."""
    needed = _needed(jaxpr)
    for var in (*jaxpr.invars, *jaxpr.constvars, *(v for e in needed for v in e.outvars)):
        dtype = getattr(var.aval, "dtype", None)
        try:
            kind_of(dtype)
        except (KeyError, TypeError):
            raise Unsupported(f"a value of type {dtype}") from None
    for eqn in needed:
        name = eqn.primitive.name
        if name in CALLS:
            check(inner(eqn.params[CALLS[name]]))
        elif name == "cond":
            for branch in eqn.params["branches"]:
                check(inner(branch))
        elif name == "while":
            check(inner(eqn.params["cond_jaxpr"]))
            check(inner(eqn.params["body_jaxpr"]))
        elif name == "scan":
            body = inner(eqn.params["jaxpr"])
            check(body)
            plain = _has_no_rows(eqn.params, len(eqn.invars), len(eqn.outvars))
            if not plain and _size(body) * eqn.params["length"] > _MOST_UNROLLED:
                raise Unsupported(f"the primitive `scan` of length {eqn.params['length']}")
        elif name not in ELEMENTWISE and name not in STRUCTURAL:
            raise Unsupported(f"the primitive `{name}`")


def _size(jaxpr: Jaxpr) -> int:
    """The number of operations, those of inner jaxprs once."""
    total = 0
    for eqn in jaxpr.eqns:
        held = [x for v in eqn.params.values() for x in (v if isinstance(v, tuple) else (v,))]
        held = [x for x in held if isinstance(x, Jaxpr | ClosedJaxpr)]
        total += 1 + sum(_size(inner(x)) for x in held)
    return total


def constants(t: Text, array: Any) -> Values:
    """A known array, the same in every lane, as `Value`s."""
    array = np.asarray(array)
    kind = kind_of(array.dtype)
    out = np.empty(array.shape, object)
    for i in np.ndindex(array.shape):
        out[i] = t.constant(array[i], kind)
    return out


def write(t: Text, closed: ClosedJaxpr | Jaxpr, args: list[Values], mask: Value) -> list[Values]:
    """Append the operations of a jaxpr to a text.

    **Arguments:** the text; the jaxpr; the values of its arguments, of their shapes; which lanes
    need the results: what none of them needs may be skipped, and the others get any numbers.

    **Returns:** the values of its results.
    """
    jaxpr, env = inner(closed), {}

    def read(atom: Any) -> Values:
        if isinstance(atom, Literal):
            aval: Any = atom.aval
            return constants(t, np.asarray(atom.val, aval.dtype))
        return env[atom]

    for var, const in zip(jaxpr.constvars, getattr(closed, "consts", ()), strict=True):
        env[var] = constants(t, const)
    env.update(zip(jaxpr.invars, args, strict=True))
    for eqn in _needed(jaxpr):
        outs = _equation(t, eqn, [read(a) for a in eqn.invars], mask)
        env.update(zip(eqn.outvars, outs, strict=True))
    return [read(a) for a in jaxpr.outvars]


def _needed(jaxpr: Jaxpr) -> list[Any]:
    """The equations that the results depend on, in their order."""
    wanted = {a for a in jaxpr.outvars if not isinstance(a, Literal)}
    kept = []
    for eqn in reversed(jaxpr.eqns):
        if any(v in wanted for v in eqn.outvars):
            kept.append(eqn)
            wanted.update(a for a in eqn.invars if not isinstance(a, Literal))
    return kept[::-1]


def _equation(t: Text, eqn: Any, args: list[Values], mask: Value) -> list[Values]:
    """The values of an equation's results, by the rule of its primitive."""
    name, params = eqn.primitive.name, eqn.params
    if name in ELEMENTWISE:
        dtypes = [a.aval.dtype for a in eqn.invars]
        return _elementwise(t, name, params, dtypes, args, len(eqn.outvars))
    if name in STRUCTURAL:
        out = STRUCTURAL[name](t, params, [v.aval for v in eqn.outvars], *args)
        return list(out) if eqn.primitive.multiple_results else [out]
    if name in CALLS:
        return write(t, params[CALLS[name]], args, mask)
    if name == "cond":
        return _cond(t, params["branches"], args[0].item(), args[1:], mask)
    if name == "while":
        return _while(t, params, args, mask)
    if name == "scan":
        return _scan(t, params, args, mask)
    raise Unsupported(f"the primitive `{name}`")


def _elementwise(t: Text, name, params, dtypes, args, results: int) -> list[Values]:
    """A rule of `ELEMENTWISE`, number by number."""
    args = np.broadcast_arrays(*args, subok=False)
    outs = [np.empty(args[0].shape, object) for _ in range(results)]
    for i in np.ndindex(args[0].shape):
        out = ELEMENTWISE[name](t, params, dtypes, *(a[i] for a in args))
        for array, value in zip(outs, out if results > 1 else (out,), strict=True):
            array[i] = value
    return outs


def _cond(t: Text, branches: tuple, which: Value, args: list[Values], mask: Value) -> list[Values]:
    """Each branch is skipped where no lane of the group takes it, but for a cheap one.

    **Arguments:** the text; the branches' jaxprs; which of them each lane takes; their arguments;
    which lanes need the results.
    """
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
    order = sorted(range(len(branches)), key=lambda i: _size(inner(branches[i])))
    result: list[Values] | None = None
    for i in order:
        if result is None and _size(inner(branches[i])) <= _CHEAP:
            result = write(t, branches[i], args, mask)
            continue
        result = _branch_if_any(t, branches[i], args, t.both(mask, taken[i]), result)
    assert result is not None
    return result


def _branch_if_any(t: Text, jaxpr, args, mask: Value, otherwise) -> list[Values]:
    """The results of a jaxpr in the lanes of `mask`, and `otherwise` (or anything, if that is
    `None`) in the others; skipped if `mask` has no lane."""
    inside, after = t.label(), t.label()
    before = t.block
    t.fork(t.any(mask), inside, after, rare=True)
    t.open(inside)
    found = write(t, jaxpr, args, mask)
    if otherwise is None:
        otherwise = [each(lambda a: t.zero(a.kind), x) for x in found]
        laid = found
    else:
        laid = [
            each(lambda a, b: t.select(mask, a, b), x, y)
            for x, y in zip(found, otherwise, strict=True)
        ]
    end = t.block
    t.line(f"br label %{after}")
    t.close()
    t.follow(after)
    return [
        each(lambda a, b: a if a == b else t.phi(a.kind, (a.text, end), (b.text, before)), x, y)
        for x, y in zip(laid, otherwise, strict=True)
    ]


def _while(t: Text, params: dict, args: list[Values], mask: Value) -> list[Values]:
    """Until no lane of `mask` goes on; a lane that has ended keeps its carry."""
    n, m = params["cond_nconsts"], params["body_nconsts"]
    cond_args, body_args, first = args[:n], args[n : n + m], args[n + m :]
    head, inside, after = t.label(), t.label(), t.label()
    before = t.block
    t.line(f"br label %{head}")
    t.open(head)
    place = len(t.lines)
    carry = [each(lambda a: Value(t.fresh(), a.kind), x) for x in first]
    live = Value(t.fresh(), "i1")
    asked = write(t, params["cond_jaxpr"], [*cond_args, *carry], live)[0].item()
    going = t.both(live, asked)
    t.fork(t.any(going), inside, after)
    t.open(inside)
    new = write(t, params["body_jaxpr"], [*body_args, *carry], going)
    new = [each(lambda a, b: t.select(going, a, b), x, y) for x, y in zip(new, carry, strict=True)]
    end = t.block
    t.line(f"br label %{head}")
    t.close()
    t.close()
    begun, back = ([*_flat(first), mask], before), ([*_flat(new), going], end)
    t.join([*_flat(carry), live], begun, back, at=place)
    t.follow(after)
    return carry


def _flat(arrays: list[Values]) -> list[Value]:
    return [value for x in arrays for value in x.ravel()]


def _has_no_rows(params: dict, inputs: int, outputs: int) -> bool:
    """Whether a loop of known length has a carry only: no rows, neither given nor made.

    **Arguments:** the parameters of `scan`; the numbers of its arguments and results.
    """
    carried = params["num_carry"]
    return params["length"] > 0 and inputs == params["num_consts"] + carried == outputs + (
        inputs - carried
    )


def _counted_loop(t: Text, params: dict, args: list[Values], mask: Value) -> list[Values]:
    """A loop of known length without rows, as a loop with a scalar counter."""
    n = params["num_consts"]
    fixed, first = args[:n], args[n:]
    inside, after = t.label(), t.label()
    before = t.block
    t.line(f"br label %{inside}")
    t.open(inside)
    place = len(t.lines)
    carry = [each(lambda a: Value(t.fresh(), a.kind), x) for x in first]
    count, following = t.fresh(), t.fresh()
    new = write(t, params["jaxpr"], [*fixed, *carry], mask)
    end = t.block
    t.line(f"{following} = add i64 {count}, 1")
    more = t.raw(f"icmp slt i64 {following}, {params['length']}")
    t.join(_flat(carry), (_flat(first), before), (_flat(new), end), at=place)
    t.lines.insert(place, f"  {count} = phi i64 [ 0, %{before} ], [ {following}, %{end} ]")
    t.fork(more, inside, after)
    t.close()
    t.follow(after)
    return new


def _scan(t: Text, params: dict, args: list[Values], mask: Value) -> list[Values]:
    """A loop of known length: its turns one after the other, unless it is long and has no rows."""
    body = inner(params["jaxpr"])
    big = _size(body) * params["length"] > _MOST_UNROLLED // 16
    if big and _has_no_rows(params, len(args), len(body.outvars)):
        return _counted_loop(t, params, args, mask)
    n, m, length = params["num_consts"], params["num_carry"], params["length"]
    fixed, carry, rows = args[:n], args[n : n + m], args[n + m :]
    order = range(length)[::-1] if params["reverse"] else range(length)
    kept: dict[int, list[Values]] = {}
    for i in order:
        row = [x[i] for x in map(_rowwise, rows)]
        out = write(t, params["jaxpr"], [*fixed, *carry, *row], mask)
        carry, kept[i] = out[:m], out[m:]
    columns = [np.stack([kept[i][j] for i in range(length)]) for j in range(len(body.outvars) - m)]
    return [*carry, *columns]


def _rowwise(x: Values) -> list[Values]:
    return [np.asarray(x[i], object).reshape(x.shape[1:]) for i in range(x.shape[0])]
