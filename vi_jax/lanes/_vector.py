"""A jaxpr of one lane's scalars and small arrays as vector code for a group of lanes."""

from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from ._array_rules import PLACED, STRUCTURAL, chosen
from ._arrays import (
    MOST_IN_REGISTERS,
    Array,
    Formula,
    Registers,
    held,
    joined,
    over,
    room,
    settled,
    store_at,
    table,
    uniform,
)
from ._control import CONTROL
from ._derived import DERIVED, derived
from ._operations import ELEMENTWISE, SAME, kind_of
from ._program import called, inner
from ._text import Text, Value


class Unsupported(Exception):
    """A program that has no vector form; the argument says what stopped it."""


def check(jaxpr: Jaxpr) -> None:
    """**Raises:** `Unsupported` naming the first primitive, or type, that has no vector form;
    `TypeError` for a function that has no forward derivative."""
    needed = _needed_equations(jaxpr)
    for var in (*jaxpr.invars, *jaxpr.constvars, *(v for e in needed for v in e.outvars)):
        dtype = getattr(var.aval, "dtype", None)
        try:
            kind_of(dtype)
        except (KeyError, TypeError):
            raise Unsupported(f"a value of type {dtype}") from None
    for eqn in needed:
        for body in _bodies(eqn):
            check(body)
        if eqn.primitive.name == "custom_lin":
            raise TypeError(
                "Derivatives of lanes are carried along with them, and a function with a "
                "`jax.custom_vjp` has none that can be: define it by `jax.custom_jvp`."
            )
        if not (_bodies(eqn) or _has_rule(eqn.primitive.name)):
            raise Unsupported(f"the primitive `{eqn.primitive.name}`")


def _has_rule(name: str) -> bool:
    return any(name in rules for rules in (ELEMENTWISE, STRUCTURAL, PLACED, DERIVED))


def _bodies(eqn: Any) -> list[Jaxpr]:
    """The jaxprs that are written where an equation calls, chooses or repeats them."""
    name, params = eqn.primitive.name, eqn.params
    if (body := called(eqn)) is not None:
        return [inner(body)]
    if name == "cond":
        return [inner(branch) for branch in params["branches"]]
    if name == "while":
        return [inner(params["cond_jaxpr"]), inner(params["body_jaxpr"])]
    if name == "scan":
        return [inner(params["jaxpr"])]
    return [inner(params["jaxprs"].solve)] if name == "custom_linear_solve" else []


def constants(t: Text, array: object) -> Array:
    """A known array, the same in every lane."""
    array = np.asarray(array)
    kind = kind_of(array.dtype)
    if array.size > MOST_IN_REGISTERS:
        return table(t, array, kind)
    return Registers.of(array.shape, kind, lambda i: t.constant(array[i], kind))


def write(t: Text, closed: ClosedJaxpr | Jaxpr, args: list[Any], mask: Value) -> list[Any]:
    """Append the operations of a jaxpr to a text, as LLVM code for one group of lanes.

    **Arguments:** the text; the jaxpr; its arguments, as `Array`s of their shapes; which lanes
    need the results: what none of them needs may be skipped, and the others get any numbers.

    **Returns:** its results, likewise.
    """
    jaxpr, env = inner(closed), {}
    needed = _needed_equations(jaxpr)
    uses, last = _uses(jaxpr, needed)

    def read(atom: object) -> Array:
        if isinstance(atom, Literal):
            aval: Any = atom.aval
            return constants(t, np.asarray(atom.val, aval.dtype))
        return env[atom]

    def put(variables: list[Any], values: list[Any]) -> None:
        for var, value in zip(variables, values, strict=True):
            # What is asked for more than once is computed once.
            env[var] = settled(t, value) if uses.get(var, 0) > 1 else value

    put(jaxpr.constvars, [constants(t, x) for x in getattr(closed, "consts", ())])
    put(jaxpr.invars, args)
    for number, eqn in enumerate(needed):
        put(eqn.outvars, _write_equation(t, eqn, [read(a) for a in eqn.invars], mask))
        for var in last.get(number, ()):  # so that its memory serves again
            env.pop(var, None)
    return [read(a) for a in jaxpr.outvars]


def _uses(jaxpr: Jaxpr, needed: list[Any]) -> tuple[dict[Any, int], dict[int, list[Any]]]:
    """How often each variable is asked for; which ones are not asked for after an equation."""
    uses, at_last = {}, {}
    for number, atoms in enumerate([*(eqn.invars for eqn in needed), jaxpr.outvars]):
        for atom in atoms:
            if not isinstance(atom, Literal):
                uses[atom] = uses.get(atom, 0) + 1
                at_last[atom] = number
    last: dict[int, list[Any]] = {}
    for var, number in at_last.items():
        last.setdefault(number, []).append(var)
    return uses, last


