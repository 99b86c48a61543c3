"""Writing a jaxpr of one lane's scalars and small arrays as vector code for a group of lanes."""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from ._array_rules import IN_PLACE, PLACED, STRUCTURAL, any_in, select_parts
from ._arrays import (
    MOST_IN_REGISTERS,
    Array,
    Formula,
    Index,
    Masked,
    Memory,
    Registers,
    Strided,
    addressable,
    computed,
    fill,
    joined_cuts,
    mapped,
    plus,
    replace,
    reserve,
    same,
    selected,
    separate,
    stored,
    table,
    times,
    to_registers,
    uniform,
    without_cuts,
    write_loop,
    write_loops,
)
from ._operations import ELEMENTWISE, IDENTITY_PRIMITIVES, kind_of
from ._program import CALLS, called, inner, needed_equations, scan_counts, shape_of, size_of
from ._text import Text, Value


class Unsupported(Exception):
    """The error for a program without a vector form; its argument names the reason."""


# Cached, as the analysis below: a step calls the jaxpr of the field some fifty times.
@functools.lru_cache(maxsize=1024)
def check(jaxpr: Jaxpr) -> None:
    """Raise `Unsupported` with the first primitive or type that has no vector form, or `TypeError`
    for a function without a forward derivative."""
    needed, _, _ = _analysed(jaxpr)
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
        rules = (ELEMENTWISE, STRUCTURAL, PLACED, DERIVED)
        if not (_bodies(eqn) or any(eqn.primitive.name in table for table in rules)):
            raise Unsupported(f"the primitive `{eqn.primitive.name}`")


def _bodies(eqn: Any) -> list[Jaxpr]:
    """Return the bodies of an equation's calls, branches and loops that are written for it."""
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
    array = np.asarray(array)
    kind = kind_of(array.dtype)
    if array.size > MOST_IN_REGISTERS:
        return table(t, array, kind)
    return Registers.of(array.shape, kind, lambda i: t.constant(array[i], kind))


def write(
    t: Text, closed: ClosedJaxpr | Jaxpr, args: list[Any], mask: Value, owned: Sequence[Any] = ()
) -> list[Any]:
    """Append the operations of a jaxpr to a text, as LLVM code for one group of lanes; return its
    results as `Array`s. `mask` holds in the lanes that need them. Code that none of them needs may
    be skipped. Results of other lanes are arbitrary. Arguments that are `owned` may be changed in
    place, in the lanes of the mask: a block of one that is not used any more."""
    jaxpr, env = inner(closed), {}
    own = {v for v, x in zip(jaxpr.invars, args, strict=True) if any(x is y for y in owned)}
    needed, uses, last = _analysed(jaxpr)

    def read(atom: object) -> Array:
        if isinstance(atom, Literal):
            aval: Any = atom.aval
            return constants(t, np.asarray(atom.val, aval.dtype))
        return env[atom]

    def put(variables: list[Any], values: list[Any]) -> None:
        for var, value in zip(variables, values, strict=True):
            # A value used more than once is computed once.
            env[var] = computed(t, value) if uses.get(var, 0) > 1 else value

    put(jaxpr.constvars, [constants(t, x) for x in getattr(closed, "consts", ())])
    put(jaxpr.invars, args)
    for number, eqn in enumerate(needed):
        given: list[Any] = [read(a) for a in eqn.invars]
        first = next(iter(eqn.invars), None)
        in_place = eqn.primitive.name in IN_PLACE and isinstance(given[0], Strided)
        if in_place and first in last.get(number, ()) and first in own:
            for var, x in env.items():  # what may read the old numbers later
                if var is not first and not isinstance(x, Registers):
                    env[var] = separate(t, x, [given[0]])
            put(eqn.outvars, _write_equation(t, eqn, given, mask, in_place=True))
            own.add(eqn.outvars[0])
        else:
            put(eqn.outvars, _write_equation(t, eqn, given, mask))
        for var in last.get(number, ()):  # so that its memory is reused
            env.pop(var, None)
    return [read(a) for a in jaxpr.outvars]


