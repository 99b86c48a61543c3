"""A machine as one step sees it: in its modes, with the bodies held that rest."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ..scene import AbstractScene, Coordinate, RigidStop
from ..scene.contacts import held_flow
from ..scene.event import rubs
from ..scene.switch import field_in

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]


class Moving(AbstractScene):
    """What a step asks of a machine whose field depends on more than its state."""

    scene: AbstractScene
    modes: tuple[Scalar, ...]
    contact: tuple[Scalar, ...]
    """Of each coordinate, 1 + i while it rests on stop number i, else 0; or none at all."""
    stops: tuple[RigidStop, ...]

    @property
    def cycle(self):
        """That of the machine."""
        return self.scene.cycle

    def field(self, s: Scalar, state: Any, *modes: Scalar) -> Any:
        """d(state)/ds, without motion of a body that is held."""
        flow = field_in(self.scene, s, state, self.modes)
        limited = sorted({stop.coordinate for stop in self.stops})
        if not self.contact:
            return flow
        if len(limited) > 1 or rubs(self.scene):
            return held_flow(self.scene, flow, state, self.modes, self.contact)[0]
        for k in limited:
            still, rests = _held_still(self.scene.coordinates[k], state, flow), self.contact[k] > 0
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


def in_modes(scene: AbstractScene, modes: tuple[Scalar, ...]) -> AbstractScene:
    """The machine with its modes as they are; itself where it has none."""
    return Moving(scene=scene, modes=modes, contact=(), stops=scene.stops) if modes else scene


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
    others = (x if j != but else jnp.zeros_like(x) for j, x in enumerate(contact))
    return Moving(scene=scene, modes=modes, contact=tuple(others), stops=scene.stops)


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
