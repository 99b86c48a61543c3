"""The parts of a machine that do not move it: its clocks, its quantities, and their names."""

import abc
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from .._checks import fields_with
from .._messages import so_many
from .._types import Number, Scalar, State
from .own import by_default
from .shown import Shown
from .units import PLAIN, unit_in

Machine = TypeVar("Machine", bound=Shown)


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


class Observed(Shown):
    """What is observed of a motion: where a cycle ends, what begins anew with it, means and
    quantities."""

    def at_section(self: Machine, phase: Number) -> Machine:
        """The same machine observed elsewhere in its cycle, for one that can be."""
        raise ValueError(
            f"Argument `section` must be left out for a {type(self).__name__}, which has its own "
            f"section, but got {phase!r}."
        )

    def observed_later(self: Machine, since_section: Number) -> Machine | None:
        """The same machine with its section moved by so much of its clock; `None` for a machine
        whose section cannot be moved."""
        return None

    @by_default
    def renewed(self, state: State) -> State:
        """`state` as the next cycle begins, where something is counted by the cycle: a drift, say,
        is given as the progress in the last cycle and begins again from zero."""
        return state

    @by_default
    def averages(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """`averages(s, state)`: what is averaged over time between events, by name.

        Each is integrated beside the state with the method's own accuracy and divided by the time
        that it took: `Run.averages` of each cycle, `Orbit.averages` and columns of a `Branch` over
        the period. What jumps with an impact is not in it. Its name must be its own, its unit is
        that of the same name in `units`. As the field, it gets the modes of a machine that has
        some; nothing is integrated where no motion is recorded (`record="sections"`)."""
        return {}

    @by_default
    def quantities(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """`quantities(s, state)`: functions of the state, by name, which results tell beside it: on
        sections, in samples, along branches. `s` counts from the section; it is 0 if the state
        holds the clock, and for autonomous machines."""
        return {}

    def mirrored(self, state: State) -> State | None:
        """The image of a state under the symmetry of this machine, for one whose motions have an
        image among them half a cycle later; `None` for one without."""
        return None


class Worded(Shown):
    """The words of a machine: names and units for pictures and messages."""

    @property
    def labels(self) -> tuple[str, str]:
        """What pictures write beside position and velocity, with units."""
        return PLAIN

    @property
    def units(self) -> Mapping[str, str]:
        """The units of its quantities by their names: `position`, `velocity`, `time`, `rate` (of
        what grows in time, as exponents do), `energy`, `power`, and each number and component of a
        state by its own name. "1" is without unit; the name "" stands for all that is not named,
        and what is not stated is shown without. By default those of `labels`, in brackets, and of
        fields."""
        found = zip(("position", "velocity"), map(unit_in, self.labels), strict=True)
        own = {**dict(found), **fields_with(type(self), "unit")}
        return {x: unit for x, unit in own.items() if unit}

    def period_of(self, cycles: int) -> str:
        """A duration of so many cycles, in words."""
        return so_many(cycles, "cycle")

    def place_of(self, since_section: float, cycles: int) -> str:
        """A reading of the clock within a motion of so many cycles, in words."""
        return f"clock {since_section:.6g} after its section (motion of {self.period_of(cycles)})"
