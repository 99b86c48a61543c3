"""Which method moves a scene, where the user leaves it open."""

from typing import Any

from ..scene import AbstractScene
from .exact import ExactFlight
from .methods import AbstractMethod


def chosen(
    scene: AbstractScene | None,
    method: Any,
    otherwise: AbstractMethod,
    *,
    argument: str = "method",
) -> AbstractMethod:
    """The method given; if that is `None`, `ExactFlight` where it applies, else `otherwise`.

    **Raises:** `TypeError` for what is no method. Whether the method can move the scene is not
    looked at: `AbstractMethod.check` says so.
    """
    if method is None:
        return ExactFlight() if scene is not None and _flies(scene) else otherwise
    if not isinstance(method, AbstractMethod):
        raise TypeError(
            f"Argument `{argument}` must be `Adaptive(...)`, `FixedStep(...)` or `ExactFlight()`, "
            f"but got {method!r}."
        )
    return method


def _flies(scene: AbstractScene) -> bool:
    try:
        ExactFlight().check(scene)
    except ValueError:
        return False
    return True
