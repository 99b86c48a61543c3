"""vi_jax: differentiable, vectorised simulation of vibro-impact systems."""

import ast
import importlib
from pathlib import Path
from typing import Any

from ._collection import without_collection

# The names of the stub with the packages that they are loaded from on first access, so that
# `import vi_jax` is quick and a simulation never loads matplotlib.
_HOMES = {
    alias.name: node.module
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text("utf-8")).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def _loaded(module: str) -> Any:
    with without_collection():
        return importlib.import_module(f".{module}", __name__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _loaded("_messages").installed_version()
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = _HOMES[name]
    if home is None:
        return _loaded(name)
    value = getattr(_loaded(home), name)
    return globals().setdefault(name, value)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
