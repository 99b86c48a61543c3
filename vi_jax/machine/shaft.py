"""What machines share whose cycle is a turn of a shaft."""

import dataclasses
from math import pi
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from .._checks import concrete, one_of, state_of_numbers
from .._types import Scalar, State
from .base import AbstractMachine

Machine = TypeVar("Machine", bound="ShaftMachine")

# A state that was carried to the section lies on it to rounding, in single precision too, where
# that of a turn is 5e-7.
_ON_SECTION = 1e-5


class ShaftMachine(AbstractMachine):
    """A machine driven by a shaft that turns once in a cycle.

    Its clock is `"phase"`, with the angle of the shaft as the independent variable, or `"time"`. A
    shaft whose speed W is part of the state must turn forward in the phase clock; by time it need
    not, and its angle is a component `phase` of the state.
    """

    clock_name: eqx.AbstractVar[str]

    def __check_init__(self):
        one_of("clock_name", self.clock_name, ("phase", "time"))

    @property
    def state_type(self) -> type:
        """The class of a state in the phase clock."""
        raise NotImplementedError

    @property
    def timed_states(self) -> dict[type, type]:
        """For each class of states that has the speed of the shaft, that of the same states by
        time, with `phase` as one more component at the end."""
        raise NotImplementedError

    def is_timed(self, state: State) -> bool:
        """Whether the angle of the shaft is part of the state."""
        return type(state) in self.timed_states.values()

    def is_paced(self, state: State) -> bool:
        """Whether time is not the independent variable, but passes by the speed of the shaft in the
        state."""
        return type(state) in self.timed_states

    def in_clock(self: Machine, clock: str) -> Machine:
        """The same machine in the `"phase"` or the `"time"` clock."""
        one_of("clock", clock, ("phase", "time"))
        return dataclasses.replace(self, clock_name=clock)

    def adopt(self, start: State) -> State:
        """A start made for either clock, as this machine's clock needs it."""
        wanted = self.state_type
        if self.clock_name == "time" and wanted in self.timed_states:
            if type(start) is wanted:
                components = vars(start).values()
                return self.timed_states[wanted](*components, jnp.zeros_like(start.Y))
            wanted = self.timed_states[wanted]
        _require_state("start", start, wanted)
        return state_of_numbers("start", start)

    def in_cycle_state(self, name: str, state: State) -> State:
        """A state on the section that was made for the time clock, without the angle of the shaft;
        any other as it is.

        **Raises:** `ValueError` that names the argument if the angle is known and not 0,
        `TypeError` for what is no state of this machine.
        """
        if not self.is_timed(state):
            _require_state(name, state, self.state_type)
            return state
        phase = concrete(state.phase)
        if phase is not None and not (abs(phase) <= _ON_SECTION).all():
            raise ValueError(
                f"Argument `{name}` must lie on the section, where its phase is 0, but has "
                f"{abs(phase).max():g}."
            )
        return self.state_type(*list(vars(state).values())[:-1])

    def _clock(self, state: State) -> Scalar | None:
        return state.phase if self.is_timed(state) else None

    def rewound(self, state: State) -> State:
        """The state with a full turn taken off the angle."""
        return eqx.tree_at(lambda x: x.phase, state, state.phase - 2 * pi)

    def alive(self, state: State) -> jax.Array | None:
        """Whether the shaft turns forward, in the phase clock; `None` in another."""
        return state.W > 0 if self.is_paced(state) else None

    def check_start(self, start: State) -> None:
        """Raise a `ValueError` if the shaft does not turn forward in the phase clock, or is beyond
        its section."""
        if self.is_paced(start):
            speed = concrete(self.section_speed(start))
            if speed is not None and not (speed > 0).all():
                raise ValueError(
                    "Argument `start` must have W > 0 in the phase clock, but has "
                    f'W = {speed.min():g}. Pass `clock="time"` to start from rest.'
                )
        if self.is_timed(start):
            phase = concrete(start.phase)
            if phase is not None and not (phase < 2 * pi).all():
                raise ValueError(
                    "Argument `start` must have its phase, counted from the last section, below "
                    f"2π, but has {phase.max():g}."
                )

    def section_speed(self, state: State) -> Any:
        """W of a state on the section."""
        return state.W


def _require_state(name: str, state: object, wanted: type) -> None:
    """**Raises:** `TypeError` if this argument is no state of the wanted class."""
    if type(state) is wanted:
        return
    parts = [x for x in ("last", "state") if type(getattr(state, x, None)) is wanted]
    hint = f"; take its `{parts[0]}`" if parts else ""
    raise TypeError(
        f"Argument `{name}` must be a `{wanted.__name__}` for this machine (use its "
        f"`start(...)`), but got a `{type(state).__name__}`{hint}."
    )
