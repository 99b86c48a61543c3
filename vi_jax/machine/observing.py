"""What is observed of a machine, cycle by cycle."""

from typing import Any, TypeVar

from .._types import Number, State
from .own import by_default
from .shown import Shown

Machine = TypeVar("Machine", bound="Observed")


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
        sections, in samples, along branches. `s` counts from the section; it is 0 where the state
        has a clock of its own and for autonomous machines."""
        return {}

    def mirrored(self, state: State) -> State | None:
        """The image of a state under the symmetry of this machine, for one whose motions have an
        image among them half a cycle later; `None` for one without."""
        return None