@functools.lru_cache(maxsize=1024)
def _analysed(jaxpr: Jaxpr) -> tuple[list[Any], dict[Any, int], dict[int, list[Any]]]:
    """Return the needed equations, the number of uses of each variable, and the variables last used
    by each equation."""
    needed = needed_equations(jaxpr.eqns, jaxpr.outvars, _without_unused)
    uses, last_use = {}, {}
    for number, atoms in enumerate([*(eqn.invars for eqn in needed), jaxpr.outvars]):
        for atom in atoms:
            if not isinstance(atom, Literal):
                uses[atom] = uses.get(atom, 0) + 1
                last_use[atom] = number
    last: dict[int, list[Any]] = {}
    for var, number in last_use.items():
        last.setdefault(number, []).append(var)
    return needed, uses, last


# A call of a large part keeps its unused results if it needs more than this share of the part. A
# choice: as parts of their own, they made the text of a block on two corners a third longer.
_LITTLE = 0.25


def _without_unused(eqn: Any, used: tuple[bool, ...]) -> Any:
    """Return a call without results that are not `used`, and arguments that only they need."""
    if eqn.primitive.name != "jit" or all(used):
        return eqn
    whole = eqn.params[CALLS["jit"]]
    body, needed = _reduced(whole, used)
    if size_of(inner(body)) > max(_LEAST_FUNCTION, _LITTLE * size_of(inner(whole))):
        return eqn
    return eqn.replace(
        invars=list(itertools.compress(eqn.invars, needed)),
        outvars=list(itertools.compress(eqn.outvars, used)),
        params=eqn.params | {CALLS["jit"]: body},
    )


# The cache keeps a body one object in several calls, so that it can become one function.
@functools.lru_cache(maxsize=1024)
def _reduced(closed: ClosedJaxpr, used: tuple[bool, ...]) -> tuple[ClosedJaxpr, tuple[bool, ...]]:
    """Return a body with its `used` results, and flags of the arguments that these need."""
    jaxpr = closed.jaxpr
    outs = list(itertools.compress(jaxpr.outvars, used))
    eqns = needed_equations(jaxpr.eqns, outs, _without_unused)
    atoms = itertools.chain(outs, *(eqn.invars for eqn in eqns))
    read = {a for a in atoms if not isinstance(a, Literal)}
    needed = tuple(v in read for v in jaxpr.invars)
    invars = list(itertools.compress(jaxpr.invars, needed))
    return closed.replace(jaxpr=jaxpr.replace(invars=invars, outvars=outs, eqns=eqns)), needed


def _write_equation(
    t: Text, eqn: Any, args: list[Any], mask: Value, in_place: bool = False
) -> list[Any]:
    name, params = eqn.primitive.name, eqn.params
    if (body := called(eqn)) is not None:
        results = None if t.functions is None else t.functions.call(t, body, args, mask)
        return write(t, body, args, mask) if results is None else results
    if name in CONTROL:
        return CONTROL[name](t, params, [computed(t, x) for x in args], mask)
    if name == "custom_linear_solve":
        before, _, solve, _ = np.cumsum([0, *params["const_lengths"]])[1:]
        of_vecmat = int(before + params["const_lengths"].vecmat), int(solve)
        consts, right = args[slice(*of_vecmat)], args[sum(params["const_lengths"]) :]
        return write(t, params["jaxprs"].solve, [*consts, *right], mask)
    avals = [v.aval for v in eqn.outvars]
    if name in DERIVED:
        return write(t, derived(name, [a.aval for a in eqn.invars], params), args, mask)
    if name in ELEMENTWISE:
        dtypes = [a.aval.dtype for a in eqn.invars]
        return _elementwise(t, name, params, dtypes, args, avals)
    if name in PLACED:
        dtypes = [a.aval.dtype for a in eqn.invars]
        out = PLACED[name](t, params, avals, dtypes, *args, **({"mask": mask} if in_place else {}))
    else:
        out = STRUCTURAL[name](t, params, avals, *args)
    return [to_registers(t, x) for x in (out if eqn.primitive.multiple_results else [out])]