def _needed_equations(jaxpr: Jaxpr) -> list[Any]:
    wanted = {a for a in jaxpr.outvars if not isinstance(a, Literal)}
    kept = []
    for eqn in reversed(jaxpr.eqns):
        if any(v in wanted for v in eqn.outvars):
            kept.append(eqn)
            wanted.update(a for a in eqn.invars if not isinstance(a, Literal))
    return kept[::-1]


def _write_equation(t: Text, eqn: Any, args: list[Any], mask: Value) -> list[Any]:
    name, params = eqn.primitive.name, eqn.params
    if (body := called(eqn)) is not None:
        return write(t, body, args, mask)
    if name in CONTROL:
        return CONTROL[name](write, t, params, [settled(t, x) for x in args], mask)
    if name == "custom_linear_solve":
        before, _, solve, _ = np.cumsum([0, *params["const_lengths"]])[1:]
        given = int(before + params["const_lengths"].vecmat), int(solve)
        consts, right = args[slice(*given)], args[sum(params["const_lengths"]) :]
        return write(t, params["jaxprs"].solve, [*consts, *right], mask)
    avals = [v.aval for v in eqn.outvars]
    if name in DERIVED:
        return write(t, derived(name, [a.aval for a in eqn.invars], params), args, mask)
    if name in ELEMENTWISE:
        dtypes = [a.aval.dtype for a in eqn.invars]
        return _elementwise(t, name, params, dtypes, args, avals)
    if name in PLACED:
        dtypes = [a.aval.dtype for a in eqn.invars]
        out = PLACED[name](t, params, avals, dtypes, *args)
    else:
        out = STRUCTURAL[name](t, params, avals, *args)
    return [held(t, x) for x in (out if eqn.primitive.multiple_results else [out])]


def _elementwise(t: Text, name, params, dtypes, args, avals) -> list[Array]:
    """The results of a rule of `ELEMENTWISE`: number by number of arrays in registers. Of larger
    ones they are formulas; several results, which are computed together, are stored."""
    rule, shape = ELEMENTWISE[name], avals[0].shape
    if avals[0].size <= MOST_IN_REGISTERS and all(isinstance(x, Registers) for x in args):
        values = [x.values for x in args]
        if not any(x.shape for x in values):
            found = rule(t, params, dtypes, *(x[()] for x in values))
            return [Registers.one(x) for x in (found if len(avals) > 1 else (found,))]
        if any(x.shape != values[0].shape for x in values):
            values = np.broadcast_arrays(*values)
        kinds = [kind_of(a.dtype) for a in avals]
        outs = [np.empty(values[0].shape, object) for _ in avals]
        for i in np.ndindex(values[0].shape):
            found = rule(t, params, dtypes, *(x[i] for x in values))
            for out, value in zip(outs, found if len(avals) > 1 else (found,), strict=True):
                out[i] = value
        return [Registers(out, kind) for out, kind in zip(outs, kinds, strict=True)]
    if name in SAME:
        return args[:1]
    kinds = [kind_of(a.dtype) for a in avals]

    def numbers(index: tuple) -> Any:
        # JAX lets numbers, and axes of one number, stand for arrays.
        given = (
            x.at(t, [i if n != 1 else 0 for i, n in zip(index, x.shape, strict=False)])
            for x in args
        )
        found = rule(t, params, dtypes, *given)
        # Whether it is stored before it is used must not decide how it is rounded.
        return t.opaque(found) if len(avals) == 1 else found

    values = [_only_number(x) for x in args]
    if all(v is not None for v in values):
        found = rule(t, params, dtypes, *values)
        return [uniform(shape, v) for v in (found if len(avals) > 1 else (found,))]
    if name == "select_n" and len(args) == 3 and values[0] is not None:
        if values[0].kind == "i1" and args[1].shape == args[2].shape:
            found = chosen(t, values[0], args[2], args[1])
            if found is not None:
                return [found]
    if len(avals) == 1:
        cuts = joined(*(x.cuts for x in args if x.ndim))
        return [Formula(shape, kinds[0], numbers, cuts=cuts)]
    outs = [room(t, shape, kind) for kind in kinds]

    def put(index: tuple) -> None:
        for out, value in zip(outs, numbers(index), strict=True):
            store_at(t, out, index, value)

    over(t, shape, put, joined(*(x.cuts for x in args)))
    return list(outs)


def _only_number(x: Array) -> Value | None:
    if isinstance(x, Registers):
        return x.item() if x.size == 1 else None
    return x.value if isinstance(x, Formula) else None
