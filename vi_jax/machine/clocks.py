"""What counts the cycles of a machine, and what measures time."""

import abc
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from .._types import Number, Scalar, State
from .shown import Shown

Machine = TypeVar("Machine", bound="Clocked")


class Clocked(Shown):
    """The clocks of a machine: the independent variable `s`, what counts its cycles, and time."""

    if TYPE_CHECKING:  # a subclass has it as an attribute, a property or a field
        cycle: Any = eqx.field(init=False)
    else:

        @property
        @abc.abstractmethod
        def cycle(self) -> Scalar | float:
            """Length of one cycle in `s` (or in `clock(state)`, where that is not `None`); where
            `section` ends a cycle, its usual length, by which steps are sized."""

    def clock(self, state: State) -> Scalar | None:
        """The state component that counts cycles, or `None` where `s` itself does."""
        return None

    def rewound(self, state: State) -> State:
        """`state` with its clock set back by one cycle (only asked where there is a clock)."""
        return state

    def pace(self, s: Scalar, state: State) -> Scalar | None:
        """d(time)/ds where it varies along the motion, or `None` where `s` measures time."""
        return None

    @property
    def period(self) -> Scalar | float:
        """Duration of a cycle, where it is fixed."""
        return self.cycle

    def in_clock(self: Machine, clock: str) -> Machine:
        """The same machine with another independent variable, for one that has several."""
        raise ValueError(
            f"Argument `clock` must be left out for a {type(self).__name__}, which has its own "
            f"clock, but got {clock!r}."
        )

    def in_cycle_clock(self: Machine) -> Machine:
        """The same machine with what counts its cycles as its independent variable."""
        return self

    def in_cycle_state(self, name: str, state: State) -> State:
        """A state on the section, made for any clock of this machine, as the machine of
        `in_cycle_clock` needs it; `name` is the argument that messages blame."""
        return state

    def phase_at(self, since_section: Number) -> Any:
        """What the clock shows when it has counted so much since the section: a crank angle may
        begin elsewhere than at 0."""
        return since_section

    @property
    def turn(self) -> Scalar | float:
        """The length of a cycle as an impact log counts it."""
        return self.cycle

    def as_logged(self, clock: Float[Array, "..."]) -> Float[Array, "..."]:
        """What an impact log says for a reading of what counts the cycles; by default the reading
        itself."""
        return clock

    @property
    def scales_known(self) -> bool:
        """Whether the usual number of fixed steps in a cycle is known to be enough; static."""
        return False

    def relaxation(self, s: Scalar, state: State) -> Scalar | None:
        """The shortest time constant (in `s`) with which something fades, `None` if nothing does.

        Explicit Runge–Kutta methods are unstable with steps much longer than this.
        """
        return None