def _elementwise(t: Text, name, params, dtypes, args, avals) -> list[Array]:
    """Return the results of a rule of `ELEMENTWISE`: in registers for small arrays, as a formula
    for larger ones. Several large results, which one call of the rule computes, are stored."""
    several, shape, kinds = len(avals) > 1, avals[0].shape, [kind_of(a.dtype) for a in avals]

    def results(*numbers: Value) -> tuple[Value, ...]:
        found = ELEMENTWISE[name](t, params, dtypes, *numbers)
        return found if several else (found,)

    if avals[0].size <= MOST_IN_REGISTERS and all(isinstance(x, Registers) for x in args):
        values: list[Any] = [x.values for x in args]
        if not any(x.shape for x in values):
            return [Registers.one(x) for x in results(*(x[()] for x in values))]
        if any(x.shape != values[0].shape for x in values):
            values = [*np.broadcast_arrays(*values)]
        outs = [np.empty(values[0].size, object) for _ in avals]
        for i, numbers in enumerate(zip(*(x.flat for x in values), strict=True)):
            for out, value in zip(outs, results(*numbers), strict=True):
                out[i] = value
        shaped = (out.reshape(values[0].shape) for out in outs)
        return [Registers(out, kind) for out, kind in zip(shaped, kinds, strict=True)]
    if name in IDENTITY_PRIMITIVES:
        return args[:1]

    def results_at(index: tuple) -> tuple[Value, ...]:
        # JAX broadcasts scalars and axes of length one.
        return results(*(
            x.at(t, [i if n != 1 else 0 for i, n in zip(index, x.shape, strict=False)])
            for x in args
        ))  # fmt: skip

    values = [_only_number(x) for x in args]
    if all(v is not None for v in values):
        return [uniform(shape, v) for v in results(*values)]
    if name == "select_n" and len(args) == 3 and values[0] is not None:
        if values[0].kind == "i1" and args[1].shape == args[2].shape:
            found = select_parts(t, values[0], args[2], args[1])
            if found is not None:
                return [found]
    if not several:
        cuts = joined_cuts(*(x.cuts for x in args if x.ndim))
        # Rounding must not depend on whether the result is stored before use.
        return [Formula(shape, kinds[0], lambda i: t.opaque(results_at(i)[0]), cuts=cuts)]
    outs = [reserve(t, shape, kind) for kind in kinds]

    def put(index: tuple) -> None:
        for out, value in zip(outs, results_at(index), strict=True):
            out.put(t, index, value)

    write_loops(t, shape, put, joined_cuts(*(x.cuts for x in args)))
    return list(outs)


# A part that is called more than once becomes a function if it has at least so many operations, and
# more than arguments and results. Choices: a call of 20 vectors costs about as much as 10
# operations, and a field of 80 that was written inline at its 24 calls ran 7 % slower.
_LEAST_FUNCTION = 50


class _Function(NamedTuple):
    name: str
    results: list[tuple[tuple[int, ...], str]]
    """The shape and the kind of each result."""
    memory: int
    """The number of vectors that it needs for large arrays."""


