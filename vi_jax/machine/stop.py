"""Rigid stops, and compliant stops whose force follows a contact law during penetration."""

import abc
import dataclasses
from collections.abc import Callable
from math import pi, sqrt
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from .._checks import (
    NOT_NEGATIVE,
    POSITIVE,
    REAL,
    SHARE,
    concrete,
    count,
    instance_of,
    number,
    one_of,
    optional_real,
    real,
    real_or_law,
    require,
    require_ranges,
    returned,
)
from .._types import Machine, Number, Scalar, State
from .contacts import push_of, shown_modes
from .event import AbstractEvent, AbstractSwitch, Modes
from .events import struck_modes
from .modes import modes_after
from .overrides import hashable
from .parts import stops_of, switches_of
from .printing import Shown


def _unless_tiny(V: Number) -> Any:
    """Return a velocity, or 0 if its square is below the smallest number."""
    least = 100 * float(jnp.finfo(jnp.result_type(V)).tiny) ** 0.5
    return jnp.where(jnp.abs(V) > least, V, 0.0)


class Wall(Shown):
    """The position of a stop, rigid or compliant: at `gap` on its `side`."""

    gap: eqx.AbstractVar[Float[Array, "..."]]

    @property
    def sign(self) -> int:
        """+1 on the right, -1 on the left: the body is inside while sign·Y ≤ gap."""
        return 1 if self.side == "right" else -1  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def place(self) -> Float[Array, "..."]:
        """The position of the stop, sign·gap (unit: that of the gap)."""
        return self.sign * self.gap

    def beyond(self, Y: Number) -> Any:
        """Return the depth of a position beyond the stop; negative inside."""
        return self.sign * Y - self.gap

    def approach(self, V: Number) -> Any:
        """Return the speed towards the stop, sign·V; negative for a body that moves away."""
        return self.sign * V

    def mirrors(self, other: "Wall") -> bool:
        """Return whether the other is the mirror image of this one, as far as is known."""
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
    negative (a body pressed on). The restitution is in [0, 1], both ends included. It may be a
    function of the speed of approach with such values (a pytree, if it has parameters).

    It limits the coordinate `on`, the names of position and velocity in the state: `on=("x", "u")`.
    For a `Mechanical` it is one of the coordinates, `on="y"`, or a function of them, `on=lambda q:
    q.left - q.right`. For a linear machine (`vi.machines.Structure`) it is the sum `at`·x of
    displacements. The default is the machine's `position`.

    With `friction` μ, Coulomb friction acts during impacts and rest on the stop, along another
    coordinate, `along`, which is named in the same way. In an impact the body sticks if the
    required impulse is at most μ times that of the stop; its velocity along the stop is then
    reversed and scaled by `tangential_restitution`. Otherwise it slips against μ times the stop's
    impulse. A body that rests on the stop slips against μ times the normal force, or sticks, which
    may jam it. If no motion fulfils these laws (P. Painlevé), the lane ends as `RESULTS.jammed`.
    Newton's and Coulomb's laws together may gain energy where the velocities across and along a
    stop are coupled (T. R. Kane). Such an impact takes the largest share of the restitution that
    gains none.
    """

    gap: Float[Array, "..."] = eqx.field(converter=real("gap"))
    """d, distance of the stop from the coordinate's zero (its unit; a for a `Scene`)."""
    restitution: Any = eqx.field(converter=real_or_law("restitution"))
    """k, coefficient of restitution (dimensionless)."""
    side: str = eqx.field(static=True, default="right")
    """"right" or "left"."""
    on: Any = eqx.field(static=True, default=None, kw_only=True, converter=hashable)
    """The names of position and velocity, or the coordinate or function of a `Mechanical`."""
    mass: Any = eqx.field(default=None, kw_only=True, converter=optional_real("mass"))
    """The effective mass of an impact, for `Run.impact_energy`: 1, or that of a `Mechanical`."""
    friction: Float[Array, "..."] | None = eqx.field(
        default=None, kw_only=True, converter=optional_real("friction")
    )
    """μ, Coulomb's coefficient of friction (dimensionless); without friction by default."""
    along: Any = eqx.field(static=True, default=None, kw_only=True, converter=hashable)
    """The coordinate that the body slips along, given as in `on`."""
    tangential_restitution: Float[Array, "..."] | None = eqx.field(
        default=None, kw_only=True, converter=optional_real("tangential_restitution")
    )
    """Coefficient of restitution along the stop (dimensionless); 0 by default."""
    coordinate: int = eqx.field(static=True, default=0, kw_only=True)
    """Index into the machine's `coordinates`."""
    modes: Callable[..., Any] | None = eqx.field(static=True, default=None, kw_only=True)
    """The machine's own modes after an impact in this state, `modes(machine, s, state, *modes)`:
    one number, a tuple, or a dictionary of those that change; by default unchanged."""
    at: Float[Array, "..."] | None = eqx.field(
        default=None, kw_only=True, converter=optional_real("at")
    )
    """c, the coefficient of each displacement of a linear machine; `None` for other machines."""
    ranges: ClassVar = {
        "gap": REAL, "restitution": SHARE, "at": REAL, "mass": POSITIVE, "friction": NOT_NEGATIVE,
        "tangential_restitution": SHARE,
    }  # fmt: skip
    word: ClassVar = "impact"
    from_below: ClassVar = False  # after an impact the body moves away

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
        return self.beyond(machine.coordinates[self.coordinate].position(state))

    def after(self, machine, s, state, *modes):
        body = machine.coordinates[self.coordinate]
        new = body.placed(state, self.place, self.velocity_after(body.velocity(state)))
        return new, self.modes_after(machine, s, state, new, modes)

    def modes_after(
        self, machine: Machine, s: Scalar, before: State, after: State, modes: Modes,
        jump: tuple[Scalar, State] | None = None,
    ) -> Modes:  # fmt: skip
        """Return the machine's modes after an impact. **Arguments:** `before` and `after`, the
        states; `modes`, those before; `jump`, as in `struck_modes`."""
        machine_modes = None
        if self.modes is not None:
            found = self.modes(machine, s, before, *shown_modes(machine, modes))
            whose = f"`modes` of a stop of a {type(machine).__name__}"
            machine_modes = modes_after(machine, found, modes, whose)
        return struck_modes(machine, s, after, modes, machine_modes, before=before, jump=jump)

    def jump(self, machine, s, state, *modes):
        body = machine.coordinates[self.coordinate]
        return body.placed(state, body.position(state), self.velocity_after(body.velocity(state)))

    def speed(self, machine, state, rate):
        """Return V⁻, the speed of approach."""
        return self.approach(machine.coordinates[self.coordinate].velocity(state))

    @property
    def is_one_number(self) -> bool:
        """True if the restitution is one number, so that its range is known beforehand."""
        return not callable(self.restitution)

    def coefficient(self, approach: object) -> Any:
        """Return k at this speed of approach."""
        if not callable(self.restitution):
            return self.restitution
        whose = f"`restitution` of a {type(self).__name__}"
        return returned(self.restitution(approach), whose, "a number")

    def velocity_after(self, V: Number, coefficient: Any = None) -> Any:
        """Return the velocity after an impact with velocity `V` (Eq. 17 of the paper), with this
        coefficient of restitution or that of the speed. It is zero for a speed whose square is
        below the smallest number, so that a body may come to rest."""
        V = _unless_tiny(V)
        k = self.coefficient(self.approach(V)) if coefficient is None else coefficient
        return -k * V

    def loss(self, approach: Any, coefficient: Any) -> Any:
        """Return the energy lost in an impact per unit of mass, ½(1 - k²) V⁻²."""
        return 0.5 * (1 - coefficient**2) * approach**2


