"""What lanes run: a loop of one lane's numbers, traced once."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal


class LaneProgram(eqx.Module):
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

    base: "LaneProgram | None" = eqx.field(static=True, default=None)
    """Of a program of values and derivatives that of the values alone, whose inputs come first."""

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

    def values_without(
        self, gone: Sequence[bool], shapes: Sequence[tuple[int, ...]]
    ) -> "tuple[LaneProgram, list[bool]] | None":
        """The program of what is known without some of the tangents, and which results and rows
        of this one it gives, in their order; `None` if there is none.

        **Arguments:** which inputs are missing, and the shapes of all.
        """
        found, base = [True] * (len(self.out_avals) + len(self.row_avals)), self.base
        program, batch = self, self.batch(shapes)
        while base is not None and any(gone[: len(program.in_avals)]):
            outs, rows = len(base.out_avals), len(base.row_avals)
            skipped = len(program.out_avals) - outs, len(program.row_avals) - rows
            own = [True] * outs + [False] * skipped[0] + [True] * rows + [False] * skipped[1]
            left = iter(own)
            found = [f and next(left) for f in found]
            program, base = base, base.base
        number = len(program.in_avals)
        alike = program.batch(shapes[:number]) == batch
        return (program, found) if alike and not any(gone[:number]) else None

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


def spread(program: LaneProgram, sources: tuple[bool, ...], *, smooth: bool) -> "Spread":
    """Which parts of a program depend on these inputs; if `smooth`, differentiably."""
    n = len(program.carry_avals)
    begun = reached(program.begin.jaxpr, sources, smooth=smooth)
    step = program.step.jaxpr
    stepped = _settled(lambda c: reached(step, [*sources, *c], smooth=smooth), begun[:n])
    carry = stepped[:n]
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


# Calls whose body stands for them, and the parameter that holds it.
CALLS = {
    "jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "remat": "jaxpr",
    "checkpoint": "jaxpr", "remat2": "jaxpr", "custom_lin": "jaxpr",
}  # fmt: skip


# Of these, what has a derivative of its own, of which its body says nothing.
RULED = ("custom_jvp_call", "custom_vjp_call", "custom_lin")


def inner(jaxpr: ClosedJaxpr | Jaxpr) -> Jaxpr:
    """Without what it closes over."""
    return jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr


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
        args = [touched(a) for a in eqn.invars]
        if not any(args) or (smooth and eqn.primitive.name in _FLAT):
            continue
        for var, there in zip(eqn.outvars, _through(eqn, args, smooth=smooth), strict=True):
            if there and not (smooth and not jnp.issubdtype(_dtype(var), jnp.inexact)):
                found.add(var)
    return [touched(a) for a in jaxpr.outvars]


def _through(eqn: Any, args: list[bool], *, smooth: bool) -> list[bool]:
    """Which results of an equation depend on these of its arguments."""
    name, params = eqn.primitive.name, eqn.params
    if name in CALLS and not (smooth and name in RULED):
        return reached(inner(params[CALLS[name]]), args, smooth=smooth)
    if name == "cond" and (smooth or not args[0]):
        ways = [reached(inner(b), args[1:], smooth=smooth) for b in params["branches"]]
        return [any(way) for way in zip(*ways, strict=True)]
    if name == "scan":
        n, m = params["num_consts"], params["num_carry"]
        fixed, carry, rows = args[:n], args[n : n + m], args[n + m :]
        body = inner(params["jaxpr"])
        return _settled(lambda c: reached(body, [*fixed, *c, *rows], smooth=smooth), carry)
    if name == "while":
        n, m = params["cond_nconsts"], params["body_nconsts"]
        asked, fixed, carry = args[:n], args[n : n + m], args[n + m :]
        body = inner(params["body_jaxpr"])
        outs = _settled(lambda c: reached(body, [*fixed, *c], smooth=smooth), carry)
        ends = reached(inner(params["cond_jaxpr"]), [*asked, *outs], smooth=smooth)
        return [True] * len(outs) if any(ends) else outs
    return [True] * len(eqn.outvars)


def _settled(turn: Callable[[list[bool]], list[bool]], carry: list[bool]) -> list[bool]:
    """What a loop's turn gives, carry first, once no more of the carry is reached."""
    while True:
        outs = turn(carry)
        grown = [a or b for a, b in zip(carry, outs, strict=False)]
        if grown == carry:
            return [*carry, *outs[len(carry) :]]
        carry = grown