class Functions:
    """The parts of a program that are called several times, such as its field, each written once as
    a function. Its arguments and results are numbers in registers."""

    def __init__(self, jaxprs: Sequence[ClosedJaxpr | Jaxpr]):
        self.texts: list[str] = []
        self._types: dict[str, str] = {}
        self._calls: dict[int, int] = {}
        self._found: dict[tuple, _Function | None] = {}
        for jaxpr in jaxprs:
            self._count(inner(jaxpr))

    def _count(self, jaxpr: Jaxpr) -> None:
        for eqn in _analysed(jaxpr)[0]:
            body = called(eqn)
            for each in _bodies(eqn) if body is None else [inner(body)]:
                number = self._calls.get(id(each), 0)
                if body is not None:
                    self._calls[id(each)] = number + 1
                if not number:
                    self._count(each)

    def call(
        self, t: Text, closed: ClosedJaxpr | Jaxpr, args: list[Any], mask: Value
    ) -> list[Any] | None:
        """Return the results of a call, or `None` if it should be written inline."""
        jaxpr = inner(closed)
        if self._calls.get(id(jaxpr), 0) < 2 or not all(isinstance(x, Registers) for x in args):
            return None
        key = id(jaxpr), *((x.shape, x.kind) for x in args)
        if key not in self._found:
            vectors = sum(shape_of(v.aval).size for v in (*jaxpr.invars, *jaxpr.outvars))
            is_large = size_of(jaxpr) >= max(_LEAST_FUNCTION, vectors)
            self._found[key] = self._written(t, closed, args) if is_large else None
        found = self._found[key]
        if found is None:
            return None
        values = ", ".join(f"{t.vector(x.kind)} {x.text}" for x in (*_flat(args), mask))
        returned = self._type(t, found.results)

        def written() -> str:
            block = t.arena.take(max(found.memory, 1))
            memory = f"ptr {Memory(block).pointer(t)}"
            return f"call fastcc {returned} @{found.name}({memory}, {values})"

        call = t.call(written, of=f"{found.name}({values})")
        number = iter(range(len(_numbers(found.results))))

        def result(kind: str) -> Value:
            return t.value(f"extractvalue {returned} {call}, {next(number)}", kind)

        return [
            Registers.of(shape, kind, lambda _, kind=kind: result(kind))
            for shape, kind in found.results
        ]

    def _written(self, t: Text, closed: ClosedJaxpr | Jaxpr, args: list[Any]) -> _Function | None:
        """Write a function; `None` if its results are not all in registers."""
        own = Text(t.width)
        own.declared, own.functions = t.declared, self
        given = [mapped(own, lambda x: Value(own.fresh(), x.kind), x) for x in args]
        mask = Value(own.fresh(), "i1")
        results = [computed(own, x) for x in write(own, closed, given, mask)]
        if not all(isinstance(x, Registers) for x in results):
            return None
        shapes = [(x.shape, x.kind) for x in results]
        found = _Function(f"part{len(self._found)}", shapes, own.arena.size)
        kind, name = self._type(t, found.results), "poison"
        for i, x in enumerate(_flat(results)):
            name = own.raw(f"insertvalue {kind} {name}, {t.vector(x.kind)} {x.text}, {i}")
        values = [f"{t.vector(x.kind)} {x.text}" for x in (*_flat(given), mask)]
        parameters = ", ".join(["ptr %arena", *values])
        of_type = f"define internal fastcc {kind}"
        head = f"{of_type} @{found.name}({parameters}) noinline #0 {{\nentry:"
        self.texts.append("\n".join([head, *own.lines, f"  ret {kind} {name}", "}"]))
        return found

    def _type(self, t: Text, results: list[tuple[tuple[int, ...], str]]) -> str:
        """Return the name of the type of some results: each use would repeat all vectors."""
        text = "{ " + ", ".join(t.vector(kind) for kind in _numbers(results)) + " }"
        if text not in self._types:
            self._types[text] = name = f"%results{len(self._types)}"
            self.texts.insert(0, f"{name} = type {text}")
        return self._types[text]


def _numbers(results: list[tuple[tuple[int, ...], str]]) -> list[str]:
    """Return the kind of each number of some results."""
    return [kind for shape, kind in results for _ in np.ndindex(shape)]


def _only_number(x: Array) -> Value | None:
    if isinstance(x, Registers):
        return x.item() if x.size == 1 else None
    return x.value if isinstance(x, Formula) else None


# --- conditions and loops: jaxprs that are skipped or repeated

# The most operations, all iterations together, of an unrolled loop. It bounds the compile time.
_MOST_UNROLLED = 256

# A branch with at most so many operations may be computed even if no lane needs it.
_CHEAP = 4


