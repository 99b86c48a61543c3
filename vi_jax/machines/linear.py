"""Machines that are linear between impacts: M x'' + C x' + K x = f₀ + f₁ cos ωs + f₂ sin ωs.

A run uses their natural modes, in which a step costs O(n) and is a closed form. With M = L Lᵀ and
L⁻¹ K L⁻ᵀ = U κ Uᵀ, the columns of T = σ⁻¹ L⁻ᵀ U are the modes. The length σ makes their largest
number 1. With x = T q, M x'' + C x' + K x = f becomes q'' + c q' + κ q = σ² Tᵀ f. These are
separate equations for the modes, but for the off-diagonal part of c.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from .._checks import concrete, number
from .._types import Flag, Number, Scalar, Scalars, State
from ..machine import (
    AbstractMachine,
    Coordinate,
    Prepared,
    RigidStop,
    Shown,
    convert_start,
    in_cycle_state,
    overridden,
    prepared,
)

Numbers = Float[Array, " n"]
Matrix = Float[Array, "n n"]

# Off-diagonal damping below this number of roundings of the largest entry counts as zero. Damping
# in proportion to mass and stiffness leaves 6 with 40 modes, and more if masses differ more.
_UNCOUPLED = 500
# A mode whose κ is below this number of roundings of the largest is a rigid-body motion, with κ =
# 0: a choice, by the error of the eigenvalues.
_RIGID = 16
# Closer to a resonance than this, |κ - ω² + iωc| over κ + ω², the steady response and the free
# motion cancel in more than three digits.
_RESONANT = 1e-3
# The same for a constant force, κ over ω².
_SOFT = 1e-3


class Coupling(NamedTuple):
    """Parts of stiffness and damping that couple one mode with another."""

    stiffness: Matrix
    """Zero, with nonzero derivatives."""
    damping: Matrix
    on: Scalar
    """1 with coupling, or if derivatives with respect to it are needed; else 0."""


class ModalMachine(AbstractMachine):
    """A linear machine in its natural modes, with a `StructureState` of modal components."""

    stops: tuple[RigidStop, ...]  # pyright: ignore
    frequency: Scalar
    stiffness: Numbers
    """κ of each mode, per unit of mass."""
    damping: Numbers
    """Diagonal of the damping c, per unit of mass."""
    modal_frequency: Numbers
    """√|κ|, the frequency of each mode."""
    inverse_frequency: Numbers
    """1/√|κ|; 1 for a rigid-body motion."""
    swing: Numbers
    """√(κ - c²/4), the frequency of a damped mode, or 1 without oscillation; no derivatives."""
    swing_time: Numbers
    """1/`swing`."""
    oscillates: Scalar
    """1 if all modes oscillate, else 0."""
    all_decay: Scalar
    """1 if all modes oscillate and none grows, else 0."""
    fastest: Scalar
    """A bound of all rates."""
    coupling: Coupling | None
    forces: tuple[Numbers | None, Numbers | None, Numbers | None]
    """The constant, cosine and sine forces, per unit of mass."""
    steady: tuple[Numbers, Numbers, Numbers] | None
    """The steady response: constant, cosine and sine; `None` without forces."""
    plain: Scalar
    """1 if free flight is the closed form: modes uncoupled, none in resonance; else 0."""
    rows: tuple[Numbers, ...]
    """The coefficient of each mode in each coordinate."""
    pushes: tuple[Numbers, ...]
    """The change of the velocities for a unit change of each coordinate's velocity."""
    masses: Scalars

    @property
    def cycle(self) -> Scalar:
        return 2 * jnp.pi / self.frequency

    @property
    def _stops(self) -> tuple[RigidStop, ...]:
        return self.stops

    @property
    def coordinates(self) -> tuple[Coordinate, ...]:
        return tuple(coordinate(*x) for x in zip(self.rows, self.pushes, self.masses, strict=True))

    def force(self, s: Scalar) -> Numbers:
        """Return the forces on the modes, per unit of mass."""
        return harmonic(self.forces, self.frequency * s, self.stiffness)

    def coupled(self, q: Numbers, p: Numbers) -> Numbers:
        """Return the coupling forces between modes."""
        if self.coupling is None:
            return jnp.zeros_like(q)
        found = self.coupling
        return jax.lax.cond(
            found.on > 0,
            lambda q, p: found.stiffness @ q + found.damping @ p,
            lambda q, p: jnp.zeros_like(q),
            q, p,
        )  # fmt: skip

    def field(self, s: Scalar, state: State) -> Any:
        q, p = state.displacement, state.velocity
        pull = self.force(s) - self.stiffness * q - self.damping * p - self.coupled(q, p)
        return type(state)(p, pull)

    def step_limit(self, s: Scalar, state: State) -> Scalar:
        """Return a fifth of the shortest period, of the modes or the force."""
        # A choice, as for soft stops (`SoftStop.longest_step`).
        return 0.4 * jnp.pi / jnp.maximum(jnp.max(self.modal_frequency), self.frequency)

    def relaxation(self, s: Scalar, state: State) -> Scalar:
        tiny = 1e-6 / self.cycle
        return 1 / jnp.maximum(jnp.max(jnp.abs(self.damping)), tiny)


