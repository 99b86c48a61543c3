"""The program of a lane, traced once as a loop, and the dependence of its parts on its inputs."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import eval_jaxpr
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from .._loading import without_collection
from .elementary import horner


class Part:
    """One of a lane's functions as a jaxpr, traced when asked for. That of a derivative in one
    direction is not needed if several are carried along."""

    def __init__(self, function: Callable[..., Any], in_avals: Sequence, out_avals: Sequence):
        self.function, self.in_avals, self.out_avals = function, [*in_avals], [*out_avals]

    @classmethod
    def of(cls, closed: ClosedJaxpr) -> "Part":
        part = cls(jaxpr_as_fun(closed), closed.in_avals, closed.out_avals)
        part.closed = closed
        return part

    def __repr__(self) -> str:
        return str(self.closed)

    @functools.cached_property
    def closed(self) -> ClosedJaxpr:
        with without_collection():
            return jax.make_jaxpr(self.function)(*map(shape_of, self.in_avals))


class LaneProgram(eqx.Module):
    """The loop of a lane as jaxprs of flat arguments; hashable, as a primitive's parameter must be.

    `begin(inputs)` and `step(inputs, carry)` return the carry, whether the lane continues, whether
    a row is complete, and the row. `end(inputs, carry)` returns the results. Shapes are those of
    one lane, without batch axes. The greatest number of rows is an argument of each call.
    """

    parts: tuple[Part, Part, Part] = eqx.field(static=True)
    """The functions `begin`, `step` and `end`, each traced when its jaxpr is asked for."""
    tangents: tuple[bool, ...] = eqx.field(static=True, default=())
    """Flags of the inputs that are tangents. The number of iterations must not depend on them."""

    varied: tuple[bool, ...] = eqx.field(static=True, default=())
    """In a program of values and derivatives: flags of the inputs of `base` to which its last
    tangents belong. Empty if they are in several directions."""

    base: "LaneProgram | None" = eqx.field(static=True, default=None)
    """In a program of values and derivatives: the program of the values alone. Its inputs come
    first."""

    widening: "Widening | None" = eqx.field(static=True, default=None)
    """In a program that carries several values of some inputs: how it was made."""

    __hash__ = object.__hash__
    __eq__ = object.__eq__

    @property
    def begin(self) -> ClosedJaxpr:
        return self.parts[0].closed

    @property
    def step(self) -> ClosedJaxpr:
        return self.parts[1].closed

    @property
    def end(self) -> ClosedJaxpr:
        return self.parts[2].closed

    @property
    def jaxprs(self) -> tuple[ClosedJaxpr, ...]:
        return self.begin, self.step, self.end

    @property
    def in_avals(self) -> list[Any]:
        return self.parts[0].in_avals

    @property
    def carry_avals(self) -> list[Any]:
        return self.parts[1].in_avals[len(self.in_avals) :]

    @property
    def out_avals(self) -> list[Any]:
        return self.parts[2].out_avals

    @property
    def row_avals(self) -> list[Any]:
        return self.parts[0].out_avals[len(self.carry_avals) + 2 :]

    def results(self, rows: int) -> list[Any]:
        """Return shapes and types of one lane's results, then of its rows, stacked."""
        stacked = [jax.ShapeDtypeStruct((rows, *a.shape), a.dtype) for a in self.row_avals]
        return [*self.out_avals, *stacked]

    @property
    def result_count(self) -> int:
        """The number of arrays of results and rows."""
        return len(self.out_avals) + len(self.row_avals)

    def values_without(
        self, missing: Sequence[bool], shapes: Sequence[tuple[int, ...]]
    ) -> "tuple[LaneProgram, list[bool]] | None":
        """Return the program of the values that can be computed without the `missing` tangents, and
        flags of the results and rows that it returns; `None` if no such program exists. `shapes` of
        the inputs include batch axes."""
        found, base = [True] * self.result_count, self.base
        program, batch = self, batch_of(self, shapes)
        while base is not None and any(missing[: len(program.in_avals)]):
            outs, rows = len(base.out_avals), len(base.row_avals)
            skipped = len(program.out_avals) - outs, len(program.row_avals) - rows
            returned = [True] * outs + [False] * skipped[0] + [True] * rows + [False] * skipped[1]
            flags = iter(returned)
            found = [f and next(flags) for f in found]
            program, base = base, base.base
        number = len(program.in_avals)
        same_batch = batch_of(program, shapes[:number]) == batch
        return (program, found) if same_batch and not any(missing[:number]) else None


