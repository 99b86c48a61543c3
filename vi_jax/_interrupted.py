"""What is raised where work is interrupted of which a part is done."""

from typing import Any


class Interrupted(KeyboardInterrupt):
    """Raised by a verb on Ctrl-C once there is something to keep: what was computed is not lost.

    Before that it is a plain `KeyboardInterrupt`.
    """

    partial: Any
    """What was computed: of `sweep` a `Sweep` of the values that were done, of `continue_orbit` a
    `Branch` and of `boundary` a `Boundary` that end where they were interrupted, of `scan` and
    `basins` the data set."""

    def __init__(self, what: str, partial: Any, where: str = "what was computed is in `.partial`"):
        super().__init__(f"the {what} was interrupted; {where}")
        self.partial = partial
