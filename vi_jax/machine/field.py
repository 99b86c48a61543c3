"""The field of a machine in its modes, with the forces of its contacts."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._types import Machine, Scalar, Scalars, State
from .state import like


def events_of_modes(machine: Machine) -> list[Any]:
    """The events that hold a mode, in the order of the modes."""
    return [x for x in (*machine.stops, *machine.switches, *machine.others) if x.holds_mode]


def shown_modes(machine: Machine, modes: Scalars) -> Scalars:
    """Those of a machine's modes that its own functions get: all but those of contacts that act by
    themselves."""
    if not any(x.acts for x in machine.switches):
        return tuple(modes)
    hides = [getattr(x, "acts", False) for x in events_of_modes(machine)]
    hides += [False] * (len(modes) - len(hides))
    return tuple(mode for mode, hide in zip(modes, hides, strict=True) if not hide)


def all_modes(machine: Machine, shown: Any, modes: Scalars) -> Scalars:
    """The machine's modes with others in the place of those that its own functions get."""
    hides = [getattr(x, "acts", False) for x in events_of_modes(machine)]
    left = iter(shown)
    hides += [False] * (len(modes) - len(hides))
    return tuple(m if hide else next(left) for m, hide in zip(modes, hides, strict=True))


def acting(machine: Machine, s: Scalar, state: State, modes: Scalars) -> State:
    """What the machine's field says in these modes, and the forces of soft stops and of friction
    against which something slides."""
    flow = machine.field(s, state, *shown_modes(machine, modes))
    flow = like(state, flow, f"`field` of a {type(machine).__name__}")
    held = events_of_modes(machine)
    for switch, mode in zip(held, modes, strict=False):
        if getattr(switch, "acts", False):
            flow = switch.pushed(machine, s, state, mode, flow)
    return flow


def field_in(machine: Any, s: Scalar, state: State, modes: Scalars, first: int = 0) -> State:
    """The machine's field in these modes; on the surfaces along which it slides, the mean of those
    on both sides.

    **Arguments:** switches before number `first` are in mode +1 or -1.
    """
    switches = machine.switches
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
