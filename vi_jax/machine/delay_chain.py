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
from .._types import Scalar, State, Vector
from .base import AbstractMachine, cached_in_trace
from .contacts import check_takes
from .declared import overridden, with_static
from .delay import (
    Recorded,
    WithPast,
    as_state,
    delays_in,
    form_of,
    given_past,
    has_delays,
    history_before,
    original,
    recorded_numbers,
    values_of,
)
from .events import history_of, modes_of, with_modes, without_modes
from .state import State as Named

_NAME = "history"


class ChainForm(eqx.Module):
    """The constants of a chain."""

    form: Recorded
    nodes: int = eqx.field(static=True)
    elements: int = eqx.field(static=True)


class _Held(eqx.Module):
    """The past of one instant, as a function of `s`."""

    past: Any

    def __call__(self, s: Scalar) -> Any:
        return self.past


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
    kind = _chain_kind(type(machine))
    chain = ChainForm(form, nodes, elements)
    return with_static(object.__new__(kind), **values_of(machine), _chain=chain, _begin=start)


@functools.lru_cache(maxsize=64)
def _chain_kind(kind: type) -> type:
    def with_past(name: str) -> Callable[..., Any]:
        def function(self: Any, s: Scalar, state: State, *modes: Scalar) -> Any:
            given = s, without_history(state), past_in(self, state), *modes
            call = getattr(original(self), name)
            check_takes(call, f"`{name}`", "`s`, the state, the past", given, len(modes))
            found = call(*given)
            return found if name != "field" else _with_rates(self, found, s, state, modes)

        return function

    def without(name: str) -> Callable[..., Any]:
        return lambda self, s, state, *rest: getattr(original(self), name)(
            s, without_history(state), *rest
        )

    body: dict[str, Any] = {
        "__module__": kind.__module__,
        "__qualname__": kind.__qualname__,
        "__annotations__": {"_chain": Any, "_begin": Any},
        "_chain": eqx.field(default=None, kw_only=True),
        "_begin": eqx.field(default=None, kw_only=True),
        "delays": property(lambda self: {}),
        "field": with_past("field"),
        "start": lambda self: chained(self, self._begin),
        "chained": lambda self, state: chained(self, state),
        "_switches": property(lambda self: _events(self, "_switches")),
        "_others": property(lambda self: _events(self, "_others")),
    }
    blank = object.__new__(kind)
    if overridden(blank, AbstractMachine, "averages"):
        body["averages"] = with_past("averages")
    for name in ("quantities", "step_limit", "relaxation", "pace"):
        if overridden(blank, AbstractMachine, name):
            body[name] = without(name)
    if overridden(blank, AbstractMachine, "mirrored"):
        body["mirrored"] = lambda self, state: None
    return type(kind)(kind.__name__, (kind,), body)


class _WithChain(WithPast):
    def __call__(self, machine: Any, s: Scalar, state: State, *modes: Scalar) -> Any:
        given = original(machine), s, without_history(state), past_in(machine, state), *modes
        found = self.call(given)
        return vars(found) if isinstance(found, Named) else found


def _events(machine: Any, name: str) -> tuple[Any, ...]:
    return tuple(given_past(x, _WithChain) for x in getattr(original(machine), name))


def without_history(state: Any) -> Any:
    """Return the machine's own part of a state of a chain."""
    return Named(**{name: x for name, x in vars(state).items() if name != _NAME})


def _with_rates(machine: Any, flow: Any, s: Scalar, state: Any, modes: Any) -> Any:
    """Return the rate of a state of a chain: `flow`, and that of its history by the transport
    equation."""
    chain, h = machine._chain, state.history
    held = with_static(machine, _past=_Held(past_in(machine, state)))
    now = recorded_numbers(held, chain.form, s, without_history(state), modes)
    p, length = chain.nodes, _longest(machine) / chain.elements
    ends = [now, *(h[p * (e + 1) - 1] for e in range(chain.elements - 1))]
    rates = []
    for e, first in enumerate(ends):
        nodes = jnp.concatenate([first[None], h[p * e : p * (e + 1)]])
        rates.append(_differences(p)[1:] @ nodes * (2 / length))
    flow = dict(flow) if isinstance(flow, Mapping) else vars(flow)
    return flow | {_NAME: jnp.concatenate(rates)}


def _longest(machine: Any) -> Any:
    return functools.reduce(jnp.maximum, map(jnp.asarray, delays_in(original(machine)).values()))


@functools.lru_cache(maxsize=16)
def _differences(p: int) -> Array:
    """Return the matrix that maps values at Chebyshev nodes, from 1 to -1, to derivatives there."""
    x = _nodes(p)
    c = np.r_[2, np.ones(p - 1), 2] * (-1.0) ** np.arange(p + 1)
    away = x[:, None] - x[None, :] + np.eye(p + 1)
    matrix = np.outer(c, 1 / c) / away
    return matrix - np.diag(matrix.sum(axis=1))


def _nodes(p: int) -> np.ndarray:
    return np.cos(np.pi * np.arange(p + 1) / p)


@cached_in_trace
def _lags(machine: Any) -> list[Any]:
    return [jnp.asarray(x) for x in delays_in(original(machine)).values()]


def past_in(machine: Any, state: Any) -> Any:
    """Return the past in a state of a chain. In the first element the newest value, that of now, is
    left out, since it may depend on the past."""
    chain, h = machine._chain, state.history
    lags, longest = _lags(machine), _longest(machine)
    if len(lags) == 1:
        return chain.form.by_name([h[-1]])
    return chain.form.by_name([_between(chain, h, lag / longest) for lag in lags])


def _between(chain: ChainForm, h: Array, share: Scalar) -> Vector:
    """Return the history at a share of the longest delay."""
    p, number = chain.nodes, chain.elements
    place, found = share * number, h[-1]
    for e in reversed(range(number)):
        values, x = h[p * e : p * (e + 1)], _nodes(p)[1:]
        if e:
            values, x = jnp.concatenate([h[p * e - 1][None], values]), _nodes(p)
        value = _lagrange(x, 1 - 2 * (place - e)) @ values
        found = value if e == number - 1 else jnp.where(place < e + 1, value, found)
    return found


def _lagrange(x: np.ndarray, at: Scalar) -> Vector:
    """Return the weights of values at nodes in the polynomial through them, at a place."""
    away = at - jnp.asarray(x)
    weights = []
    for j in range(len(x)):
        others = np.delete(np.arange(len(x)), j)
        weights.append(jnp.prod(away[others] / (x[j] - x[others])))
    return jnp.stack(weights)


def chained(machine: Any, state: Any) -> Any:
    """Return a state of a chain from one of its machine, with `before` or with a history."""
    chain, modes, history = machine._chain, modes_of(state), history_of(state)
    state = as_state(without_modes(state), "Argument `state`")
    if _NAME in vars(state):
        return with_modes(state, modes)
    longest, p, number = _longest(machine), chain.nodes, chain.elements
    places = [(e + (1 - x) / 2) / number for e in range(number) for x in _nodes(p)[1:]]
    times = -longest * jnp.asarray(places)
    if history is None:
        before = history_before(original(machine), state)
        values = jax.vmap(lambda t: chain.form.pack(before(t)))(times)
    else:
        values = jax.vmap(history.at)(times)
    return with_modes(Named(**vars(state), **{_NAME: values}), modes)