def _cond(t: Text, params: dict, args: list[Any], mask: Value) -> list[Any]:
    """Write the branches. All but a cheap first one are skipped if no lane takes them."""
    branches, choice, args = params["branches"], args[0].item(), args[1:]
    last = len(branches) - 1
    flags = []
    for i in range(len(branches)):
        relation = "sle" if i == 0 else "sge" if i == last else "eq"
        if choice.kind == "i1":
            flag = choice if i else t.inverse(choice)
        else:
            flag = t.binary(f"icmp {relation}", choice, t.constant(i, choice.kind), "i1")
        flags.append(flag)
    # The smallest branch comes first. The others replace its results in their own lanes.
    order = sorted(range(len(branches)), key=lambda i: size_of(inner(branches[i])))
    result: list[Any] | None = None
    for i in order:
        if result is None and _is_cheap(inner(branches[i])):
            result = [computed(t, x) for x in write(t, branches[i], args, mask)]
            continue
        result = _branch_if_any(t, branches[i], args, t.both(mask, flags[i]), result)
    assert result is not None
    return [_opaque(t, x) for x in result]


def _is_cheap(jaxpr: Jaxpr) -> bool:
    """Return whether skipping a branch does not pay: few operations, or only constants."""
    constant = (
        eqn.primitive.name == "broadcast_in_dim" and isinstance(eqn.invars[0], Literal)
        for eqn in jaxpr.eqns
    )
    return size_of(jaxpr) <= _CHEAP or all(constant)


def _branch_if_any(t: Text, jaxpr, args, mask: Value, otherwise) -> list[Any]:
    """Return the results of a jaxpr in the lanes of `mask`, and `otherwise` in the others
    (arbitrary if `None`). The jaxpr is skipped if `mask` has no lane."""
    inside, skip, after = t.label(), t.label(), t.label()
    # A large result has one address, whether or not the branch is skipped.
    avals: list[Any] = [v.aval for v in inner(jaxpr).outvars]
    memory = [
        reserve(t, a.shape, kind_of(a.dtype)) if a.size > MOST_IN_REGISTERS else None for a in avals
    ]
    in_memory = any(r is not None for r in memory)
    before = t.block
    t.fork(t.any(mask), inside, skip if in_memory else after, rare=True)
    t.open(inside)
    found = write(t, jaxpr, args, mask)
    results: list[Any] = []
    others: list[Any] = [None] * len(found) if otherwise is None else otherwise
    for x, y, r in zip(found, others, memory, strict=True):
        if r is not None:
            results.append(_branch_result(t, x, y, r, args, mask))
        else:
            results.append(x if y is None else selected(t, mask, x, y))
    end = t.block
    t.line(f"br label %{after}")
    t.close()
    if in_memory:
        t.open(skip)
        for x, y, r in zip(results, others, memory, strict=True):
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
        for x, y, r in zip(results, others, memory, strict=True)
    ]


def _branch_result(
    t: Text, x: Array, y: Array | None, r: Strided, args: list[Any], mask: Value
) -> Array:
    """Return a large result: `x` in the lanes of `mask`, `y` in the others (`None`: arbitrary), in
    the memory `r` if it is stored. Copies are avoided, since branches of a derivative often return
    an argument unchanged, or zeros."""
    value_x, value_y = (a.value if isinstance(a, Formula) else None for a in (x, y))
    if value_x is not None and value_x.number is not None and (y is None or value_x == value_y):
        return x
    if y is not None and same(x, y):
        return y
    if value_y == t.zero(r.kind):
        if not (isinstance(x, Strided) and any(same(x, a) for a in args)):
            fill(t, r, x)
            x = r
        return Masked(r.shape, r.kind, x, mask)
    fill(t, r, x if y is None else selected(t, mask, x, y))
    return r


def _opaque(t: Text, x: Array) -> Array:
    """Apply `Text.opaque` to a result of a condition or of a loop iteration."""
    return mapped(t, t.opaque, x) if isinstance(x, Registers) else x


