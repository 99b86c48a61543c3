"""A machine as one step sees it: in its modes, with the bodies held that rest."""

from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ..scene import AbstractScene, RigidStop

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
        zero = jnp.zeros_like(s)
        for coordinate, held in zip(self.scene.coordinates, self.held, strict=False):
            still = coordinate.placed(flow, zero, zero)
            flow = jtu.tree_map(lambda a, b, held=held: jnp.where(held, a, b), still, flow)
        return flow

    def pace(self, s: Scalar, state: Any) -> Scalar | None:
        """That of the machine."""
        return self.scene.pace(s, state)


def in_modes(scene: AbstractScene, modes: tuple[Scalar, ...]) -> AbstractScene:
    """The machine with its modes as they are; itself where it has none."""
    return Moving(scene=scene, modes=modes, held=(), stops=scene.stops) if modes else scene


def begin_modes(scene: AbstractScene, s: Scalar, state: Any) -> tuple[Scalar, ...]:
    """The modes of a motion that begins in `state`."""
    return tuple(
        jnp.asarray(switch.begin(scene, s, state), jnp.result_type(s)) for switch in scene.switches
    )


def struck_modes(
    scene: AbstractScene, s: Scalar, state: Any, modes: tuple[Scalar, ...]
) -> tuple[Scalar, ...]:
    """The modes after an impact."""
    new = (x.struck(scene, s, state, m) for x, m in zip(scene.switches, modes, strict=True))
    return tuple(stop_gradient(jnp.asarray(mode, jnp.result_type(s))) for mode in new)


def exact(scene: AbstractScene, state: Any) -> bool:
    """Whether one number of the state is all that stops limit, so that it can be put on a stop
    without rounding; known while a step is traced."""
    place = scene.coordinates[0].position(state)
    own = any(place is x for x in jtu.tree_leaves(state))
    return own and len(scene.coordinates) == 1
