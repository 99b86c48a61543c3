"""What `simulate` asks of a scene. A class of your own with these few methods runs like ours."""

import abc
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Bool, Float

from .._checks import in_range
from .stop import RigidStop

State = Any
"""A pytree of scalars; the defaults below expect the fields `Y` and `V`."""


class AbstractScene(eqx.Module):
    """A mechanical system with one impacting coordinate, observed cycle by cycle.

    Its independent variable is called `s`; `s` restarts from zero in each cycle, and the field is
    periodic in it.

    To write a scene of your own, give it `stops`, `cycle` and `field`, and `start` if there is a
    state to begin from where none is given. The other methods have defaults that suit a state with
    the fields `Y` and `V` whose independent variable is time; a state with other names says by
    `position`, `velocity` and `placed` which of them the stops limit. Ready machines, each written
    in this way, are in `vi_jax.machines`.
    """

    stops: eqx.AbstractVar[tuple[RigidStop, ...]]

    @property
    @abc.abstractmethod
    def cycle(self) -> Float[Array, ""] | float:
        """Length of one cycle in `s` (or in `clock(state)`, where that is not `None`)."""

    @abc.abstractmethod
    def field(self, s: Float[Array, ""], state: State) -> State:
        """d(state)/ds between impacts, a pytree like `state`."""

    def position(self, state: State) -> Float[Array, ""]:
        """The coordinate that stops limit."""
        return state.Y

    def velocity(self, state: State) -> Float[Array, ""]:
        """The velocity that an impact reverses; of the sign of d(position)/ds."""
        return state.V

    def placed(self, state: State, Y: Float[Array, ""], V: Float[Array, ""]) -> State:
        """`state` with this position and velocity: how a landing and a rebound are applied."""
        return eqx.tree_at(lambda x: (x.Y, x.V), state, (Y, V))

    def clock(self, state: State) -> Float[Array, ""] | None:
        """The state component that counts cycles, or `None` where `s` itself does."""
        return None

    def start(self) -> State:
        """The state to begin from where none is given.

        **Raises:** `ValueError` where this scene has none.
        """
        raise ValueError("Argument `start` must be given for a scene of your own.")

    def adopt(self, start: Any) -> State:
        """A start as this scene needs it. **Raises:** `TypeError` if it is none."""
        return start

    def in_clock(self, clock: str) -> "AbstractScene":
        """The same scene with another independent variable, for one that has several."""
        raise ValueError(
            "Argument `clock` must be left out for a scene of your own, which has its own clock, "
            f"but got {clock!r}."
        )

    def at_section(self, phase: Any) -> "AbstractScene":
        """The same scene observed elsewhere in its cycle, for one that can be."""
        raise ValueError(
            "Argument `section` must be left out for a scene of your own, which has its own "
            f"section, but got {phase!r}."
        )

    def phase_at(self, since_section: Any) -> Any:
        """What the clock reads, from what it counted since the section."""
        return since_section

    def mirrored(self, state: State) -> State | None:
        """The image of a state under the symmetry of this scene, for one whose motions have an
        image among them half a cycle later; `None` for one without."""
        return None

    def period_of(self, cycles: int) -> str:
        """A duration of so many cycles, in words."""
        return f"{cycles} cycle{'' if cycles == 1 else 's'}"

    def place_of(self, since_section: float, cycles: int) -> str:
        """A reading of the clock within a motion of so many cycles, in words."""
        return f"clock {since_section:.6g} of its {self.period_of(cycles)}"

    @property
    def labels(self) -> tuple[str, str]:
        """What pictures write beside position and velocity, with units."""
        return "position", "velocity"

    @property
    def turn(self) -> Float[Array, ""] | float:
        """What an impact log counts in one cycle."""
        return self.cycle

    def told(self, clock: Float[Array, "..."]) -> Float[Array, "..."]:
        """A reading of what counts the cycles, as the impact log tells it; by default itself."""
        return clock

    def rewound(self, state: State) -> State:
        """`state` with its clock set back by one cycle (only asked where there is a clock)."""
        return state

    def pace(self, s: Float[Array, ""], state: State) -> Float[Array, ""] | None:
        """d(time)/ds where it varies along the motion, or `None` where `s` measures time."""
        return None

    @property
    def period(self) -> Float[Array, ""] | float:
        """Duration of a cycle, where it is fixed."""
        return self.cycle

    def frequency_ratio(self, duration: Float[Array, "..."]) -> Float[Array, "..."] | None:
        """Mean drive speed over cycles of these durations, or `None` where nothing is driven."""
        return None

    def step_limit(self, s: Float[Array, ""], state: State) -> Float[Array, ""] | float:
        """The longest step that holds at most one extremum of the motion; at most `cycle`/5."""
        return self.cycle / 5

    def relaxation(self, s: Float[Array, ""], state: State) -> Float[Array, ""] | None:
        """The shortest time constant (in `s`) with which something fades, `None` if nothing does.

        Explicit Runge–Kutta methods are unstable with steps much longer than this.
        """
        return None

    def may_rest(self) -> bool:
        """Whether the body can come to rest on a stop, as far as is known; static."""
        return bool(self.stops)

    def alive(self, state: State) -> jax.Array | None:
        """False where the clock of this scene breaks down; `None` where it cannot."""
        return None

    def in_range(self, start: State) -> Bool[Array, ""]:
        """Whether the numbers of this scene, traced ones too, are such that it can be run from
        `start`; asked once, when a lane begins. By default what its parts say (`ranges`)."""
        return in_range(self)

    def check_start(self, start: State) -> None:
        """Raise a `ValueError` if the concrete `start` cannot be simulated (stops apart)."""
        return None