def _while(t: Text, params: dict, args: list[Any], mask: Value) -> list[Any]:
    """Write a loop until no lane of `mask` continues. Lanes that have ended keep their carry."""
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
    # `vmap` within a lane merges loops into one, which runs as long as one of them continues.
    condition = computed(t, write(t, params["cond_jaxpr"], [*cond_args, *carry], live)[0])
    continues = t.both(live, any_in(t, condition))
    t.fork(t.any(continues), inside, after)
    t.open(inside)
    new = write(t, params["body_jaxpr"], [*body_args, *carry], continues)
    if condition.ndim:
        new = [_select_by(t, condition, x, y) for x, y in zip(new, carry, strict=True)]
    replace(t, carry, new, continues)
    new = [
        selected(t, continues, x, y) if isinstance(x, Registers) else x
        for x, y in zip(new, carry, strict=True)
    ]
    end = t.block
    t.line(f"br label %{head}")
    t.close()
    t.close()
    entry, repeat = ([*_flat(first), mask], before), ([*_flat(new), continues], end)
    t.join([*_flat(carry), live], entry, repeat, at=place)
    t.follow(after)
    return carry


def _select_by(t: Text, flags: Array, a: Array, b: Array) -> Array:
    """Return the first array where a flag of its leading axes holds, else the second."""
    number = lambda i: t.select(flags.at(t, i[: flags.ndim]), a.at(t, i), b.at(t, i))
    return to_registers(t, Formula(a.shape, a.kind, number, cuts=joined_cuts(a.cuts, b.cuts)))


def _flat(arrays: list[Any]) -> list[Value]:
    """Return the numbers of those arrays that are in registers."""
    return [v for x in arrays if isinstance(x, Registers) for v in x.values.flat]


def _unflat(t: Text, arrays: list[Any], values: list[Value]) -> list[Any]:
    """Return arrays like the given ones, with other numbers in registers."""
    rest = iter(values)
    return [mapped(t, lambda _: next(rest), x) if isinstance(x, Registers) else x for x in arrays]


def _scan(t: Text, params: dict, args: list[Any], mask: Value) -> list[Any]:
    """Write a loop of known length: unrolled if it is short."""
    body, length = inner(params["jaxpr"]), params["length"]
    n, m = scan_counts(params)
    if length and size_of(body) * length > _MOST_UNROLLED:
        return _counted_loop(t, params, args, mask)
    fixed, carry, rows = args[:n], args[n : n + m], args[n + m :]
    order = range(length)[::-1] if params["reverse"] else range(length)
    emitted: dict[int, list[Any]] = {}
    for i in order:
        row = [_row_of(t, x, i) for x in rows]
        out = write(t, params["jaxpr"], [*fixed, *carry, *row], mask)
        carry, emitted[i] = [_opaque(t, x) for x in out[:m]], [computed(t, x) for x in out[m:]]
    columns = []
    for j, var in enumerate(body.outvars[m:]):
        aval: Any = var.aval
        column = [emitted[i][j] for i in range(length)]
        whole = jax.ShapeDtypeStruct((length, *aval.shape), aval.dtype)
        columns.append(to_registers(t, STRUCTURAL["stack"](t, {"axis": 0}, [whole], *column)))
    return [*carry, *columns]


def _row_of(t: Text, x: Array, i: Index) -> Array:
    return to_registers(t, Formula(x.shape[1:], x.kind, lambda j: x.at(t, (i, *j)), cheap=True))


