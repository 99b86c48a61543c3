"""What lanes run: a loop of one lane's numbers, traced once."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal


class Program(eqx.Module):
    """A lane's loop as jaxprs of flat arguments; hashable, as a primitive's parameter must be.

    `begin(inputs)` and `step(inputs, carry)` give the carry, whether the lane goes on, whether a
    row is complete, and the row; `end(inputs, carry)` gives the results.
    """

    begin: ClosedJaxpr = eqx.field(static=True)
    step: ClosedJaxpr = eqx.field(static=True)
    end: ClosedJaxpr = eqx.field(static=True)
    rows: int = eqx.field(static=True)
    block: int = eqx.field(static=True)
    """Steps in which a lane completes at most one row."""

    slopes: tuple[bool, ...] = eqx.field(static=True, default=())
    """Which inputs are tangents; none may steer the loop."""

    __hash__ = object.__hash__
    __eq__ = object.__eq__

    @property
    def jaxprs(self) -> tuple[ClosedJaxpr, ...]:
        """All of them."""
        return self.begin, self.step, self.end

    @property
    def in_avals(self) -> list[Any]:
        """Of one lane's inputs."""
        return self.begin.in_avals

    @property
    def carry_avals(self) -> list[Any]:
        """Of one lane's carry."""
        return self.step.in_avals[len(self.in_avals) :]

    @property
    def out_avals(self) -> list[Any]:
        """Of one lane's results."""
        return self.end.out_avals

    def batch(self, shapes: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
        """The axes that inputs of these shapes have beyond those of one lane."""
        for aval, shape in zip(self.in_avals, shapes, strict=True):
            if len(shape) > aval.ndim:
                return shape[: len(shape) - aval.ndim]
        return ()

    @property
    def row_avals(self) -> list[Any]:
        """Of a row."""
        return self.begin.out_avals[len(self.carry_avals) + 2 :]


def spread(program: Program, sources: tuple[bool, ...], *, smooth: bool) -> "Spread":
    """Which parts of a program depend on these inputs; if `smooth`, differentiably."""
    n = len(program.carry_avals)
    carry = [False] * n
    while True:
        begun = reached(program.begin.jaxpr, sources, smooth=smooth)
        stepped = reached(program.step.jaxpr, (*sources, *carry), smooth=smooth)
        grown = [a or b or c for a, b, c in zip(carry, begun[:n], stepped[:n], strict=True)]
        if grown == carry:
            break
        carry = grown
    rest = [a or b for a, b in zip(begun[n:], stepped[n:], strict=True)]
    outs = reached(program.end.jaxpr, (*sources, *carry), smooth=smooth)
    return Spread(tuple(carry), any(rest[:2]), tuple(rest[2:]), tuple(outs))


class Spread(NamedTuple):
    """What depends on something."""

    carry: tuple[bool, ...]
    control: bool
    """How long a lane goes on, or which rows it completes."""
    rows: tuple[bool, ...]
    outs: tuple[bool, ...]


def _dtype(var: Any) -> Any:
    return var.aval.dtype


# What has no derivative although it gives floating-point numbers.
_FLAT = ("stop_gradient", "sign", "round", "floor", "ceil")


def reached(jaxpr: Jaxpr, sources: Sequence[bool], *, smooth: bool) -> list[bool]:
    """Which results may depend on these arguments; if `smooth`, differentiably."""
    found = {v for v, s in zip(jaxpr.invars, sources, strict=True) if s}

    def touched(atom: Any) -> bool:
        return not isinstance(atom, Literal) and atom in found

    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        args = [touched(a) for a in eqn.invars]
        if not any(args) or (smooth and name in _FLAT):
            continue
        outs = [True] * len(eqn.outvars)
        if name in ("jit", "pjit"):
            outs = reached(eqn.params["jaxpr"].jaxpr, args, smooth=smooth)
        elif name == "cond" and (smooth or not args[0]):
            ways = [reached(b.jaxpr, args[1:], smooth=smooth) for b in eqn.params["branches"]]
            outs = [any(way) for way in zip(*ways, strict=True)]
        for var, there in zip(eqn.outvars, outs, strict=True):
            if there and not (smooth and not jnp.issubdtype(_dtype(var), jnp.inexact)):
                found.add(var)
    return [touched(a) for a in jaxpr.outvars]
