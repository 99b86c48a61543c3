"""Rigid stops: the contact law, wherever it is asked for."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._checks import (
    NOT_NEGATIVE,
    POSITIVE,
    REAL,
    SHARE,
    concrete,
    count,
    one_of,
    optional_real,
    real,
    real_or_law,
    require_ranges,
)
from .._types import Machine, Number, Scalar, State
from .contacts import shown_modes
from .event import AbstractEvent, Modes
from .events import modes_after, struck_modes
from .own import by_default, is_own
from .shown import Shown


def _unless_tiny(V: Number) -> Any:
    """A velocity, but 0 where its square is below the smallest number."""
    least = 100 * float(jnp.finfo(jnp.result_type(V)).tiny) ** 0.5
    return jnp.where(jnp.abs(V) > least, V, 0.0)


class Wall(Shown):
    """Where a stop stands, rigid or compliant: at `gap` on its `side`."""

    gap: eqx.AbstractVar[Float[Array, "..."]]

    @property
    def sign(self) -> int:
        """+1 on the right, -1 on the left: the body is inside while sign·Y ≤ gap."""
        return 1 if self.side == "right" else -1  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def place(self) -> Float[Array, "..."]:
        """Position of the stop, sign·gap (unit: that of the gap)."""
        return self.sign * self.gap

    def beyond(self, Y: Number) -> Any:
        """How far a position lies beyond the stop; negative inside."""
        return self.sign * Y - self.gap

    def approach(self, V: Number) -> Any:
        """Speed towards the stop, sign·V; negative for a body that moves away."""
        return self.sign * V

    def mirrors(self, other: "Wall") -> bool:
        """Whether the other is the image of this one, as far as their numbers are known."""
        if type(other) is not type(self) or other.sign == self.sign:
            return False
        image = dataclasses.replace(other, side=self.side)  # pyright: ignore
        if jtu.tree_structure(image) != jtu.tree_structure(self):
            return False
        known = (map(concrete, jtu.tree_leaves(x)) for x in (self, image))
        pairs = zip(*known, strict=True)
        return all(a is None or b is None or np.array_equal(a, b) for a, b in pairs)


class RigidStop(Wall, AbstractEvent):
    """A rigid wall with Newton's restitution law: at contact and approaching, V ← -k V.

    A stop on the right keeps Y ≤ gap, one on the left keeps Y ≥ -gap. The gap may be zero or
    negative (a body pressed on); the restitution is in [0, 1], both ends included, or a function of
    the speed of approach with values there (a pytree, if it has parameters).

    It limits the coordinate that `on` names: the components of the state that are position and
    velocity, `on=("x", "u")`; of a `Mechanical` one of its coordinates, `on="y"`, or a function of
    them, `on=lambda q: q.left - q.right`; of a linear machine (`vi.machines.Structure`) the sum
    `at`·x of its displacements. Without a name it is the machine's `position`.

    With `friction` μ a body rubs where it hits the stop, or rests on it, along another coordinate,
    which `along` names in the same way (see `ContactFriction`).
    """

    gap: Float[Array, "..."] = eqx.field(converter=real("gap"))
    """d, distance of the stop from the unstretched position (unit: a)."""
    restitution: Any = eqx.field(converter=real_or_law("restitution"))
    """k, coefficient of restitution (dimensionless)."""
    side: str = eqx.field(static=True, default="right")
    """"right" or "left"."""
    on: Any = eqx.field(static=True, default=None, kw_only=True)
    """The names of position and velocity, or the coordinate or function of a `Mechanical`."""
    mass: Any = eqx.field(default=None, kw_only=True, converter=optional_real("mass"))
    """The effective mass of an impact, for `Run.impact_energy`: 1 by default; a `Mechanical`
    computes it."""
    friction: Float[Array, "..."] | None = eqx.field(
        default=None, kw_only=True, converter=optional_real("friction")
    )
    """μ, Coulomb's coefficient of friction (dimensionless); none by default."""
    along: Any = eqx.field(static=True, default=None, kw_only=True)
    """The coordinate that the body slips along, given as in `on`."""
    tangential_restitution: Float[Array, "..."] | None = eqx.field(
        default=None, kw_only=True, converter=optional_real("tangential_restitution")
    )
    """Coefficient of restitution along the stop (dimensionless); 0 by default."""
    coordinate: int = eqx.field(static=True, default=0, kw_only=True)
    """Index into the machine's `coordinates`."""
    modes: Callable[..., Any] | None = eqx.field(static=True, default=None, kw_only=True)
    """`modes(machine, s, state, *modes)`: the machine's own modes after an impact in this state,
    one number, a tuple, or a dictionary of those that change; by default all stay."""
    at: Float[Array, "..."] | None = eqx.field(
        default=None, kw_only=True, converter=optional_real("at")
    )
    """c, the coefficient of each displacement of a linear machine; `None` for other machines."""
    ranges: ClassVar = {
        "gap": REAL, "restitution": SHARE, "at": REAL, "mass": POSITIVE, "friction": NOT_NEGATIVE,
        "tangential_restitution": SHARE,
    }  # fmt: skip
    word: ClassVar = "impact"
    from_below: ClassVar = False  # behind an impact the body goes away from the stop

    def __check_init__(self):
        require_ranges(self)
        if (self.friction is None) != (self.along is None):
            raise ValueError(
                "Arguments `friction` and `along` of a stop must be given together: how large the "
                "friction is, and along which coordinate the body slips."
            )
        one_of("side", self.side, ("right", "left"))
        count("coordinate", self.coordinate)

    def guard(self, machine, s, state, *modes):
        """How far the coordinate is beyond the stop."""
        return self.beyond(machine.coordinates[self.coordinate].position(state))

    def after(self, machine, s, state, *modes):
        """The rebound, on the stop; switches are in the modes that they have behind an impact."""
        body = machine.coordinates[self.coordinate]
        new = body.placed(state, self.place, self.leaving(body.velocity(state)))
        return new, self.modes_after(machine, s, state, new, modes)

    def modes_after(
        self, machine: Machine, s: Scalar, before: State, after: State, modes: Modes
    ) -> Modes:
        """The machine's modes after an impact.

        **Arguments:** `before` and `after`, the states; `modes`, those before.
        """
        own = None
        if self.modes is not None:
            found = self.modes(machine, s, before, *shown_modes(machine, modes))
            whose = f"`modes` of a stop of a {type(machine).__name__}"
            own = modes_after(machine, found, modes, whose)
        return struck_modes(machine, s, after, modes, own)

    def jump(self, machine, s, state, *modes):
        """The rebound where the body is."""
        body = machine.coordinates[self.coordinate]
        return body.placed(state, body.position(state), self.leaving(body.velocity(state)))

    def speed(self, machine, state, rate):
        """V⁻, the speed of approach."""
        return self.approach(machine.coordinates[self.coordinate].velocity(state))

    @property
    def is_one_number(self) -> bool:
        """Whether the law is Newton's with one number, so that its range is known beforehand."""
        return type(self) is RigidStop and not callable(self.restitution)

    def coefficient(self, approach: object) -> Any:
        """k at this speed of approach."""
        return self.restitution(approach) if callable(self.restitution) else self.restitution

    @by_default
    def rebound(self, V: Number) -> Any:
        """The velocity after an impact with this one (Eq. 17 of the paper)."""
        return -self.coefficient(self.approach(V)) * V

    def leaving(self, V: Number) -> Any:
        """The velocity after an impact with this one: the `rebound`, but nothing for a speed whose
        square is below the smallest number, so that a body may come to rest on the stop."""
        return self.rebound(_unless_tiny(V))

    def rebound_and_share(self, approach: Any) -> tuple[Any, Any]:
        """The velocity (`leaving`) and the `share` of the speed after an impact at this speed of
        approach. The law is evaluated once for both, since it may be long (a network)."""
        V = self.sign * approach
        if not is_own(type(self).rebound):
            k = self.coefficient(approach)
            return -k * _unless_tiny(V), k
        return self.leaving(V), self.share(approach)

    def share(self, approach: Any) -> Any:
        """The share of a speed of approach that is left after the impact: k, or by a `rebound` of
        one's own."""
        if not is_own(type(self).rebound):
            return self.coefficient(approach)
        left = -self.approach(self.rebound(self.sign * approach))
        return left / jnp.where(approach > 0, approach, 1.0)

    def loss(self, approach: Any, share: Any = None) -> Any:
        """Energy lost in an impact, per unit of mass: ½(1 - k²) V⁻²; `share` is k where known."""
        share = self.share(approach) if share is None else share
        return 0.5 * (1 - share**2) * approach**2