def coordinate(row: Numbers, push: Numbers, mass: Scalar) -> Coordinate:
    """Return the coordinate c·x; `row` is c, `push` M⁻¹c/(cᵀM⁻¹c), and `mass` 1/(cᵀM⁻¹c)."""

    def placed(state: State, Y: Scalar, V: Scalar) -> Any:
        x, v = state.displacement, state.velocity
        return type(state)(x + push * (Y - jnp.dot(row, x)), v + push * (V - jnp.dot(row, v)))

    return Coordinate(
        lambda state: jnp.dot(row, state.displacement),
        lambda state: jnp.dot(row, state.velocity),
        placed,
        mass,
    )


def harmonic(parts: Any, angle: Scalar, like: Numbers) -> Numbers:
    """Return the sum of a constant and multiples of cosine and sine; each may be `None`."""
    total = jnp.zeros_like(like)
    steady, cosine, sine = parts
    total = total if steady is None else total + steady
    total = total if cosine is None else total + cosine * jnp.cos(angle)
    return total if sine is None else total + sine * jnp.sin(angle)


def times(matrix: Any, x: Numbers) -> Numbers:
    """Return the product of a matrix, or of the diagonal of one, with a vector."""
    return matrix * x if matrix.ndim == 1 else matrix @ x


def solved(matrix: Any, x: Numbers) -> Numbers:
    """Solve a linear system with a matrix, or the diagonal of one."""
    return x / matrix if matrix.ndim == 1 else jnp.linalg.solve(matrix, x)


class _Basis(NamedTuple):
    """Modes, and the equations in them."""

    shapes: Matrix | None
    """The shapes of the modes as columns; `None` if the machine's coordinates are its modes."""
    into: Matrix | None
    inverse: Numbers
    """The factors of forces on modes."""
    stiffness: Numbers
    damping: Numbers
    coupling: Coupling | None
    fastest: Scalar


