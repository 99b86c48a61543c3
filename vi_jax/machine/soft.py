"""Compliant stops, whose force is that of a contact law while the body penetrates: no jump."""

import abc
from math import pi, sqrt
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import (
    NOT_NEGATIVE,
    POSITIVE,
    REAL,
    count,
    instance_of,
    number,
    one_of,
    optional_real,
    require,
    require_ranges,
)
from .._types import Machine, Number, Scalar, State
from .contacts import push_of
from .event import AbstractSwitch
from .shown import Shown
from .stop import Wall


class AbstractContactLaw(Shown):
    """Force away from a `SoftStop` by the depth δ > 0 and its rate δ'.

    A subclass defines `force`. It may use the stiffness K and the damping α of the stop, or
    parameters of the law.
    """

    exponent: float = eqx.field(static=True, default=1.0, converter=float)
    """p, the power of the depth in the spring's force, at least 1; the step length depends on it.
    Static."""

    def __check_init__(self):
        require("exponent", self.exponent, low=1.0)

    @property
    def is_analytic(self) -> bool:
        """Whether the force has a power series at first touch."""
        return self.exponent == 1

    @abc.abstractmethod
    def force(self, stiffness: Any, damping: Any, depth: Any, rate: Any) -> Any:
        """The force away from the stop on a body that touches, without prestress; it may pull (be
        negative)."""

    def pulls(self, stiffness: Any, damping: Any, prestress: Any, depth: Any, rate: Any) -> Any:
        """A function with the sign of the pull: positive where the stop would pull the body. It
        ends a contact that may not pull, and should be smooth at first touch.

        **Arguments:** `stiffness` K and `damping` α; `prestress` F0, or `None`; `depth` δ and its
        `rate` δ' with respect to time.
        """
        force = self.force(stiffness, damping, depth, rate)
        return -force if prestress is None else -(prestress + force)

    def damping_of(self, restitution: Any) -> Any:
        """α that gives this restitution at every speed; `None` for a law whose restitution depends
        on it."""
        return None

    def frequency(self, stiffness: Any, depth: Any, rate: Any) -> Any:
        """The frequency with which a body oscillates on the stop, at the depth that it will
        reach; `stiffness` is that per unit of its mass."""
        p, deepest = self.exponent, jnp.maximum(depth, 1e-12)
        if p > 1:
            reach = (0.5 * (p + 1) * rate**2 / stiffness + 1e-30) ** (1 / (p + 1))
            deepest = jnp.maximum(deepest, reach)
        return jnp.sqrt(p * stiffness * power(deepest, p - 1))


class PowerLaw(AbstractContactLaw):
    """K δᵖ + α √K δ^((p-1)/2) δ': p = 1 is a spring with a dashpot, p = 3/2 Hertz's contact.

    Its coefficient of restitution does not depend on the speed,
    α = √(2(p+1)) (-ln e)/√(π² + ln² e) (Feng, arXiv 2603.27764).
    """

    def force(self, stiffness, damping, depth, rate):
        """K δ^p of the spring and α √K δ^((p-1)/2) δ' of the dashpot; on a body of another mass
        than 1 the stop gives α √m for α."""
        p = self.exponent
        resist = damping * jnp.sqrt(stiffness) * power(depth, 0.5 * (p - 1)) * rate
        return stiffness * power(depth, p) + resist

    def pulls(self, stiffness, damping, prestress, depth, rate):
        """The pull over δ^((p-1)/2), which is smooth at first touch."""
        root = power(depth, 0.5 * (self.exponent + 1))
        pull = -stiffness * root - damping * jnp.sqrt(stiffness) * rate
        flat = power(depth, 0.5 * (self.exponent - 1))
        return pull if prestress is None else pull * flat - prestress

    def damping_of(self, restitution):
        """α from e in (0, 1]."""
        require("restitution", restitution, low=0.0, high=1.0, open_low=True)
        drop = -jnp.log(jnp.asarray(restitution, float))
        return sqrt(2 * (self.exponent + 1)) * drop / jnp.sqrt(pi**2 + drop**2)


