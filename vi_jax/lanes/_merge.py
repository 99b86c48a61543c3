"""Merging equal equations of a jaxpr, so that each is differentiated and written once.

JAX traces what a function writes: the sine of an angle in the mass matrix, in its derivative and in
the force becomes three equations, and a mass of 1 a division by 1.
"""

import copy
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from ._derivative import as_quotient
from ._program import needed_equations, with_mapped_bodies

# A call of at most so many equations is written inline, such as those of `jnp.where`: a choice. A
# step has some hundred of them, whose equations could not be merged.
_SMALL = 8


# Operations on known numbers that are done here. NumPy rounds as a processor does.
_KNOWN: dict[str, Callable[..., Any]] = {
    "neg": np.negative, "add": np.add, "sub": np.subtract, "mul": np.multiply,
    "quotient": np.divide, "abs": np.abs, "max": np.maximum, "min": np.minimum, "gt": np.greater,
    "lt": np.less, "ge": np.greater_equal, "le": np.less_equal, "eq": np.equal,
    "ne": np.not_equal, "convert_element_type": lambda x: x, "stop_gradient": lambda x: x,
}  # fmt: skip


def merged(*jaxprs: ClosedJaxpr) -> list[ClosedJaxpr]:
    """Return jaxprs with the same results, in each of which no two equations are equal and each is
    needed; their inner jaxprs too. Small calls are inlined, and arithmetic with known numbers is
    done. Floating-point divisions become quotients, which have a better derivative."""
    merger = _Merger()
    return [merger.closed(x) for x in jaxprs]


class _Merger:
    """A jaxpr that several equations share stays one object. The cache does not outlive the call,
    so that the original jaxprs can be freed."""

    def __init__(self):
        self.closed, self.open = functools.cache(self._closed), functools.cache(self._open)

    def _closed(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        return closed.replace(jaxpr=self.open(closed.jaxpr))

    def _open(self, jaxpr: Jaxpr) -> Jaxpr:
        writer = _Writer(self)
        outs = writer.append(jaxpr.eqns, {}, jaxpr.outvars)
        return jaxpr.replace(eqns=needed_equations(writer.eqns, outs), outvars=outs)


class _Writer:
    """The equations of a jaxpr while they are merged."""

    def __init__(self, merger: _Merger):
        self.eqns: list[Any] = []
        self._merger = merger
        self._found: dict[Any, Sequence[Any]] = {}

    def append(
        self, eqns: Sequence[Any], known: dict[Any, Any], results: Sequence[Any], inlined=False
    ) -> list[Any]:
        """Append equations, and return the atoms for `results`. `known`, which is changed, has the
        atoms that stand for variables. The variables of an `inlined` body are replaced by new ones,
        since the body may be called again."""

        def read(atom: Any) -> Any:
            return atom if isinstance(atom, Literal) else known.get(atom, atom)

        for eqn in eqns:
            given = [read(a) for a in eqn.invars]
            body = _body(eqn)
            body = None if body is None else self._merger.open(body)
            if body is not None and len(body.eqns) <= _SMALL:
                arguments = dict(zip(body.invars, given, strict=True))
                outs = self.append(body.eqns, arguments, body.outvars, inlined=True)
            else:
                eqn = with_mapped_bodies(as_quotient(eqn), self._merger.closed, self._merger.open)
                found = _without_arithmetic(eqn, given)
                outs = self._one(eqn.replace(invars=given), inlined) if found is None else [found]
                if body is not None:
                    pairs = zip(outs, body.outvars, strict=True)
                    outs = [x if isinstance(x, Literal) else out for out, x in pairs]
            known.update(zip(eqn.outvars, outs, strict=True))
        return [read(a) for a in results]

    def _one(self, eqn: Any, inlined: bool) -> Sequence[Any]:
        """Append an equation unless an equal one exists, and return its variables."""
        key = _key(eqn)
        found = self._found.get(key)
        # An unused result may have a variable of another type, which no equation can read.
        if found is not None and [*map(type, found)] == [*map(type, eqn.outvars)]:
            return found
        if inlined:
            eqn = eqn.replace(outvars=[*map(copy.copy, eqn.outvars)])
        self.eqns.append(eqn)
        if key is not None:
            self._found[key] = eqn.outvars
        return eqn.outvars


def _without_arithmetic(eqn: Any, given: Sequence[Any]) -> Any:
    """Return the result of an equation with known numbers, or of one that returns its argument (a
    number times 1, for example); `None` for other equations."""
    name = eqn.primitive.name
    numbers: list[Any] = [x for x in given if isinstance(x, Literal)]
    if name not in _KNOWN or not numbers or eqn.outvars[0].aval.shape:
        return None
    aval: Any = eqn.outvars[0].aval
    if len(numbers) == len(given):
        with np.errstate(all="ignore"):
            known = _KNOWN[name](*(np.asarray(x.val, x.aval.dtype) for x in numbers))
        return Literal(known.astype(aval.dtype)[()], aval)
    first, last = given[0], given[-1]
    if name == "mul" and isinstance(first, Literal):
        first, last = last, first
    same = {"mul": 1.0, "quotient": 1.0, "sub": 0.0}.get(name)
    is_same = isinstance(last, Literal) and last.val == same and first.aval == aval
    return first if is_same else None


def _body(eqn: Any) -> Jaxpr | None:
    """Return the body of a call that may be written inline; `None` for other equations."""
    if eqn.primitive.name != "jit":
        return None
    closed = eqn.params["jaxpr"]
    return None if closed.consts or closed.effects else closed.jaxpr


def _key(eqn: Any) -> Any:
    """Return a key that is equal only for equations with equal results; `None` if unknown."""
    if eqn.effects:
        return None
    params = tuple(sorted((k, x) for k, x in eqn.params.items() if k != "name"))
    key = eqn.primitive, params, tuple(map(_atom_key, eqn.invars))
    try:
        hash(key)
    except TypeError:
        return None
    return key


def _atom_key(atom: Any) -> Any:
    if not isinstance(atom, Literal):
        return atom
    aval: Any = atom.aval
    return aval, np.asarray(atom.val, aval.dtype).tobytes()
