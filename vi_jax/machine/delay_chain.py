"""A machine without delays whose state holds the history of one with delays."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import count
from .._programs import compiled
from .._types import Scalar, State, Vector
from .base import AbstractMachine
from .contacts import shown_modes
from .delay import (
    Past,
    as_state,
    form_of,
    has_delays,
    history_before,
    lags_of,
    longest_delay,
    reading,
    recorded_numbers,
    without_past,
)
from .events import begin_modes
from .modes import history_of, modes_of, with_modes, without_modes
from .overrides import overridden
from .state import State as Named

_NAME = "history"


def delay_chain(
    machine: AbstractMachine, nodes: int = 16, *, elements: int = 1, start: State = None
) -> Any:
    """Return a machine without delays whose state holds the history of one with delays.

    The history over the longest delay is a component `history` of the state: values at Chebyshev
    nodes, which obey the transport equation ∂h/∂t = ∂h/∂θ. It is an ordinary machine with the same
    parameters, so that orbits, branches and boundaries can be found. Its error decreases
    exponentially with `nodes` if the history is smooth. An impact leaves a kink in the history,
    so that the error decreases more slowly: with 16 nodes it is some 1e-5, with 8 in each of 8
    `elements` 1e-7.

    **Arguments:**

    - `machine`: a machine with `delays`, whose state is a `State` or that of a `Mechanical`.
    - `nodes`: the degree of the polynomial in each element.
    - `elements`: the number of polynomials over the longest delay.
    - `start`: the start of the chain, by default `machine.start()`.

    **Returns:** a machine. Its `chained(state)` returns a state of the chain from one of `machine`:
    with its `before`, or with the history of a `Run.last`.

    **Raises:** `ValueError` or `TypeError` for a machine without delays, or another form of state.
    """
    if not has_delays(machine):
        raise ValueError(
            f"Argument `machine` must have `delays`, but a {type(machine).__name__} has none."
        )
    nodes, elements = count("nodes", nodes, least=3), count("elements", elements, least=1)
    start = machine.start() if start is None else start
    if not isinstance(start, Named) or _NAME in vars(start):
        raise TypeError(
            f"Argument `machine` must have a `vi_jax.State` without a component {_NAME!r} as its "
            f"state, but has {start!r}."
        )
    form = form_of(machine, as_state(start, "`start`"), history_before(machine, start))
    return reading(machine, _Chain(form, nodes, elements, start))


class _Chain(Past):
    """The past in a state with values at nodes of the longest delay, and the chain's start."""

    nodes: int = eqx.field(static=True)
    elements: int = eqx.field(static=True)
    start: State

    def own(self, state: Any) -> Any:
        return Named(**{name: x for name, x in vars(state).items() if name != _NAME})

    def __call__(self, machine: Any, s: Scalar, state: Any) -> Any:
        # In the first element the value of now is left out, since it may depend on the past.
        h, lags = state.history, lags_of(machine)
        shares = [lag / longest_delay(machine) for lag in lags] if len(lags) > 1 else []
        return self.form.by_name([self.at(h, x) for x in shares] or [h[-1]])

    def at(self, h: Array, share: Scalar, now: Vector | None = None) -> Vector:
        """Return the history at a share of the longest delay."""
        p, place = self.nodes, share * self.elements
        x = _nodes(p) if now is not None else _nodes(p)[1:]
        values = h[:p] if now is None else jnp.concatenate([now[None], h[:p]])
        found = _lagrange(x, 1 - 2 * place) @ values
        for e in range(1, self.elements):
            value = _lagrange(_nodes(p), 1 - 2 * (place - e)) @ h[p * e - 1 : p * (e + 1)]
            found = jnp.where(place < e, found, value)
        return found

    def rates(self, machine: Any, flow: Any, s: Scalar, state: Any, modes: Any) -> Any:
        p, h, found = self.nodes, state.history, []
        scale = 2 * self.elements / longest_delay(machine)
        first = recorded_numbers(machine, s, state, modes)
        for end in range(p, len(h) + 1, p):
            values = jnp.concatenate([first[None], h[end - p : end]])
            found.append(_differences(p)[1:] @ values * scale)
            first = h[end - 1]
        flow = dict(flow) if isinstance(flow, Mapping) else vars(flow)
        return flow | {_NAME: jnp.concatenate(found)}

    @staticmethod
    def members(kind: type) -> dict[str, Any]:
        def without(name: str) -> Callable[..., Any]:
            return lambda self, s, state, *rest: getattr(without_past(self), name)(
                s, self._past.own(state), *rest
            )

        body: dict[str, Any] = {
            "delays": property(lambda self: {}),
            "start": lambda self: self.chained(self._past.start),
            "chained": _chained,
        }
        blank = object.__new__(kind)
        for name in ("quantities", "step_limit", "relaxation", "pace"):
            if overridden(blank, AbstractMachine, name):
                body[name] = without(name)
        if overridden(blank, AbstractMachine, "mirrored"):
            body["mirrored"] = lambda self, state: None
        return body


