"""What is raised where work is interrupted of which a part is done."""

from typing import Any


class Interrupted(KeyboardInterrupt):
    """Raised by a verb on Ctrl-C once there is something to keep: what was computed is not lost.

    Before that it is a plain `KeyboardInterrupt`.
    """

    partial: Any
    """What was computed, of the kind that the verb returns: a `Sweep` of the values that were done,
    a `Branch`, a `Boundary` or a `Manifold` that ends where it was interrupted, the `Lyapunov`
    exponents of the cycles that were observed, an `EdgeState` without its orbit, the `MinimalKick`
    found so far, an `AllOrbits` of the periods that were
    searched, a `Grazing` that the machine was not asked about; of `scan`, `basins` and
    `integrity_profile` the data set."""

    def __init__(
        self, what: str, partial: object, where: str = "what was computed is in `.partial`"
    ):
        super().__init__(f"the {what} was interrupted; {where}")
        self.partial = partial
