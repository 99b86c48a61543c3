"""Names that are loaded on first access, and a pause of the garbage collector, without a library
that takes time to load."""

import ast
import gc
import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def without_collection() -> Iterator[None]:
    """Pause the garbage collection within this context. Importing, tracing and compiling leave
    little garbage but create so many objects that the collector would run again and again, for a
    tenth of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def on_first_access(package: str, file: str) -> tuple[list[str], Callable[[str], Any]]:
    """Return the names that the stub beside a package's `__init__` imports, and a `__getattr__`
    that loads them."""
    homes = {
        alias.name: node.module
        for node in ast.parse(Path(file).with_suffix(".pyi").read_text("utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home = homes[name]
        with without_collection():
            module = importlib.import_module(f".{home or name}", package)
        return module if home is None else getattr(module, name)

    return sorted(homes), load