def _chained(self: Any, state: Any) -> Any:
    """Return a state of a chain from one of its machine, with `before` or with a history."""
    chain, machine, modes = self._past, without_past(self), modes_of(state)
    history, state = history_of(state), as_state(without_modes(state), "Argument `state`")
    if _NAME in vars(state):
        return with_modes(state, modes)
    shares = [e + (1 - x) / 2 for e in range(chain.elements) for x in _nodes(chain.nodes)[1:]]
    times = -longest_delay(self) * np.array(shares) / chain.elements
    if history is None:
        before = history_before(machine, state)
        values = jax.vmap(lambda t: chain.form.pack(before(t)))(times)
    else:
        values = _numbers_at(history, times)
    return with_modes(Named(**vars(state), **{_NAME: values}), modes)


@compiled
def _numbers_at(history: Any, times: Any) -> Array:
    return jax.vmap(history.at)(times)


def machine_of_chain(machine: Any) -> Any:
    """Return the machine with delays of a chain, or `None` for another machine."""
    return without_past(machine) if isinstance(getattr(machine, "_past", None), _Chain) else None


def without_history(machine: Any, state: Any) -> Any:
    """Return a state of a chain without its history; of another machine unchanged."""
    return state if machine_of_chain(machine) is None else machine._past.own(state)


def check_history(name: str, machine: Any, state: Any) -> None:
    """**Raises:** `TypeError` if a state of a chain, the argument `name`, lacks its history."""
    if machine_of_chain(machine) is None:
        return
    chain = machine._past
    wanted = chain.nodes * chain.elements, chain.form.size
    found = vars(state).get(_NAME) if isinstance(state, Named) else None
    if found is None or jnp.shape(found)[-2:] != wanted:
        got = "has none" if found is None else f"has one of shape {jnp.shape(found)}"
        raise TypeError(
            f"Argument `{name}` must have the `history` of a `delay_chain`, of shape {wanted}, but "
            f"{got}. Pass `machine.chained({name})`, a state or the `last` of a run without it."
        )


def history_in(machine: Any, state: Any) -> Callable[[Scalar], Vector]:
    """Return the history in a state of a chain, as a function of t ≤ 0."""
    zero, own, longest = jnp.zeros((), float), without_modes(state), longest_delay(machine)
    modes = shown_modes(machine, begin_modes(machine, zero, own, modes_of(state)))
    now = recorded_numbers(machine, zero, own, modes)
    return lambda t: machine._past.at(own.history, -t / longest, now)


@functools.lru_cache(maxsize=16)
def _differences(p: int) -> np.ndarray:
    """Return the matrix that maps values at Chebyshev nodes, from 1 to -1, to derivatives there."""
    x = _nodes(p)
    c = np.r_[2, np.ones(p - 1), 2] * (-1.0) ** np.arange(p + 1)
    matrix = np.outer(c, 1 / c) / (x[:, None] - x[None, :] + np.eye(p + 1))
    return matrix - np.diag(matrix.sum(axis=1))


def _nodes(p: int) -> np.ndarray:
    return np.cos(np.pi * np.arange(p + 1) / p)


def _lagrange(x: np.ndarray, at: Scalar) -> Vector:
    """Return the weights of values at nodes in the polynomial through them, at a place."""
    others = [np.delete(np.arange(len(x)), j) for j in range(len(x))]
    return jnp.stack([jnp.prod((at - x[i]) / (x[j] - x[i])) for j, i in enumerate(others)])
