"""A pause of the garbage collector, without a library that takes time to load."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


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
