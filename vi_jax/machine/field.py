"""The field of a machine in its modes, with the forces of its contacts."""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._types import Machine, Scalar, Scalars, State
from .contacts import added
from .own import switches_of
from .state import like


def shown_modes(machine: Machine, modes: Scalars) -> Scalars:
    """The modes that a machine's own functions get: all but those of contacts that act by
    themselves. The modes of switches come first, in their order."""
    hidden = {i for i, x in enumerate(switches_of(machine)) if x.acts}
    return tuple(mode for i, mode in enumerate(modes) if i not in hidden)


def check_takes(
    function: Callable[..., Any], whose: str, first: str, arguments: tuple[Any, ...], modes: int
) -> None:
    """**Raises:** `TypeError` for a function of a user's that does not take these arguments.

    **Arguments:** `whose`, the function in words; `first`, the arguments before the modes in words;
    how many of them are modes.
    """
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError as error:
        more = f" and {modes} modes (of switches, then the machine's own)" if modes else ""
        raise TypeError(f"{whose} must take {first}{more}: {error}.") from None
    except ValueError:
        pass  # it has no signature


def called(function: Callable[..., Any], whose: str, *arguments: Any) -> Any:
    """Return what a function of a machine's event returns.

    **Raises:** `TypeError` that names the function, `whose`, if it takes other arguments.
    """
    try:
        return function(*arguments)
    except TypeError:
        check_takes(function, whose, "the machine, `s`, the state", arguments, len(arguments) - 3)
        raise


def acting(machine: Machine, s: Scalar, state: State, modes: Scalars) -> State:
    """The machine's field in these modes, with the forces of soft stops and of friction on bodies
    that slide."""
    flow = machine.field(s, state, *shown_modes(machine, modes))
    flow = like(state, flow, f"`field` of a {type(machine).__name__}")
    pace = machine.pace(s, state)
    for switch, mode in zip(switches_of(machine), modes, strict=False):
        pushed = switch.push_in(machine, s, state, mode) if switch.acts else None
        if pushed is not None:
            amount, push = pushed
            flow = added(flow, (amount if pace is None else amount * pace,), (push,))
    return flow


def field_in(machine: Any, s: Scalar, state: State, modes: Scalars, first: int = 0) -> State:
    """The machine's field in these modes; on the surfaces along which it slides, the mean of those
    on both sides.

    **Arguments:** switches before number `first` are in mode +1 or -1.
    """
    switches = switches_of(machine)
    found = [i for i, x in enumerate(switches) if x.blends and i >= first]
    if not found:
        return acting(machine, s, state, modes)
    i = found[0]
    up, down = (
        field_in(
            machine, s, state, (*modes[:i], jnp.full_like(modes[i], m), *modes[i + 1 :]), i + 1
        )
        for m in (1.0, -1.0)
    )
    rises, falls = (rate_of(switches[i], machine, s, state, x) for x in (up, down))
    apart = falls - rises
    share = jnp.where(modes[i] == 0, falls / jnp.where(apart == 0, 1.0, apart), modes[i] > 0)
    # Not kept within [0, 1]: a step ends where it leaves that, and sees a smooth field till then.
    return jtu.tree_map(lambda a, b: b + share * (a - b), up, down)


def rate_of(switch: Any, machine: Machine, s: Scalar, state: State, flow: State) -> Scalar:
    """d/ds of a switch's function along a flow.

    **Arguments:** `flow`, d(state)/ds.
    """
    along = (s, state), (jnp.ones_like(s), flow)
    return jax.jvp(lambda s, state: switch.function(machine, s, state), *along)[1]