def modal(machine: Any) -> Prepared:
    """Return a linear machine in its natural modes (see the top of this file)."""
    loss = machine.damping
    terms = machine.mass, jnp.zeros(machine.size) if loss is None else loss, machine.stiffness
    found = _diagonal_basis(*terms) if all(x.ndim == 1 for x in terms) else _modal_basis(*terms)
    omega = machine.frequency

    def in_modes(f: Any) -> Any:  # a force, or a row, in modal components
        return f if f is None or found.shapes is None else f @ found.shapes

    modal_forces = [None if f is None else found.inverse * in_modes(f) for f in machine.forces]
    forces = modal_forces[0], modal_forces[1], modal_forces[2]
    steady, resonant = _steady(forces, found, omega)
    plain = ~resonant
    if found.coupling is not None:
        plain = plain & (found.coupling.on == 0)
    rows = tuple(in_modes(c) for c in machine.rows)
    responses = [found.inverse * c for c in rows]
    masses = tuple(1 / jnp.dot(c, m) for c, m in zip(rows, responses, strict=True))
    kappa, c = stop_gradient((found.stiffness, found.damping))
    frequency, square = jnp.sqrt(jnp.abs(kappa)), kappa - 0.25 * c * c
    swing = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    modal_machine = ModalMachine(
        stops=tuple(without_row(stop) for stop in machine.contacts),
        frequency=omega,
        stiffness=found.stiffness,
        damping=found.damping,
        modal_frequency=frequency,
        inverse_frequency=1 / jnp.where(frequency > 0, frequency, 1.0),
        swing=swing,
        swing_time=1 / swing,
        oscillates=jnp.where(jnp.all(square > 0), 1.0, 0.0).astype(frequency.dtype),
        all_decay=jnp.where(jnp.all((square > 0) & (c >= 0)), 1.0, 0.0).astype(frequency.dtype),
        fastest=stop_gradient(jnp.maximum(found.fastest, omega)),
        coupling=found.coupling,
        forces=forces,
        steady=steady,
        plain=jnp.where(plain, 1.0, 0.0).astype(frequency.dtype),
        rows=rows,
        pushes=tuple(m * mass for m, mass in zip(responses, masses, strict=True)),
        masses=masses,
    )
    shapes, into = found.shapes, found.into

    def inward(state: StructureState) -> StructureState:
        return state if into is None else StructureState(*(into @ x for x in vars(state).values()))

    def outward(state: StructureState) -> StructureState:
        if shapes is None:
            return state
        return StructureState(*(shapes @ x for x in vars(state).values()))

    return Prepared(modal_machine, inward, outward)


def without_row(stop: RigidStop) -> RigidStop:
    """Return the same stop without its `at`."""
    return stop if stop.at is None else eqx.tree_at(lambda x: x.at, stop, None)


def _diagonal_basis(mass: Numbers, damping: Numbers, stiffness: Numbers) -> _Basis:
    """Return the basis of a machine with diagonal matrices: its coordinates are its modes."""
    kappa, c = stiffness / mass, damping / mass
    fastest = jnp.max(jnp.sqrt(jnp.abs(kappa))) + jnp.max(jnp.abs(c))
    return _Basis(None, None, 1 / mass, kappa, c, None, fastest)


def _modal_basis(mass: Any, damping: Any, stiffness: Any) -> _Basis:
    """Return the modes of mass and stiffness, with all coupling between them."""
    M, C, K = (jnp.diag(x) if x.ndim == 1 else x for x in (mass, damping, stiffness))
    n, eps = M.shape[0], jnp.finfo(M.dtype).eps
    L = jnp.linalg.cholesky(M)
    identity = jnp.eye(n, dtype=M.dtype)
    inverse = jax.lax.linalg.triangular_solve(L, identity, left_side=True, lower=True)
    K_modal, C_modal = inverse @ K @ inverse.T, inverse @ C @ inverse.T
    U = stop_gradient(jnp.linalg.eigh(stop_gradient(0.5 * (K_modal + K_modal.T)))[1])
    K_modal, C_modal = U.T @ K_modal @ U, U.T @ C_modal @ U
    kappa, c = jnp.diag(K_modal), jnp.diag(C_modal)
    rigid = jnp.abs(kappa) <= _RIGID * n * eps * jnp.max(jnp.abs(kappa))
    kappa = kappa - stop_gradient(jnp.where(rigid, kappa, 0.0))
    K_coupling = K_modal - jnp.diag(jnp.diag(K_modal))
    C_coupling = C_modal - jnp.diag(c)
    largest = jnp.max(jnp.abs(stop_gradient(C_modal)))
    is_coupled = jnp.max(jnp.abs(stop_gradient(C_coupling))) > _UNCOUPLED * eps * largest
    C_coupling = C_coupling - jnp.where(is_coupled, 0.0, stop_gradient(C_coupling))
    on = jnp.maximum(jnp.where(is_coupled, 1.0, 0.0), _one_if_differentiated(M, C, K))
    fastest = jnp.max(jnp.sqrt(jnp.abs(kappa))) + jnp.sqrt(jnp.sum(stop_gradient(C_modal) ** 2))
    shapes = inverse.T @ U
    scale = stop_gradient(jnp.max(jnp.abs(shapes)))
    coupling = Coupling(K_coupling - stop_gradient(K_coupling), C_coupling, on.astype(M.dtype))
    square = jnp.full((n,), scale * scale, M.dtype)
    return _Basis(shapes / scale, scale * (U.T @ L.T), square, kappa, c, coupling, fastest)