def shape_of(x: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype)


def batch_of(program: Any, shapes: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    for aval, shape in zip(program.in_avals, shapes, strict=True):
        if len(shape) > aval.ndim:
            return shape[: len(shape) - aval.ndim]
    return ()


class DependentParts(NamedTuple):
    """Flags of the parts of a program that depend on given inputs, one for each array."""

    carry: tuple[bool, ...]
    control: bool
    """True if the number of iterations of a lane, or the choice of its rows, depends on them."""
    rows: tuple[bool, ...]
    outs: tuple[bool, ...]


class Widening(NamedTuple):
    """The construction of a program that carries several values of some of its inputs."""

    program: LaneProgram
    batched: tuple[bool, ...]
    """Flags of the inputs with a leading axis."""
    number: int
    """The length of that axis."""
    wide: "DependentParts"
    """Flags of the other parts with that axis."""

    def axes(self, name: str) -> tuple[tuple[bool, ...], tuple[bool, ...]]:
        """Return flags of the arguments and of the results of `begin`, `step` or `end` with the
        axis."""
        emitted = (*self.wide.carry, False, False, *self.wide.rows)
        if name == "begin":
            return self.batched, emitted
        return (*self.batched, *self.wide.carry), self.wide.outs if name == "end" else emitted

    def over(
        self, function: Callable, args: Sequence, inputs: Sequence[bool], results: Sequence[bool]
    ) -> list[Any]:
        """Return the results of a function that has the axis in some arguments and results."""
        places = [0 if wide else None for wide in inputs]
        out = jax.vmap(function, places, axis_size=self.number)(*args)
        return [x if wide else x[0] for x, wide in zip(out, results, strict=True)]


def dependent_parts(
    program: LaneProgram, sources: tuple[bool, ...], *, smooth: bool
) -> DependentParts:
    """Return the parts of a program that depend on the inputs flagged in `sources`. If `smooth`,
    only dependence that can have a derivative counts."""
    n = len(program.carry_avals)
    depends = functools.partial(dependent_results, smooth=smooth)
    begun = depends(program.begin.jaxpr, sources)
    step = program.step.jaxpr
    stepped = fixed_point(lambda carry: depends(step, [*sources, *carry]), begun[:n])
    carry = stepped[:n]
    rest = [a or b for a, b in zip(begun[n:], stepped[n:], strict=True)]
    outs = depends(program.end.jaxpr, (*sources, *carry))
    return DependentParts(tuple(carry), any(rest[:2]), tuple(rest[2:]), tuple(outs))


# Primitives that call a jaxpr, and the parameter that holds it. JAX 0.9.1 to 0.12 use these names
# (`tests/lanes/test_jax.py` fails if they change).
CALLS = {
    "jit": "jaxpr", "closed_call": "call_jaxpr", "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr", "remat2": "jaxpr",
    "eval_jaxpr": "call_jaxpr",  # JAX 0.12's `closed_call`
}  # fmt: skip


# JAX 0.12 has operations such as `searchsorted` as objects that expand themselves.
_EXPANDED = "call_hi_primitive"


# Primitives new in JAX 0.12, in terms of older ones.
_BY_OLDER = {
    "polynomial": lambda x, *coefficients, **unroll: horner(coefficients, x),
    "one_minus_square": lambda x: (1 - x) * (1 + x),
    "log2": lambda x, accuracy=None: jnp.log(x) / math.log(2),
}

# Calls with a derivative rule; the derivative cannot be read from their bodies.
OWN_DERIVATIVE = ("custom_jvp_call", "custom_vjp_call", "custom_lin", _EXPANDED)


def called(eqn: Any) -> ClosedJaxpr | Jaxpr | None:
    """Return the jaxpr that an equation calls or expands to, or `None` if it does neither."""
    name, params = eqn.primitive.name, eqn.params
    if name in CALLS:
        return params[CALLS[name]]
    if name not in _BY_OLDER and name != _EXPANDED:
        return None
    shapes = tuple((x.aval.shape, x.aval.dtype) for x in eqn.invars)
    return _body(name, tuple(params.items()), shapes)


@functools.lru_cache(maxsize=256)
def _body(name: str, params: tuple, shapes: tuple[tuple[tuple[int, ...], Any], ...]) -> ClosedJaxpr:
    if name == _EXPANDED:
        operation = dict(params)["_prim"]

        def function(*args):
            return jax.tree.leaves(operation.expand(*jax.tree.unflatten(operation.in_tree, args)))
    else:
        function = functools.partial(_BY_OLDER[name], **dict(params))
    return jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(*x) for x in shapes))


