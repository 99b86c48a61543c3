"""Machines that are linear between impacts: M x'' + C x' + K x = f₀ + f₁ cos ωs + f₂ sin ωs."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from .._checks import concrete, number
from .._types import Number, Scalar, State
from .base import AbstractMachine, Coordinate
from .modal import Modes, along, harmonic, modal, solved, times, without_row
from .own import changed
from .shown import Shown
from .stop import RigidStop


class StructureState(Shown):
    """Displacements and velocities of a machine of n degrees of freedom."""

    displacement: Float[Array, "..."]
    """x, one number for each degree of freedom."""
    velocity: Float[Array, "..."]
    """dx/ds, one number for each degree of freedom."""


class Prepared(NamedTuple):
    """A machine as a run follows it, and states on the way in and out."""

    machine: Any
    inward: Callable[[State], State] = lambda state: state
    outward: Callable[[State], State] = lambda state: state


class _Known(NamedTuple):
    """What a machine with rules of its own is asked for in each step, worked out beforehand."""

    inverse: Float[Array, "n n"] | None
    """M⁻¹; `None` for a diagonal M."""
    longest: Scalar
    """The longest step, a fifth of the shortest period of the modes or the force."""


# What a run asks of a machine and the machine in its modes does not take over from a subclass.
_IN_MODES = (
    "field", "_accelerated", "events", "averages", "renewed", "coordinates", "position",
    "velocity", "placed", "cycle", "pace", "step_limit", "relaxation",
)  # fmt: skip


class LinearMachine(AbstractMachine):
    """A machine of n degrees of freedom that is linear between impacts:

        M x'' + C x' + K x = f₀ + f₁ cos ωs + f₂ sin ωs

    with M symmetric and positive definite, C and K symmetric. Time is the independent variable s, a
    cycle 2π/ω. Stops limit sums c·x of the displacements. A restitution k takes v to
    v - (1 + k) (c·v) M⁻¹c/(cᵀM⁻¹c), so that an impact acts on the mass 1/(cᵀM⁻¹c).

    It is followed in its natural modes, which are worked out once for each run (`prepared`).
    `ExactFlight` has no step error; every other method takes the field (`Taylor` only where the
    matrices are diagonal).

    Subclasses give `mass`, `damping` and `stiffness`, each (n, n), or (n,) for a diagonal one (no
    damping may be `None`); `forces`; `frequency`; and `contacts`, stops of which each has its c in
    `RigidStop.at`, or, where that is `None`, the number of an earlier one's in
    `RigidStop.coordinate`.
    """

    mass: eqx.AbstractVar[Float[Array, "..."]]
    damping: eqx.AbstractVar[Float[Array, "..."] | None]
    stiffness: eqx.AbstractVar[Float[Array, "..."]]
    frequency: eqx.AbstractVar[Scalar]
    contacts: eqx.AbstractVar[tuple[RigidStop, ...]]  # pyright: ignore
    units: ClassVar = {"": "1"}  # pyright: ignore
    _known: _Known | None = eqx.field(default_factory=lambda: None, init=False, repr=False)

    @property
    @abc.abstractmethod
    def forces(self) -> tuple[Any, Any, Any]:
        """f₀, f₁ and f₂, each (n,), or `None` for none."""

    @property
    def size(self) -> int:
        """n, the number of degrees of freedom."""
        return jnp.shape(self.mass)[-1]

    @property
    def _stops(self) -> tuple[RigidStop, ...]:
        return self.contacts

    @property
    def rows(self) -> list[Float[Array, " n"]]:
        """c of each coordinate; without contacts the first displacement is what extremes are of."""
        rows = [stop.at for stop in self.contacts if stop.at is not None]
        return rows or [jnp.eye(1, self.size)[0]]

    @property
    def coordinates(self) -> tuple[Coordinate, ...]:
        """One for each contact: the sum c·x of displacements that it limits."""
        mobile = [self._accelerated(c) for c in self.rows]
        masses = [1 / jnp.dot(c, m) for c, m in zip(self.rows, mobile, strict=True)]
        pushes = [m * one for m, one in zip(mobile, masses, strict=True)]
        return tuple(along(*x) for x in zip(self.rows, pushes, masses, strict=True))

    @property
    def cycle(self) -> Scalar:
        """The period 2π/ω of the force."""
        return 2 * jnp.pi / self.frequency

    @property
    def labels(self) -> tuple[str, str]:
        """Axis labels of position and velocity."""
        return ("x of contact 0", "dx/ds") if self.contacts else ("x[0]", "dx[0]/ds")

    def field(self, s: Scalar, state: StructureState) -> StructureState:
        """d(state)/ds between impacts."""
        x, v = state.displacement, state.velocity
        pull = harmonic(self.forces, self.frequency * s, x) - times(self.stiffness, x)
        if self.damping is not None:
            pull = pull - times(self.damping, v)
        return StructureState(v, self._accelerated(pull))

    def _accelerated(self, force: Float[Array, " n"]) -> Float[Array, " n"]:
        """The accelerations M⁻¹ f that a force on the displacements causes."""
        known = None if self._known is None else self._known.inverse
        return solved(self.mass, force) if known is None else known @ force

    def start(self, *, displacement: Number = 0.0, velocity: Number = 0.0) -> StructureState:
        """A state; at rest in x = 0 by default.

        **Arguments:** (n,) each, or one number for all.

        **Raises:** `ValueError` for arrays of another shape.
        """
        given = {"displacement": displacement, "velocity": velocity}
        found = []
        for name, value in given.items():
            value = number(name, value)
            if value.shape not in ((), (self.size,)):
                raise ValueError(
                    f"Argument `{name}` must have the shape ({self.size},), one number for each "
                    f"degree of freedom, but has {value.shape}."
                )
            found.append(jnp.broadcast_to(value, (self.size,)))
        return StructureState(*found)

    def adopt(self, start: State) -> StructureState:
        """**Raises:** `TypeError` for a state of another kind, `ValueError` for one of other n."""
        return self.in_cycle_state("start", start)

    def in_cycle_state(self, name: str, state: State) -> StructureState:
        """A state of this machine; `name` is the argument that messages blame."""
        if not isinstance(state, StructureState):
            raise TypeError(
                f"Argument `{name}` must be a state of a {type(self).__name__}, from its "
                f"`start(displacement=..., velocity=...)`, but got {state!r}."
            )
        for part, value in vars(state).items():
            if jnp.shape(value) != (self.size,):
                raise ValueError(
                    f"Argument `{name}` must have n = {self.size} numbers in its {part}, but that "
                    f"has the shape {jnp.shape(value)}."
                )
        return state

    def step_limit(self, s: Scalar, state: StructureState) -> Scalar:
        """A fifth of the shortest period, of the modes or the force."""
        if self._known is not None:
            return self._known.longest
        return self.natural_modes().machine.step_limit(s, state)

    def mirrored(self, state: StructureState) -> StructureState | None:
        """x → -x half a cycle later, where no constant force acts and each stop has its image."""
        steady, alike = self.forces[0], [without_row(stop) for stop in self.contacts]
        pressed = None if steady is None else concrete(steady)
        if steady is not None and (pressed is None or pressed.any()):
            return None
        for stop in alike:
            others = (x for x in alike if x.coordinate == stop.coordinate)
            if not any(stop.mirrors(x) for x in others):
                return None
        return StructureState(-state.displacement, -state.velocity)

    def natural_modes(self) -> Modes:
        """The natural modes, and the machine in them."""
        return modal(self)

    def prepared(self) -> Prepared:
        """The machine in its natural modes, unless a subclass moves, or meets events, by rules of
        its own."""
        if changed(self, LinearMachine, _IN_MODES):
            return Prepared(self._with_known())
        return self.prepared_modes()

    def _with_known(self) -> "LinearMachine":
        """The machine with what none of its steps has to work out: in a lane's steps there is no
        vector code for eigenvalues, and to solve by M takes its cube each time."""
        longest = stop_gradient(self.step_limit(jnp.zeros(()), self.start()))
        inverse = None if self.mass.ndim == 1 else jnp.linalg.inv(self.mass)
        known = _Known(inverse, longest)
        return eqx.tree_at(lambda m: m._known, self, known, is_leaf=lambda x: x is None)

    def prepared_modes(self) -> Prepared:
        """The machine in its natural modes, and the ways there and back."""
        found = self.natural_modes()

        def inward(state: StructureState) -> StructureState:
            return StructureState(found.into(state.displacement), found.into(state.velocity))

        def outward(state: StructureState) -> StructureState:
            return StructureState(found.out_of(state.displacement), found.out_of(state.velocity))

        return Prepared(found.machine, inward, outward)