def _exponent(x: Any) -> float:
    if isinstance(x, Tracer):
        raise TypeError(
            "Argument `exponent` of a contact law must be a compile-time constant, but is traced. "
            "A parameter of the machine is one with `eqx.field(static=True)`."
        )
    return float(x)


class AbstractContactLaw(Shown):
    """The force away from a `SoftStop` as a function of the depth δ > 0 and its rate δ'.

    A subclass defines `force`. It may use the stiffness K and the damping α of the stop, or
    parameters of the law.
    """

    exponent: float = eqx.field(static=True, default=1.0, converter=_exponent)
    """p ≥ 1, the power of the depth in the spring's force, for the length of steps. Static."""

    def __check_init__(self):
        require("exponent", self.exponent, low=1.0)

    @abc.abstractmethod
    def force(self, stiffness: Any, damping: Any, depth: Any, rate: Any) -> Any:
        """Return the force away from the stop during contact, without prestress; it may pull."""

    def pulls(self, stiffness: Any, damping: Any, prestress: Any, depth: Any, rate: Any) -> Any:
        """Return a value with the sign of the pull, positive if the stop would pull the body. Its
        zero ends a contact that may not pull. It should be smooth at first touch.

        **Arguments:** `stiffness` K and `damping` α; `prestress` F0, or `None`; `depth` δ and its
        `rate` δ' with respect to time.
        """
        force = self.force(stiffness, damping, depth, rate)
        return -force if prestress is None else -(prestress + force)

    def damping_of(self, restitution: Any) -> Any:
        """Return α for this restitution at every speed, or `None` if it depends on speed."""
        return None

    def damping_without_pull(self, restitution: Any) -> Any:
        """Return the same for a stop that does not pull (`adhesive=False`)."""
        return None

    def frequency(self, stiffness: Any, depth: Any, rate: Any) -> Any:
        """Return the frequency of oscillations on the stop, at the depth that the body will reach;
        `stiffness` is per unit of its mass."""
        p, deepest = self.exponent, jnp.maximum(depth, 1e-12)
        if p > 1:
            reach = (0.5 * (p + 1) * rate**2 / stiffness + 1e-30) ** (1 / (p + 1))
            deepest = jnp.maximum(deepest, reach)
        return jnp.sqrt(p * stiffness * power(deepest, p - 1))