def inner(jaxpr: ClosedJaxpr | Jaxpr) -> Jaxpr:
    """Return a jaxpr without the constants of a closed one."""
    return jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr


# Calls without a derivative rule and without a policy on which values to keep for derivatives.
_INLINED = ("jit", "closed_call")


def evaluate_inlined(closed: ClosedJaxpr | Jaxpr, *args: Any) -> list[Any]:
    """Return the results of a jaxpr, with its calls inlined. JAX would differentiate and transpose
    each call separately, which takes several times as long."""
    jaxpr, known = inner(closed), {}

    def read(atom: object) -> Any:
        return atom.val if isinstance(atom, Literal) else known[atom]

    known.update(zip(jaxpr.constvars, getattr(closed, "consts", ()), strict=True))
    known.update(zip(jaxpr.invars, args, strict=True))
    for eqn in jaxpr.eqns:
        given, name = [read(a) for a in eqn.invars], eqn.primitive.name
        if name in _INLINED:
            out = evaluate_inlined(eqn.params[CALLS[name]], *given)
        elif name in OWN_DERIVATIVE:
            names = list(dict.fromkeys(a for a in eqn.invars if not isinstance(a, Literal)))
            single = jaxpr.replace(constvars=[], invars=names, outvars=eqn.outvars, eqns=[eqn])
            out = eval_jaxpr(single, (), *map(read, names))
        else:
            out = eqn.primitive.bind(*given, **eqn.params)
            out = out if eqn.primitive.multiple_results else [out]
        known.update(zip(eqn.outvars, out, strict=True))
    return [read(a) for a in jaxpr.outvars]


@functools.lru_cache(maxsize=256)
def rewritten(closed: ClosedJaxpr, rule: Callable[[Any], Any]) -> ClosedJaxpr:
    """Return a jaxpr with `rule(equation)` for each equation, in inner jaxprs too; the same object
    if nothing changes. Bodies of calls with a derivative rule are not changed."""
    # The cache keeps a jaxpr that several equations share one object, differentiated once.
    jaxpr = _rewritten(closed.jaxpr, rule)
    return closed if jaxpr is closed.jaxpr else closed.replace(jaxpr=jaxpr)


def _rewritten(jaxpr: Jaxpr, rule: Callable[[Any], Any]) -> Jaxpr:
    of_closed, of_open = lambda x: rewritten(x, rule), lambda x: _rewritten(x, rule)
    eqns = [with_mapped_bodies(rule(eqn), of_closed, of_open) for eqn in jaxpr.eqns]
    is_same = all(a is b for a, b in zip(eqns, jaxpr.eqns, strict=True))
    return jaxpr if is_same else jaxpr.replace(eqns=eqns)