@jax.custom_jvp
def _one_if_differentiated(*matrices: Any) -> Scalar:
    """Return 1 under differentiation with respect to a machine's matrices, else 0. The modes are
    then coupled by zeros with nonzero derivatives."""
    return jnp.zeros((), matrices[0].dtype)


@_one_if_differentiated.defjvp
def _(matrices, _):
    one = jnp.ones((), matrices[0].dtype)
    return one, jnp.zeros_like(one)


def _steady(forces: Any, found: _Basis, omega: Scalar) -> tuple[Any, Flag]:
    """Return the steady response to constant, cosine and sine, and whether a mode is close to
    resonance. There it would cancel against the free motion, and is zero."""
    if all(f is None for f in forces):
        return None, jnp.zeros((), bool)
    kappa, c = found.stiffness, found.damping
    zero = jnp.zeros_like(kappa)
    constant, cosine, sine = (zero if f is None else f for f in forces)
    is_soft = stop_gradient(jnp.abs(kappa) <= _SOFT * omega**2)
    detune, drag = kappa - omega**2, omega * c
    square = detune**2 + drag**2
    size = _RESONANT * (jnp.abs(kappa) + omega**2)
    is_resonant = stop_gradient(square <= size**2)
    scale = jnp.where(is_resonant, 0.0, 1 / jnp.where(is_resonant, 1.0, square))
    steady = (
        jnp.where(is_soft, 0.0, constant / jnp.where(is_soft, 1.0, kappa)),
        scale * (cosine * detune - sine * drag),
        scale * (sine * detune + cosine * drag),
    )
    is_driven = is_resonant & ((cosine != 0) | (sine != 0))
    return steady, jnp.any(is_driven | (is_soft & (constant != 0)))


class StructureState(Shown):
    """Displacements and velocities of a machine with n degrees of freedom."""

    displacement: Float[Array, "..."]
    """x, one number for each degree of freedom."""
    velocity: Float[Array, "..."]
    """dx/ds, one number for each degree of freedom."""


class _Known(NamedTuple):
    """Values for each step of a machine with a subclass's methods, computed once."""

    inverse: Float[Array, "n n"] | None
    """M⁻¹; `None` for a diagonal M."""
    longest: Scalar
    """The longest step, a fifth of the shortest period of the modes or the force."""


# Members that `ModalMachine` does not take over from a subclass.
_IN_MODES = (
    "field", "_accelerated", "events", "averages", "renewed", "coordinates", "position",
    "velocity", "placed", "cycle", "pace", "step_limit", "relaxation",
)  # fmt: skip