class PowerLaw(AbstractContactLaw):
    """K δᵖ + α √K δ^((p-1)/2) δ': p = 1 is a spring with a dashpot, p = 3/2 Hertz's contact.

    The coefficient of restitution does not depend on the speed: α = √(2(p+1)) (-ln e)/√(π² + ln² e)
    (Feng, arXiv 2603.27764). Without pull the contact ends earlier: α = √(2(p+1)) ζ, where
    e = exp(-2ζ acos(ζ)/√(1 - ζ²)).
    """

    def force(self, stiffness, damping, depth, rate):
        """Return the sum of K δ^p of the spring and α √K δ^((p-1)/2) δ' of the dashpot. The stop
        passes α √m for α if the mass m is not 1."""
        p = self.exponent
        resist = damping * jnp.sqrt(stiffness) * power(depth, 0.5 * (p - 1)) * rate
        return stiffness * power(depth, p) + resist

    def pulls(self, stiffness, damping, prestress, depth, rate):
        """Return the pull over δ^((p-1)/2), which is smooth at first touch."""
        root = power(depth, 0.5 * (self.exponent + 1))
        pull = -stiffness * root - damping * jnp.sqrt(stiffness) * rate
        flat = power(depth, 0.5 * (self.exponent - 1))
        return pull if prestress is None else pull * flat - prestress

    def damping_of(self, restitution):
        """Return α for e in (0, 1]."""
        require("restitution", restitution, low=0.0, high=1.0, open_low=True)
        drop = -jnp.log(jnp.asarray(restitution, float))
        return sqrt(2 * (self.exponent + 1)) * drop / jnp.sqrt(pi**2 + drop**2)

    def damping_without_pull(self, restitution):
        """Return α for e in (0, 1]. In the variable δ^((p+1)/2) and the speed, the contact is a
        damped oscillation with the damping ratio ζ, and ends where its acceleration is zero."""
        require("restitution", restitution, low=0.0, high=1.0, open_low=True)
        known = concrete(restitution)
        ratio = _ratio_without_pull(
            *((np, np.asarray(known)) if known is not None else (jnp, restitution))
        )
        return sqrt(2 * (self.exponent + 1)) * jnp.asarray(ratio, float)


def _ratio_without_pull(xp: Any, restitution: Any) -> Any:
    """Return ζ with e = exp(-2ζ acos(ζ)/√(1 - ζ²)), with arrays of NumPy or JAX (`xp`)."""
    drop = -0.5 * xp.log(restitution)
    is_one, safe = drop <= 0, xp.where(drop > 0, drop, 1.0)
    ratio = 2 / pi * xp.sinh(safe)
    for _ in range(5):  # Newton's method in ln ζ: 1e-9 after three
        x = 1 - ratio
        near = xp.abs(x) < _NEAR_ONE
        angle = _angle_by_sine(xp, ratio)
        far = xp.where(near, 1.0, x * (1 + ratio))
        slope = xp.where(near, -1 / 3 - 4 / 15 * x, (ratio * angle - 1) / far)
        ratio = ratio * xp.exp((safe - ratio * angle) / (ratio * angle + ratio**2 * slope))
    return xp.where(is_one, 2 / pi * drop, ratio)