def _counted_loop(t: Text, params: dict, args: list[Any], mask: Value) -> list[Any]:
    """Write a loop of known length with a scalar counter. Its rows are in memory."""
    (n, m), length = scan_counts(params), params["length"]
    fixed, rows = args[:n], [addressable(t, without_cuts(t, x)) for x in args[n + m :]]
    first = [x if isinstance(x, Registers) else stored(t, x) for x in args[n : n + m]]
    avals: list[Any] = [v.aval for v in inner(params["jaxpr"]).outvars[m:]]
    columns = [reserve(t, (length, *a.shape), kind_of(a.dtype)) for a in avals]

    def body(i: Index, values: list[Value]) -> list[Value]:
        carry = _unflat(t, first, values)
        place = plus(t, length - 1, times(t, i, -1)) if params["reverse"] else i
        row = [_row_of(t, x, place) for x in rows]
        out = write(t, params["jaxpr"], [*fixed, *carry, *row], mask)
        for column, x in zip(columns, out[m:], strict=True):
            step, *steps = column.strides
            fill(t, column.viewed(t, x.shape, steps, times(t, place, step)), x)
        replace(t, carry, out[:m])
        return _flat(out[:m])

    carry = [_opaque(t, x) for x in _unflat(t, first, write_loop(t, length, body, _flat(first)))]
    return [*carry, *(to_registers(t, x) for x in columns)]


CONTROL: dict[str, Callable[..., list[Any]]] = {"cond": _cond, "while": _while, "scan": _scan}
"""Functions by the primitive's name. Their arguments are the text, the equation's parameters, its
arguments without costly formulas, and the lanes that need the results. They return the results."""


# --- primitives written in JAX: factorizations of small matrices, sorting, argmin and argmax


def _lu(a):
    """Return the LU factorization A = P⁻¹LU with column pivoting, of matrices (…, n, m)."""
    n, m = a.shape[-2:]
    rows = jnp.arange(n)
    order = jnp.broadcast_to(rows, a.shape[:-1])
    pivots = []
    for k in range(min(n, m)):
        column = jnp.where(rows >= k, jnp.abs(a[..., k]), -1.0)
        greatest = jnp.max(column, axis=-1, keepdims=True)
        pivot = jnp.min(jnp.where(column == greatest, rows, n - 1), axis=-1, keepdims=True)
        pivots.append(pivot)
        is_pivot = rows == pivot

        def exchanged(x, is_pivot=is_pivot, k=k):
            """Return `x` with row k and the pivot's row exchanged."""
            wide = is_pivot.reshape(*is_pivot.shape, *(1,) * (x.ndim - is_pivot.ndim))
            first = x[..., k : k + 1, :] if x.ndim > is_pivot.ndim else x[..., k : k + 1]
            other = jnp.sum(jnp.where(wide, x, 0), axis=is_pivot.ndim - 1, keepdims=True)
            moved = jnp.where(wide, first, x)
            at_k = (rows == k).reshape(n, *(1,) * (x.ndim - is_pivot.ndim))
            return jnp.where(at_k, other, moved)

        a, order = exchanged(a), exchanged(order)
        largest = a[..., k : k + 1, k : k + 1]
        # A column of zeros remains zero: the matrix is singular.
        factor = a[..., k : k + 1] / jnp.where(largest == 0, 1, largest)
        below, right = (rows > k)[:, None], jnp.arange(m) > k
        a = jnp.where(below & (jnp.arange(m) == k), factor, a)
        a = jnp.where(below & right, a - factor * a[..., k : k + 1, :], a)
    pivot = jnp.concatenate(pivots, axis=-1)
    return a, pivot.astype(jnp.int32), order.astype(jnp.int32)


def _triangular_solve(a, b, *, left_side, lower, transpose_a, unit_diagonal, **_):
    """Solve A X = B or X A = B with a triangular A."""
    if not left_side:  # the transposed equation
        a, b = jnp.swapaxes(a, -1, -2), jnp.swapaxes(b, -1, -2)
        lower = not lower
    if transpose_a:
        a, lower = jnp.swapaxes(a, -1, -2), not lower
    n = a.shape[-1]
    rows: dict[int, Any] = {}
    for k in range(n) if lower else range(n)[::-1]:
        row = b[..., k, :]
        for j, known in rows.items():
            row = row - a[..., k, j, None] * known
        rows[k] = row if unit_diagonal else row / a[..., k, k, None]
    x = jnp.stack([rows[k] for k in range(n)], axis=-2)
    return [x if left_side else jnp.swapaxes(x, -1, -2)]


