"""vi_jax: differentiable, vectorised simulation of vibro-impact systems."""

from typing import Any

from ._loading import on_first_access

# `import vi_jax` is quick, and a simulation never loads matplotlib.
__all__, _load = on_first_access(__name__, __file__)  # pyright: ignore


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from ._messages import installed_version

        return installed_version()
    return globals().setdefault(name, _load(name))


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