# Within this distance of ζ = 1 a series of seven terms is exact to rounding.
_NEAR_ONE = 0.01


def _angle_by_sine(xp: Any, ratio: Any) -> Any:
    """Return acos(ζ)/√(1 - ζ²), or acosh(ζ)/√(ζ² - 1)."""
    x, series, coefficients = 1 - ratio, 0.0, [1.0]
    for n in range(1, 7):
        coefficients.append(coefficients[-1] * n / (2 * n + 1))
    for c in reversed(coefficients):
        series = series * x + c
    near, below = xp.abs(x) < _NEAR_ONE, ratio < 1
    low, high = xp.where(near | ~below, 0.5, ratio), xp.where(near | below, 2.0, ratio)
    angles = xp.arccos(low) / xp.sqrt(1 - low**2), xp.arccosh(high) / xp.sqrt(high**2 - 1)
    return xp.where(near, series, xp.where(below, *angles))


class HuntCrossley(AbstractContactLaw):
    """K δᵖ (1 + α δ'), with a restitution that decreases with speed."""

    def force(self, stiffness, damping, depth, rate):
        """Return the spring's force with damping in proportion to it."""
        spring = stiffness * power(depth, self.exponent)
        return spring + damping * spring * rate

    def pulls(self, stiffness, damping, prestress, depth, rate):
        """Return the pull over the spring's force, which is 0 at first touch without prestress."""
        if prestress is None:
            return -(1 + damping * rate)
        return super().pulls(stiffness, damping, prestress, depth, rate)


def power(x: Any, n: float) -> Any:
    """Return xⁿ for x > 0; for n = 0 and 1 continued smoothly to where a step may evaluate it."""
    if n == 0:
        return jnp.ones_like(x)
    if n == 1:
        return x
    inside = x > 0
    return jnp.where(inside, jnp.where(inside, x, 1.0) ** n, 0.0)


# Modes: the body touches; it is released, but not yet out; it is apart.
TOUCHING, RELEASED, APART = 1.0, 0.0, -1.0

# Within this time to the stop, as a share of 1/2π of a cycle, the contact's time scale matters: a
# choice, since a step that ends on first touch may end a little short of it.
_NEAR = 1e-6