class HuntCrossley(AbstractContactLaw):
    """K δᵖ (1 + α δ'), whose restitution falls with the speed."""

    def force(self, stiffness, damping, depth, rate):
        """The spring's force with a damping in proportion to it."""
        spring = stiffness * power(depth, self.exponent)
        return spring + damping * spring * rate

    def pulls(self, stiffness, damping, prestress, depth, rate):
        """The pull over the spring's force, without prestress: that vanishes at first touch."""
        if prestress is None:
            return -(1 + damping * rate)
        return super().pulls(stiffness, damping, prestress, depth, rate)


def power(x: Any, n: float) -> Any:
    """xⁿ inside; for n = 0 and 1 continued smoothly to where a step may look beyond the surface."""
    if n == 0:
        return jnp.ones_like(x)
    if n == 1:
        return x
    inside = x > 0
    return jnp.where(inside, jnp.where(inside, x, 1.0) ** n, 0.0)


# Modes: the body touches; it has been let go of, but has not yet come out; it is apart.
TOUCHING, RELEASED, APART = 1.0, 0.0, -1.0

# Laws that may be asked for by their names.
_LAWS: dict[str, type[AbstractContactLaw]] = {"power": PowerLaw, "hunt-crossley": HuntCrossley}

# A body is near enough for the contact's time scale to matter (unit: that of the coordinate): a
# choice, since a step that ends on first touch may end a little short of it.
_NEAR = 1e-6