class LinearMachine(AbstractMachine):
    """A machine of n degrees of freedom that is linear between impacts:

        M x'' + C x' + K x = f₀ + f₁ cos ωs + f₂ sin ωs

    with M symmetric and positive definite, C and K symmetric. Time is the independent variable s, a
    cycle 2π/ω. Stops limit sums c·x of the displacements. A restitution k takes v to v - (1 + k)
    (c·v) M⁻¹c/(cᵀM⁻¹c), so that the effective mass of an impact is 1/(cᵀM⁻¹c).

    A run uses the natural modes, which are computed once for each run (`prepared`). `ExactFlight`
    has no step error; every other method uses the field (`Taylor` only with diagonal matrices).

    Subclasses define `mass`, `damping` and `stiffness`, each (n, n), or (n,) for a diagonal one
    (`damping` may be `None`); `forces`; `frequency`; and `contacts`, a tuple of stops. Each has its
    c in `RigidStop.at`, or `None` and the number of an earlier c in `RigidStop.coordinate`.
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
        """f₀, f₁ and f₂, each (n,), or `None`."""

    @property
    def size(self) -> int:
        """The number n of degrees of freedom."""
        return jnp.shape(self.mass)[-1]

    @property
    def _stops(self) -> tuple[RigidStop, ...]:
        return self.contacts

    @property
    def rows(self) -> list[Float[Array, " n"]]:
        """c of each coordinate; without contacts the first displacement, for extremes."""
        rows = [stop.at for stop in self.contacts if stop.at is not None]
        return rows or [jnp.eye(1, self.size)[0]]

    @property
    def coordinates(self) -> tuple[Coordinate, ...]:
        responses = [self._accelerated(c) for c in self.rows]
        masses = [1 / jnp.dot(c, m) for c, m in zip(self.rows, responses, strict=True)]
        pushes = [m * mass for m, mass in zip(responses, masses, strict=True)]
        return tuple(coordinate(*x) for x in zip(self.rows, pushes, masses, strict=True))

    @property
    def cycle(self) -> Scalar:
        return 2 * jnp.pi / self.frequency

    @property
    def labels(self) -> tuple[str, str]:
        return ("x of contact 0", "dx/ds") if self.contacts else ("x[0]", "dx[0]/ds")

    def field(self, s: Scalar, state: StructureState) -> StructureState:
        x, v = state.displacement, state.velocity
        pull = harmonic(self.forces, self.frequency * s, x) - times(self.stiffness, x)
        if self.damping is not None:
            pull = pull - times(self.damping, v)
        return StructureState(v, self._accelerated(pull))

    def _accelerated(self, force: Float[Array, " n"]) -> Float[Array, " n"]:
        known = None if self._known is None else self._known.inverse
        return solved(self.mass, force) if known is None else known @ force

    def start(self, *, displacement: Number = 0.0, velocity: Number = 0.0) -> StructureState:
        """Return a state; at rest in x = 0 by default.

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

    def convert_start(self, start: State) -> StructureState:
        """**Raises:** `TypeError` for a state of another class, `ValueError` for one of other n."""
        return self.in_cycle_state("start", start)

    def in_cycle_state(self, name: str, state: State) -> StructureState:
        """Return a checked state of this machine; `name` is the argument's name in errors."""
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
        """Return a fifth of the shortest period, of the modes or the force."""
        if self._known is not None:
            return self._known.longest
        return modal(self).machine.step_limit(s, state)

    def mirrored(self, state: StructureState) -> StructureState | None:
        """Return -x half a cycle later, if no constant force acts and each stop has its image."""
        steady, stops = self.forces[0], [without_row(stop) for stop in self.contacts]
        known = None if steady is None else concrete(steady)
        if steady is not None and (known is None or known.any()):
            return None
        for stop in stops:
            others = (x for x in stops if x.coordinate == stop.coordinate)
            if not any(stop.mirrors(x) for x in others):
                return None
        return StructureState(-state.displacement, -state.velocity)

    def prepared(self) -> Prepared:
        """Return the machine in its modes, or as it is if a subclass overrides `_IN_MODES`."""
        if overridden(self, LinearMachine, *_IN_MODES):
            return Prepared(self._with_step_values())
        return modal(self)

    def _with_step_values(self) -> "LinearMachine":
        """Return the machine with values that its steps would compute: a lane's steps have no
        vector code for eigenvalues, and to solve by M takes n³ operations each time."""
        longest = stop_gradient(self.step_limit(jnp.zeros(()), self.start()))
        inverse = None if self.mass.ndim == 1 else jnp.linalg.inv(self.mass)
        known = _Known(inverse, longest)
        return eqx.tree_at(lambda m: m._known, self, known, is_leaf=lambda x: x is None)


# The defaults for other machines are in `machine.clocks`.
convert_start.register(LinearMachine, LinearMachine.convert_start)
in_cycle_state.register(LinearMachine, LinearMachine.in_cycle_state)
prepared.register(LinearMachine, LinearMachine.prepared)