class SoftStop(Wall, AbstractSwitch):
    """A compliant stop: pushes the body back while it penetrates by δ > 0.

    The force on a body of mass m is the prestress F0 plus that of its law. The default law is
    `PowerLaw`, K δᵖ + α √(K m) δ^((p-1)/2) δ'. A spring with a dashpot has p = 1, Hertz's contact
    p = 3/2. Its coefficient of restitution does not depend on the speed, so that `restitution` may
    be given instead of `damping`. With `HuntCrossley`, K δᵖ (1 + α δ'), it decreases with speed.

    With p > 1 the power law's force has a steep start and, where it may pull, a steep end, of the
    order δ^((p-1)/2). Adaptive steps (`Adaptive`) follow it, fixed ones lose their order there. The
    error of a step does not show the derivative of such an end. Through an adhesive stop with 1 < p
    < 3 derivatives, and with them multipliers and `find_orbit`, are accurate to 1e-2 only. Use
    `adhesive=False` there (1e-6 and better), or the Hunt–Crossley law.

    **Arguments:**

    - `gap`: distance of the stop from the coordinate's zero (its unit); the body touches beyond.
    - `stiffness` K, a force by depthᵖ, N/m for a spring in SI units; positive (for a `Scene`: in
      units of the body's own spring).
    - `restitution` e in (0, 1], without prestress, or `damping` α, not negative (no unit for a
      power law, s/m for `HuntCrossley`); no damping by default.
    - `dashpot` c of a power law, not negative: a force by speed, N s/m for a spring in SI units.
      The term c δ^((p-1)/2) δ' is added to the force.
    - `law`: `PowerLaw(p)` or `HuntCrossley(p)` with an exponent p of at least 1 (`PowerLaw()` by
      default, with p = 1), or any `AbstractContactLaw`.
    - `prestress` F0: the force at first touch, not negative; 0 by default.
    - `adhesive`: whether the dashpot may pull at the end of its stroke; `False` releases the body
      when the force decreases to zero. Static.
    - `side`: `"right"` or `"left"`.
    - `on`: the coordinate that it limits, as of a `RigidStop`.
    - `mass`: the mass on which the force acts, 1 by default; a `Mechanical` computes it.

    **Raises:** `ValueError` with the name of an argument that is out of range.
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
    word: ClassVar = "soft stop"
    sized_in: ClassVar = (APART, APART)  # all guards are lengths, as the depth
    checked_within_step: ClassVar = (
        False  # steps are short compared with a contact (`longest_step`)
    )
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
        law: AbstractContactLaw | None = None,
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
        self.law = PowerLaw() if law is None else law
        instance_of("law", self.law, AbstractContactLaw, "a `PowerLaw()` or another contact law")
        if restitution is not None:
            given = f"{restitution!r} with damping={damping!r} and law={law!r}"
            damping = _damping_of(self.law, restitution, damping, given, bool(adhesive))
            if prestress is not None:
                raise ValueError(
                    "Argument `restitution` must be left out with `prestress`, with which it "
                    f"depends on the speed, but got {restitution!r}. Give `damping`."
                )
            if dashpot is not None:
                raise ValueError(
                    "Argument `dashpot` must be left out with `restitution`, which determines the "
                    f"damping, but got {dashpot!r}."
                )
        self.gap = number("gap", gap)
        self.stiffness = number("stiffness", stiffness)
        self.damping = number("damping", 0.0 if damping is None else damping)
        if dashpot is not None and not isinstance(self.law, PowerLaw):
            raise ValueError(
                f"Argument `dashpot` belongs to a `PowerLaw`, but got {dashpot!r} with {law!r}. "
                "Give `damping` to other laws."
            )
        self.dashpot = optional_real("dashpot")(dashpot)
        self.prestress = optional_real("prestress")(prestress)
        self.mass = optional_real("mass")(mass)
        self.adhesive = bool(adhesive)
        self.side = one_of("side", side, ("right", "left"))
        self.on, self.acts = hashable(on), acts
        self.coordinate = count("coordinate", coordinate)
        self.ends_cycle, self.name = bool(ends_cycle), str(name)
        require_ranges(self)

    @property
    def may_slide(self) -> bool:  # pyright: ignore
        """True for a prestressed contact, whose force jumps at first touch. Otherwise the force is
        the same on a body that goes in or comes out."""
        return self.prestress is not None

    def depth(self, machine: Machine, state: State) -> tuple[Any, Any]:
        """Return δ and δ' (by time); δ is negative apart from the stop."""
        body = machine.coordinates[self.coordinate]
        return self.beyond(body.position(state)), self.approach(body.velocity(state))

    def force(self, depth: Number, rate: Number, mass: Any = 1.0) -> Any:
        """Return the force away from the stop on a body of this mass in contact."""
        force = self.law.force(self.stiffness, self._damping(mass), depth, rate)
        return force if self.prestress is None else self.prestress + force

    def contribution(self, machine, s, state, mode):
        """Return the acceleration that the stop adds to the coordinate."""
        mass = self._mass(machine, s, state)
        push = -self.sign * self.force(*self.depth(machine, state), mass)
        return jnp.where(mode > 0, push if _is_one(mass) else push / mass, 0.0)

    def push_in(self, machine, s, state, mode):
        body = machine.coordinates[self.coordinate]
        return self.contribution(machine, s, state, mode), push_of(body, state)

    def begin(self, machine, s, state):
        depth, rate = self.depth(machine, state)
        inside = (depth > 0) | ((depth == 0) & (rate > 0))
        mode = TOUCHING
        if not self.adhesive:
            mode = jnp.where(self._pulls(machine, s, state) < 0, TOUCHING, RELEASED)
        return jnp.where(inside, mode, APART)

    def guard(self, machine, s, state, mode):
        if self.adhesive:
            return -mode * self.depth(machine, state)[0]
        to_apart, to_other = (
            self.guard_into(x, machine, s, state, mode) for x in (APART, TOUCHING)
        )
        return jnp.maximum(to_apart, to_other)

    def guard_into(self, new, machine, s, state, mode):
        depth, _ = self.depth(machine, state)
        if self.adhesive:
            return -mode * depth
        pulls = self._pulls(machine, s, state)
        ends = jnp.where(mode > 0, pulls, -pulls)
        return jnp.where(mode < 0, depth, jnp.where(new < 0, -depth, ends))

    def after(self, machine, s, state, mode):
        if self.adhesive:
            return state, -mode
        depth, _ = self.depth(machine, state)
        pulls = self._pulls(machine, s, state)
        inside = depth > 0  # without damping the force vanishes as the body comes out
        released = jnp.where(inside & (pulls >= -0.5 * depth), RELEASED, APART)
        touching = jnp.where(inside & (pulls < 0.5 * depth), TOUCHING, APART)
        return state, jnp.where(mode < 0, TOUCHING, jnp.where(mode > 0, released, touching))

    def longest_step(self, machine: Machine, s: Scalar, state: State) -> Any:
        """Return a fifth of the period of oscillations on the stop; infinite apart from it."""
        depth, rate = self.depth(machine, state)
        mass = self._mass(machine, s, state)
        stiffness = self.stiffness if _is_one(mass) else self.stiffness / mass
        frequency = self.law.frequency(stiffness, depth, rate)
        near = -_NEAR * jnp.asarray(machine.cycle) / (2 * pi) * jnp.abs(rate)
        return jnp.where(depth >= near, 0.4 * pi / frequency, jnp.inf)

    def _mass(self, machine: Machine, s: Scalar, state: State) -> Any:
        return machine.coordinates[self.coordinate].mass_at(s, state)

    def _damping(self, mass: Any) -> Any:
        if not isinstance(self.law, PowerLaw):
            return self.damping
        damping = self.damping if _is_one(mass) else self.damping * jnp.sqrt(mass)
        return (
            damping if self.dashpot is None else damping + self.dashpot / jnp.sqrt(self.stiffness)
        )

    def _pulls(self, machine: Machine, s: Scalar, state: State) -> Any:
        """Return the pull as a length: it is compared with the depth, and has the same rounding."""
        mass, (depth, rate) = self._mass(machine, s, state), self.depth(machine, state)
        given = self.stiffness, self._damping(mass), self.prestress
        pulls, slopes = jax.value_and_grad(self.law.pulls, argnums=(3, 4))(*given, depth, rate)
        stiffness = self.stiffness if _is_one(mass) else self.stiffness / mass
        frequency = self.law.frequency(stiffness, depth, rate)
        unit = stop_gradient(jnp.abs(slopes[0]) + frequency * jnp.abs(slopes[1]))
        return jnp.where(unit > 0, pulls / jnp.where(unit > 0, unit, 1.0), -depth)