class SoftStop(Wall, AbstractSwitch):
    """A compliant stop: pushes the body back while it penetrates by δ > 0.

    The force on a body of mass m is F0 plus that of its law, by default `PowerLaw`: K δᵖ + α √(K m)
    δ^((p-1)/2) δ', p = 1 being a spring with a dashpot, p = 3/2 Hertz's contact. Its coefficient of
    restitution does not depend on the speed, so that `restitution` may be given instead of
    `damping`. That of `HuntCrossley`, K δᵖ (1 + α δ'), falls with speed.

    With p > 1 the power law's force has a steep start and, where it may pull, a steep end, of the
    order δ^((p-1)/2); steps sized by their error (`Adaptive`) follow it, fixed ones lose their
    order there. A step's error does
    not show the derivative of such an end: through an adhesive stop with 1 < p < 3 derivatives,
    and with them multipliers and `find_orbit`, are right to 1e-2 only. Take `adhesive=False` there
    (1e-6 and better), or the Hunt–Crossley law.

    **Arguments:**

    - `gap`: distance of the stop from the coordinate's zero (its unit); the body touches beyond.
    - `stiffness` K, a force by depthᵖ, N/m for a spring in SI units; positive (for a `Scene`: in
      units of the body's own spring).
    - `restitution` e in (0, 1], or `damping` α, not negative (no unit for a power law, s/m for
      `HuntCrossley`); neither: no damping.
    - `dashpot` c of a power law, not negative: a force by speed, N s/m for a spring in SI units.
      The term c δ^((p-1)/2) δ' is added to the force.
    - `law`: `"power"` or `"hunt-crossley"`, and `exponent` p, at least 1 (1 by default); or any
      `AbstractContactLaw`, which has its own.
    - `prestress` F0: the force at first touch, not negative; none by default.
    - `adhesive`: whether the dashpot may pull at the end of its stroke; `False` releases the body
      when the force falls to zero. Static.
    - `side`: `"right"` or `"left"`.
    - `on`: the coordinate that it limits, as of a `RigidStop`.
    - `mass` on which the force acts: 1 by default; a `Mechanical` knows it.

    **Raises:** `ValueError` naming the argument that is out of range.
    """

    gap: Float[Array, "..."]
    stiffness: Float[Array, "..."]
    damping: Float[Array, "..."]
    dashpot: Float[Array, "..."] | None
    prestress: Float[Array, "..."] | None
    law: AbstractContactLaw
    adhesive: bool = eqx.field(static=True)
    side: str = eqx.field(static=True)
    on: Any = eqx.field(static=True)
    mass: Float[Array, "..."] | None
    coordinate: int = eqx.field(static=True)
    ends: str = eqx.field(static=True, init=False, default="")  # its touch ends no motion
    looked_at_within: ClassVar = False  # steps are short compared with a contact (`longest_step`)
    ranges: ClassVar = {
        "gap": REAL, "stiffness": POSITIVE, "damping": NOT_NEGATIVE, "dashpot": NOT_NEGATIVE,
        "prestress": NOT_NEGATIVE, "mass": POSITIVE,
    }  # fmt: skip

    def __init__(
        self,
        gap: Number,
        stiffness: Number,
        *,
        restitution: Number | None = None,
        damping: Number | None = None,
        dashpot: Number | None = None,
        exponent: float | None = None,
        law: str | AbstractContactLaw = "power",
        prestress: Number | None = None,
        adhesive: bool = True,
        side: str = "right",
        on: Any = None,
        mass: Number | None = None,
        coordinate: int = 0,
        ends_cycle: bool = False,
        name: str = "",
        acts: bool = False,
    ):
        self.law = _law(law, exponent)
        if restitution is not None:
            given = f"{restitution!r} with damping={damping!r} and law={law!r}"
            damping = _damping_of(self.law, restitution, damping, given)
        self.gap = number("gap", gap)
        self.stiffness = number("stiffness", stiffness)
        self.damping = number("damping", 0.0 if damping is None else damping)
        if dashpot is not None and not isinstance(self.law, PowerLaw):
            raise ValueError(
                f'Argument `dashpot` belongs to the law "power", but got {dashpot!r} with '
                f"law={law!r}. Give `damping` to other laws."
            )
        self.dashpot = optional_real("dashpot")(dashpot)
        self.prestress = optional_real("prestress")(prestress)
        self.mass = optional_real("mass")(mass)
        self.adhesive = bool(adhesive)
        self.side = one_of("side", side, ("right", "left"))
        self.on, self.acts = on, acts
        self.coordinate = count("coordinate", coordinate)
        self.ends_cycle, self.name = bool(ends_cycle), str(name)
        require_ranges(self)

    @property
    def analytic(self) -> bool:  # pyright: ignore
        """Whether the force has a power series at first touch: where it is straight in the depth.
        Others have a kink or a root there."""
        return self.law.is_analytic

    @property
    def may_slide(self) -> bool:  # pyright: ignore
        """Only at a prestressed contact, whose force jumps as it is touched: else the force on a
        body that goes in is that on one that comes out."""
        return self.prestress is not None

    def depth(self, machine: Machine, state: State) -> tuple[Any, Any]:
        """δ and δ' (by time); δ is negative apart from the stop."""
        body = machine.coordinates[self.coordinate]
        return self.beyond(body.position(state)), self.approach(body.velocity(state))

    def force(self, depth: Number, rate: Number, mass: Any = 1.0) -> Any:
        """Force away from the stop on a body of this mass that touches."""
        force = self.law.force(self.stiffness, self._damping(mass), depth, rate)
        return force if self.prestress is None else self.prestress + force

    def contribution(self, machine, s, state, mode):
        """The acceleration that the stop adds to the coordinate."""
        mass = self._mass(machine, s, state)
        push = -self.sign * self.force(*self.depth(machine, state), mass)
        return jnp.where(mode > 0, push if _is_one(mass) else push / mass, 0.0)

    def push_in(self, machine, s, state, mode):
        """The acceleration of the coordinate while the body touches, and its push."""
        body = machine.coordinates[self.coordinate]
        return self.contribution(machine, s, state, mode), push_of(body, state)

    def begin(self, machine, s, state):
        """The mode of a motion that begins: touching, unless the body is apart or has been
        released."""
        depth, rate = self.depth(machine, state)
        inside = (depth > 0) | ((depth == 0) & (rate > 0))
        holds = TOUCHING
        if not self.adhesive:
            holds = jnp.where(self._pulls(machine, s, state) < 0, TOUCHING, RELEASED)
        return jnp.where(inside, holds, APART)

    def guard(self, machine, s, state, mode):
        """The guard of touching, leaving, or being released."""
        depth, _ = self.depth(machine, state)
        if self.adhesive:
            return -mode * depth
        pulls = self._pulls(machine, s, state)
        ends = jnp.where(mode > 0, pulls, -pulls)
        return jnp.where(mode < 0, depth, jnp.maximum(ends, -depth))

    def after(self, machine, s, state, mode):
        """Touching, released or apart, after the guard that rose to zero."""
        if self.adhesive:
            return state, -mode
        depth, _ = self.depth(machine, state)
        pulls = self._pulls(machine, s, state)
        inside = depth > 0  # without damping the force falls to zero as the body comes out
        released = jnp.where(inside & (pulls >= -depth), RELEASED, APART)
        again = jnp.where(inside & (-pulls > -depth), TOUCHING, APART)
        return state, jnp.where(mode < 0, TOUCHING, jnp.where(mode > 0, released, again))

    def longest_step(self, machine: Machine, s: Scalar, state: State) -> Any:
        """A fifth of the period in which a body oscillates on the stop; infinite apart from it."""
        depth, rate = self.depth(machine, state)
        mass = self._mass(machine, s, state)
        stiffness = self.stiffness if _is_one(mass) else self.stiffness / mass
        frequency = self.law.frequency(stiffness, depth, rate)
        return jnp.where(depth > -_NEAR, 0.4 * pi / frequency, jnp.inf)

    def _mass(self, machine: Machine, s: Scalar, state: State) -> Any:
        return machine.coordinates[self.coordinate].mass_at(s, state)

    def _damping(self, mass: Any) -> Any:
        """The damping that the law gets for a body of this mass."""
        if not isinstance(self.law, PowerLaw):
            return self.damping
        damping = self.damping if _is_one(mass) else self.damping * jnp.sqrt(mass)
        return (
            damping if self.dashpot is None else damping + self.dashpot / jnp.sqrt(self.stiffness)
        )

    def _pulls(self, machine: Machine, s: Scalar, state: State) -> Any:
        damping = self._damping(self._mass(machine, s, state))
        return self.law.pulls(self.stiffness, damping, self.prestress, *self.depth(machine, state))


def _is_one(mass: Any) -> bool:
    """Whether a mass is known to be 1 while a program is traced: it costs nothing then."""
    return isinstance(mass, float | int) and mass == 1


def _law(law: str | AbstractContactLaw, exponent: float | None) -> AbstractContactLaw:
    """A law by its name and exponent, or as it is."""
    if isinstance(law, str):
        one_of("law", law, tuple(_LAWS))
        return _LAWS[law](1.0 if exponent is None else exponent)
    instance_of("law", law, AbstractContactLaw, f"one of {list(_LAWS)} or an `AbstractContactLaw`")
    if exponent is not None:
        raise ValueError(
            "Argument `exponent` must be left out if `law` is an object, which has its own, but "
            f"got {exponent!r} with {law!r}."
        )
    return law


def _damping_of(
    law: AbstractContactLaw, restitution: Number, damping: Number | None, given: str
) -> Any:
    """α from a restitution that was `given` in its place."""
    found = law.damping_of(restitution) if damping is None else None
    if found is None:
        raise ValueError(
            "Argument `restitution` must be given without `damping`, and for a law such as "
            f'"power", whose restitution is one number, but got {given}.'
        )
    return found