def with_mapped_bodies(
    eqn: Any, of_closed: Callable[[ClosedJaxpr], Any], of_open: Callable[[Jaxpr], Any]
) -> Any:
    """Return an equation whose inner jaxprs are replaced. One with its own derivative rule stays as
    it is, since the rule belongs to the body."""
    if eqn.primitive.name in OWN_DERIVATIVE or not bodies(eqn):
        return eqn

    def mapped(value: object) -> Any:
        if isinstance(value, ClosedJaxpr):
            return of_closed(value)
        if isinstance(value, Jaxpr):
            return of_open(value)
        if isinstance(value, tuple) and any(isinstance(x, ClosedJaxpr) for x in value):
            found = [mapped(x) for x in value]
            if all(a is b for a, b in zip(found, value, strict=True)):
                return value
            return type(value)(*found) if hasattr(value, "_fields") else tuple(found)
        return value

    found = {name: mapped(x) for name, x in eqn.params.items()}
    is_same = all(x is found[name] for name, x in eqn.params.items())
    return eqn if is_same else eqn.replace(params=found)


def bodies(eqn: Any) -> list[Jaxpr]:
    values = [x for v in eqn.params.values() for x in (v if isinstance(v, tuple) else (v,))]
    return [inner(x) for x in values if isinstance(x, Jaxpr | ClosedJaxpr)]


def size_of(jaxpr: Jaxpr) -> int:
    """Return the number of operations; those of an inner jaxpr count once."""
    return sum(1 + sum(map(size_of, bodies(eqn))) for eqn in jaxpr.eqns)


def needed_equations(
    eqns: Sequence[Any],
    outs: Sequence[Any],
    reduced: Callable[[Any, tuple[bool, ...]], Any] = lambda eqn, _: eqn,
) -> list[Any]:
    """Return the equations that the atoms `outs` need, and those with effects. `reduced` may
    simplify an equation, given flags of its results that are used."""
    wanted, kept = {a for a in outs if not isinstance(a, Literal)}, []
    for eqn in reversed(eqns):
        used = tuple(v in wanted for v in eqn.outvars)
        if eqn.effects or any(used):
            kept.append(reduced(eqn, used))
            wanted.update(a for a in kept[-1].invars if not isinstance(a, Literal))
    return kept[::-1]


# Primitives with floating-point results whose derivative is zero, or is treated as zero.
_ZERO_DERIVATIVE = ("stop_gradient", "sign", "round", "floor", "ceil")


def propagate_marks(
    jaxpr: Jaxpr,
    marks: Sequence[bool],
    rule: Callable[[Any, list[bool]], list[bool]],
    visit: Callable[[Any, list[bool], list[bool]], None] = lambda *_: None,
) -> list[bool]:
    """Propagate marks from the arguments of a jaxpr through its equations to its results.
    `rule(equation, marks)` returns the marks of an equation's results if any of its arguments is
    marked. `visit` is called with each equation, the marks of its arguments and those of its
    results."""
    found = {v for v, mark in zip(jaxpr.invars, marks, strict=True) if mark}
    marked = lambda atoms: [not isinstance(a, Literal) and a in found for a in atoms]
    for eqn in jaxpr.eqns:
        args = marked(eqn.invars)
        outs = rule(eqn, args) if any(args) else [False] * len(eqn.outvars)
        found.update(v for v, mark in zip(eqn.outvars, outs, strict=True) if mark)
        visit(eqn, args, outs)
    return marked(jaxpr.outvars)


def dependent_results(jaxpr: Jaxpr, sources: Sequence[bool], *, smooth: bool) -> list[bool]:
    """Return flags of the results of a jaxpr that may depend on the arguments flagged in `sources`.
    If `smooth`, only dependence that can have a derivative counts."""
    return list(_dependent_results(jaxpr, tuple(sources), smooth))