def _is_one(mass: Any) -> bool:
    """Return whether a mass is known to be 1 while tracing: then it costs nothing."""
    return isinstance(mass, float | int) and mass == 1


def _damping_of(
    law: AbstractContactLaw,
    restitution: Number,
    damping: Number | None,
    given: str,
    adhesive: bool,
) -> Any:
    """Return α for a restitution; `given` is the text of the arguments for an error."""
    of_law = law.damping_of if adhesive else law.damping_without_pull
    found = of_law(restitution) if damping is None else None
    if found is None:
        raise ValueError(
            "Argument `restitution` must be given without `damping`, and for a law such as "
            f"`PowerLaw`, whose restitution is one number, but got {given}."
        )
    return found


def stop_in_words(machine: Machine, wall: Wall) -> str:
    """Return the name of one of a machine's stops: its `name`, else its side, with the coordinate
    or the number if several stops are on that side."""
    walls = [x for x in (*stops_of(machine), *switches_of(machine)) if isinstance(x, Wall)]
    soft = "soft " if isinstance(wall, SoftStop) else ""
    alike = [x for x in walls if type(x) is type(wall) and x.side == wall.side and not x.name]  # pyright: ignore
    words = f"{wall.side} {soft}stop"  # pyright: ignore
    if wall.name or len(alike) < 2:  # pyright: ignore
        return wall.name or words  # pyright: ignore
    names = [x.on[0] if isinstance(x.on, tuple) else x.on for x in alike]  # pyright: ignore
    number = next(i for i, x in enumerate(alike) if x is wall)
    by_name = all(isinstance(x, str) for x in names) and len(set(names)) == len(names)
    return f"{words} of {names[number]}" if by_name else f"{words} {number}"
