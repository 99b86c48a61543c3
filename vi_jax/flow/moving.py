"""A machine as one step sees it: in its modes, with the bodies held that rest."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ..scene import AbstractScene, Coordinate, RigidStop

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]


class Moving(AbstractScene):
    """What a step asks of a machine whose field depends on more than its state."""

    scene: AbstractScene
    modes: tuple[Scalar, ...]
    held: tuple[Flag, ...]
    """Of each coordinate, whether it rests on a stop; or none at all."""
    stops: tuple[RigidStop, ...]

    @property
    def cycle(self):
        """That of the machine."""
        return self.scene.cycle

    def field(self, s: Scalar, state: Any, *modes: Scalar) -> Any:
        """d(state)/ds, without motion of a body that is held."""
        flow = self.scene.field(s, state, *self.modes)
        limited = {stop.coordinate for stop in self.stops}
        all_of_them = enumerate(zip(self.scene.coordinates, self.held, strict=False))
        held = [(coordinate, rests) for k, (coordinate, rests) in all_of_them if k in limited]
        if len(held) > 1:
            return _held_together(held, state, flow)
        for coordinate, rests in held:
            still = _held_still(coordinate, state, flow)
            flow = jtu.tree_map(lambda a, b, rests=rests: jnp.where(rests, a, b), still, flow)
        return flow

    def pace(self, s: Scalar, state: Any) -> Scalar | None:
        """That of the machine."""
        return self.scene.pace(s, state)

    def averages(self, s: Scalar, state: Any) -> dict[str, Any]:
        """Those of the machine."""
        return self.scene.averages(s, state, *self.modes)


def _held_still(coordinate: Coordinate, state: Any, flow: Any) -> Any:
    """The rate at which a state changes along `flow` while this coordinate keeps its place and
    velocity: the derivative of `placed`, which need not be linear (bodies with a radius, a contact
    that moves along with the state)."""
    place, velocity = coordinate.position(state), coordinate.velocity(state)
    zero = jnp.zeros_like(place)
    along = (state, place, velocity), (flow, zero, jnp.zeros_like(velocity))
    return jax.jvp(coordinate.placed, *along)[1]


def _held_together(held: list[tuple[Coordinate, Flag]], state: Any, flow: Any) -> Any:
    """The rate at which a state changes along `flow` while those coordinates that rest keep their
    velocities, all at once: contacts that share a body are held by forces that depend on each
    other.

    A contact's force changes the state as `placed` does with the velocity. How much of each there
    is, so that no velocity of a contact that rests changes, is a linear system as large as there
    are contacts.
    """
    pushes, rates = [], []
    for coordinate, _ in held:
        place, velocity = coordinate.position(state), coordinate.velocity(state)
        pushes.append(
            jax.jvp(
                lambda V, c=coordinate, Y=place: c.placed(state, Y, V),
                (velocity,),
                (jnp.ones_like(velocity),),
            )[1]
        )
        rates.append(_rate_of(coordinate, state, flow))
    rows = []
    for j, (coordinate, rests) in enumerate(held):
        row = []
        for k, ((_, other), push) in enumerate(zip(held, pushes, strict=True)):
            own = 1.0 if j == k else 0.0
            row.append(jnp.where(rests & other, _rate_of(coordinate, state, push), own))
        rows.append([*row, jnp.where(rests, rates[j], 0.0)])
    for force, push in zip(_solved(rows), pushes, strict=True):
        flow = jtu.tree_map(lambda a, b, force=force: a - force * b, flow, push)
    return flow


def _rate_of(coordinate: Coordinate, state: Any, flow: Any) -> Scalar:
    return jax.jvp(coordinate.velocity, (state,), (flow,))[1]


def _solved(rows: list[list[Scalar]]) -> list[Scalar]:
    """The solution of a small linear system, its right side as the last column. Its matrix is that
    of contacts' inverse masses, which needs no pivoting."""
    rows, n = [list(row) for row in rows], len(rows)
    for i in range(n):
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for j in range(n):
            if j != i:
                rows[j] = [a - rows[j][i] * b for a, b in zip(rows[j], rows[i], strict=True)]
    return [row[-1] for row in rows]


def in_modes(scene: AbstractScene, modes: tuple[Scalar, ...]) -> AbstractScene:
    """The machine with its modes as they are; itself where it has none."""
    return Moving(scene=scene, modes=modes, held=(), stops=scene.stops) if modes else scene


def holding(
    scene: AbstractScene,
    modes: tuple[Scalar, ...],
    contact: tuple[Scalar, ...] | None,
    but: int | None = None,
) -> AbstractScene:
    """The machine in its modes, with those bodies held that rest on a stop (see `Lane.contact`);
    that of coordinate number `but` is free."""
    if contact is None or (but is not None and len(contact) == 1):
        return in_modes(scene, modes)
    rests = tuple(x > 0 if but is None else (x > 0) & (j != but) for j, x in enumerate(contact))
    return Moving(scene=scene, modes=modes, held=rests, stops=scene.stops)


def exact(scene: AbstractScene, state: Any) -> bool:
    """Whether one number of the state is all that stops limit, so that it can be put on a stop
    without rounding; known while a step is traced."""
    place = scene.coordinates[0].position(state)
    own = any(place is x for x in jtu.tree_leaves(state))
    return own and len(scene.coordinates) == 1


def rounding(scene: AbstractScene, state: Any) -> Scalar | float:
    """How far a coordinate may be beyond its stop, or its velocity from zero, by rounding alone:
    not at all where it is a number of the state itself."""
    if exact(scene, state):
        return 0.0
    size = sum((jnp.sum(jnp.abs(x)) for x in jtu.tree_leaves(state)), start=jnp.asarray(1.0))
    return stop_gradient(16 * jnp.finfo(size.dtype).eps * size)
