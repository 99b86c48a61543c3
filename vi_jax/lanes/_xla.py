"""XLA's backend: the same loop for any device and any primitive.

Lanes of a batch advance together. Where they are many, a few slots take up lane after lane, so
that one of ten times the steps delays no other and what advances fits the processor's cache.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import jaxpr_as_fun

from ._program import LaneProgram

# Lanes that advance together on a CPU, where their numbers then stay in its cache; an accelerator
# takes all of them.
_SLOTS = 256


def run(program: LaneProgram, *args: Any) -> list[Any]:
    """Results and rows of a batch of lanes: what the primitive gives.

    **Arguments:** the program; its inputs, each with the axes of the batch before its own, or
    without them where all lanes share it.
    """
    batch = program.batch([x.shape for x in args])
    lanes = math.prod(batch)
    if lanes == 0:
        avals = [(a, a.shape) for a in program.out_avals]
        avals += [(a, (program.rows, *a.shape)) for a in program.row_avals]
        return [jnp.zeros((*batch, *shape), a.dtype) for a, shape in avals]
    slots = min(lanes, _SLOTS if jax.default_backend() == "cpu" else lanes)
    shared = [bool(batch) and x.ndim == a.ndim for x, a in zip(args, program.in_avals, strict=True)]
    flat = [
        x if s else x.reshape(lanes, *a.shape)
        for x, a, s in zip(args, program.in_avals, shared, strict=True)
    ]
    out = _Pool(program, flat, shared, lanes, slots).run()
    return [x.reshape(*batch, *x.shape[1:]) for x in out]


class _Pool:
    """The lanes of a batch in a number of slots; every method is traced once."""

    def __init__(
        self, program: LaneProgram, args: list, shared: list[bool], lanes: int, slots: int
    ):
        self.program, self.args, self.shared = program, args, shared
        self.lanes, self.slots = lanes, slots
        self.n = len(program.carry_avals)
        axes = [None if s else 0 for s in shared]
        self.begin = jax.vmap(jaxpr_as_fun(program.begin), in_axes=axes, axis_size=slots)
        self.step = jax.vmap(self._block, in_axes=(axes, 0, 0))
        self.end = jax.vmap(jaxpr_as_fun(program.end), in_axes=(*axes, *(0 for _ in range(self.n))))

    def _block(self, inputs, carry, active):
        """So many steps that a lane completes at most one row."""
        n, step = self.n, jaxpr_as_fun(self.program.step)

        def one(_, state):
            carry, active, complete, row = state
            out = step(*inputs, *carry)
            # A lane that has ended keeps what it had.
            carry = [jnp.where(active, a, b) for a, b in zip(out[:n], carry, strict=True)]
            here = active & out[n + 1]
            row = [jnp.where(here, a, b) for a, b in zip(out[n + 2 :], row, strict=True)]
            return carry, active & out[n], complete | here, row

        row = [jnp.zeros(a.shape, a.dtype) for a in self.program.row_avals]
        start = (list(carry), active, jnp.zeros((), bool), row)
        return jax.lax.fori_loop(0, self.program.block, one, start)

    def run(self) -> list[Any]:
        """Results and rows of all lanes, with one leading axis."""
        program, lanes = self.program, self.lanes
        store = [
            jnp.full((lanes, program.rows, *a.shape), _empty(a.dtype), a.dtype)
            for a in program.row_avals
        ]
        outs = [jnp.zeros((lanes, *a.shape), a.dtype) for a in program.out_avals]
        index = jnp.arange(self.slots, dtype=jnp.int32)
        inputs = self._inputs_of(index)
        carry, active, complete, row = self._begun(inputs)
        filled = jnp.zeros_like(index)
        store = self._stored(store, index, complete, filled, row)
        filled = filled + complete
        following = jnp.asarray(self.slots, jnp.int32)
        state = self._refilled(inputs, carry, active, index, filled, following, outs, store)
        # A lane may end where it begins, and so may the one that takes its place.
        going = lambda state: jnp.any(state[3] < lanes)
        *_, outs, store = jax.lax.while_loop(going, self._iteration, state)
        return [*outs, *store]

    def _inputs_of(self, index):
        at = jnp.minimum(index, self.lanes - 1)
        return [x if s else x[at] for x, s in zip(self.args, self.shared, strict=True)]

    def _begun(self, inputs):
        out = self.begin(*inputs)
        return list(out[: self.n]), out[self.n], out[self.n + 1], out[self.n + 2 :]

    def _stored(self, store, index, complete, filled, row):
        fits = complete & (filled < self.program.rows)
        at = jnp.where(fits, index, self.lanes)
        return [s.at[at, filled].set(x, mode="drop") for s, x in zip(store, row, strict=True)]

    def _iteration(self, state):
        inputs, carry, active, index, filled, following, outs, store = state
        carry, active, complete, row = self.step(inputs, carry, active)
        store = jax.lax.cond(
            jnp.any(complete & (filled < self.program.rows)),
            lambda store: self._stored(store, index, complete, filled, row),
            lambda store: store,
            store,
        )
        filled = filled + complete
        return self._refilled(inputs, carry, active, index, filled, following, outs, store)

    def _refilled(self, *state):
        """The state, with new lanes where some have ended and their results stored."""
        active, index = state[2:4]
        over = ~active & (index < self.lanes)
        return jax.lax.cond(jnp.any(over), self._replaced, lambda _, *same: same, over, *state)

    def _replaced(self, over, inputs, carry, active, index, filled, following, outs, store):
        at = jnp.where(over, index, self.lanes)
        found = self.end(*inputs, *carry)
        outs = [o.at[at].set(x, mode="drop") for o, x in zip(outs, found, strict=True)]
        coming = following + jnp.cumsum(over, dtype=index.dtype) - 1
        index = jnp.where(over, jnp.minimum(coming, self.lanes), index)
        following = following + jnp.sum(over, dtype=index.dtype)
        if self.slots == self.lanes:  # no lane is waiting
            return inputs, carry, active, index, filled, following, outs, store
        new = over & (index < self.lanes)
        inputs = [
            a if s else _where(new, a, b)
            for a, b, s in zip(self._inputs_of(index), inputs, self.shared, strict=True)
        ]
        begun, going, complete, row = self._begun(inputs)
        carry = [_where(new, a, b) for a, b in zip(begun, carry, strict=True)]
        complete = complete & new
        filled = jnp.where(new, 0, filled)
        store = self._stored(store, index, complete, filled, row)
        active = jnp.where(new, going, active)
        return inputs, carry, active, index, filled + complete, following, outs, store


def _empty(dtype):
    return jnp.nan if jnp.issubdtype(dtype, jnp.inexact) else 0


def _where(flag, a, b):
    return jnp.where(flag.reshape(flag.shape + (1,) * (a.ndim - 1)), a, b)