def _cholesky(a, **_):
    """Return L of A = L Lᵀ; NaN if A is not positive definite."""
    n = a.shape[-1]
    out = jnp.zeros_like(a)
    for k in range(n):
        column = a[..., k] - jnp.sum(out * out[..., k : k + 1, :], axis=-1)
        column = column / jnp.sqrt(column[..., k : k + 1])
        column = jnp.where(jnp.arange(n) >= k, column, 0.0)
        out = jnp.where(jnp.arange(n) == k, column[..., None], out)
    return [out]


def _sort(*xs, dimension, num_keys, **_):
    """Sort arrays by the first `num_keys` of them. The sort is stable."""
    xs = [jnp.moveaxis(x, dimension, -1) for x in xs]
    n = xs[0].shape[-1]
    places = jnp.arange(n)
    before = jnp.broadcast_to(places[None, :] < places[:, None], (*xs[0].shape, n))
    for x in xs[:num_keys][::-1]:
        one, other = x[..., :, None], x[..., None, :]
        one, other = jnp.broadcast_arrays(one, other)
        # NaN is greater than all numbers and equal to NaN.
        less, same = other < one, one == other
        if _is_float(x):
            less, same = (
                less | (one != one) & (other == other),
                same | (one != one) & (other != other),
            )
        before = less | same & before
    rank = jnp.sum(before, axis=-1, dtype=places.dtype)
    matches = rank[..., None, :] == places[:, None]

    def reordered(x):
        found = jnp.sum(jnp.where(matches, x[..., None, :], 0), axis=-1, dtype=x.dtype)
        if not _is_float(x):
            return found
        # The sum loses the sign of -0.
        negative = jnp.any(matches & (1 / x < 0)[..., None, :], axis=-1)
        return jnp.where((found == 0) & negative, -0.0, found)

    sorted_ = [reordered(x) for x in xs]
    return [jnp.moveaxis(x, -1, dimension) for x in sorted_]


def _is_float(x) -> bool:
    return jnp.issubdtype(x.dtype, jnp.floating)


def _first_extreme(extreme: Callable, x, *, axes, index_dtype, **_):
    (axis,) = axes
    n = x.shape[axis]
    places = lax.broadcasted_iota(index_dtype, x.shape, axis)
    best = extreme(x, axis=axis, keepdims=True)
    is_best = (x == best) | (x != x)
    return [jnp.min(jnp.where(is_best, places, n - 1), axis=axis)]


def _tile(x, *, reps):
    wide = jnp.broadcast_to(
        x.reshape([n for m in x.shape for n in (1, m)]),
        [n for r, m in zip(reps, x.shape, strict=True) for n in (r, m)],
    )
    return [wide.reshape([r * m for r, m in zip(reps, x.shape, strict=True)])]


def _reduce_precision(x, *, exponent_bits, mantissa_bits):
    """Return the argument, which `jax.checkpoint` marks so."""
    own = jnp.finfo(x.dtype)
    if exponent_bits < own.nexp or mantissa_bits < own.nmant:
        raise Unsupported(f"numbers of {exponent_bits + mantissa_bits + 1} bits")
    return [x]


DERIVED: dict[str, Callable[..., Any]] = {
    "lu": lambda a, **_: _lu(a),
    "triangular_solve": _triangular_solve,
    "cholesky": _cholesky,
    "sort": _sort,
    "reduce_precision": _reduce_precision,
    "tile": _tile,
    "argmin": functools.partial(_first_extreme, jnp.min),
    "argmax": functools.partial(_first_extreme, jnp.max),
}
"""Functions of a primitive's arguments and parameters that return its results."""


def derived(name: str, avals: list[Any], params: dict[str, Any]) -> ClosedJaxpr:
    """Return a primitive as a jaxpr of other primitives."""
    return jax.make_jaxpr(lambda *args: DERIVED[name](*args, **params))(*map(shape_of, avals))