# Cached: a step calls the jaxpr of the field some sixty times, and loops are analysed repeatedly.
@functools.lru_cache(maxsize=1024)
def _dependent_results(jaxpr: Jaxpr, sources: tuple[bool, ...], smooth: bool) -> list[bool]:
    return propagate_marks(jaxpr, sources, functools.partial(dependent_of_equation, smooth=smooth))


def dependent_of_equation(eqn: Any, args: list[bool], *, smooth: bool) -> list[bool]:
    if smooth and eqn.primitive.name in _ZERO_DERIVATIVE:
        return [False] * len(eqn.outvars)
    found = zip(_dependent(eqn, args, smooth=smooth), eqn.outvars, strict=True)
    return [a and (not smooth or jnp.issubdtype(v.aval.dtype, jnp.inexact)) for a, v in found]


def _dependent(eqn: Any, args: list[bool], *, smooth: bool) -> list[bool]:
    name, params = eqn.primitive.name, eqn.params
    depends = functools.partial(dependent_results, smooth=smooth)
    if not (smooth and name in OWN_DERIVATIVE) and (body := called(eqn)) is not None:
        return depends(inner(body), args)
    if name == "cond" and (smooth or not args[0]):
        branches = [depends(inner(b), args[1:]) for b in params["branches"]]
        return [any(branch) for branch in zip(*branches, strict=True)]
    if name == "scan":
        n, m = scan_counts(params)
        fixed, carry, rows = args[:n], args[n : n + m], args[n + m :]
        body = inner(params["jaxpr"])
        return fixed_point(lambda c: depends(body, [*fixed, *c, *rows]), carry)
    if name == "while":
        n, m = params["cond_nconsts"], params["body_nconsts"]
        cond_fixed, fixed, carry = args[:n], args[n : n + m], args[n + m :]
        body = inner(params["body_jaxpr"])
        outs = fixed_point(lambda c: depends(body, [*fixed, *c]), carry)
        ends = depends(inner(params["cond_jaxpr"]), [*cond_fixed, *outs])
        return [True] * len(outs) if any(ends) else outs
    return [True] * len(eqn.outvars)


def dependent_in_scan(eqn: Any, args: list[bool]) -> list[bool]:
    """Return flags of the arguments of a `scan`'s body that depend, in any iteration, on those
    flagged in `args`, arguments of the `scan`."""
    outs = dependent_of_equation(eqn, args, smooth=False)
    n, m = scan_counts(eqn.params)
    return [*args[:n], *outs[:m], *args[n + m :]]


def loop_depends(jaxpr: Jaxpr, sources: Sequence[bool]) -> bool:
    """Return whether a `while` of a jaxpr, or of one that it calls, has a result with a derivative
    with respect to the arguments flagged in `sources`."""
    found = []

    def visit(eqn: Any, args: list[bool], outs: list[bool]) -> None:
        name = eqn.primitive.name
        found.append(name == "while" and any(outs))
        if name == "cond" and any(args):
            found.extend(loop_depends(inner(x), args[1:]) for x in eqn.params["branches"])
        elif any(args) and name not in OWN_DERIVATIVE and (body := called(eqn)) is not None:
            found.append(loop_depends(inner(body), args))

    propagate_marks(jaxpr, sources, functools.partial(dependent_of_equation, smooth=True), visit)
    return any(found)


def scan_counts(params: Mapping[str, Any]) -> tuple[int, int]:
    """Return the numbers of constant and of carried arguments of a `scan`."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    fixed, carry, _ = params["ft_in"].unpack()  # since JAX 0.12: the arguments as trees
    return len(fixed), len(carry)


def fixed_point(body: Callable[[list[bool]], list[bool]], carry: list[bool]) -> list[bool]:
    """Return the flags of a loop body's results at their fixed point, carry first. `body` maps
    flags of the carry to flags of its results."""
    while True:
        outs = body(carry)
        grown = [a or b for a, b in zip(carry, outs, strict=False)]
        if grown == carry:
            return [*carry, *outs[len(carry) :]]
        carry = grown
