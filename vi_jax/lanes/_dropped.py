"""Interrupts that Python drops: raised later, while a function of the package is at work."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# Not empty: an interrupt was dropped in the package's call under way.
_dropped: list[bool] = []


@contextmanager
def interrupts_heard() -> Iterator[None]:
    """Raise an interrupt that Python drops within this context, at its end at the latest, or one
    that it dropped before within an outer one.

    An exception in a callback of the garbage collector is printed and dropped, and JAX has such a
    callback. Others that Python drops are shown as before.
    """
    if threading.current_thread() is not threading.main_thread():  # no other gets interrupts
        yield
        return
    raise_dropped()
    before = sys.unraisablehook

    def noted(unraisable: Any, /) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            _dropped.append(True)
        else:
            before(unraisable)

    sys.unraisablehook = noted
    try:
        yield
        raise_dropped()
    except Exception:  # such as that of lanes that were ended
        raise_dropped()
        raise
    finally:
        sys.unraisablehook = before
        if getattr(before, "__module__", None) != __name__:  # the outermost context
            _dropped.clear()


def raise_dropped() -> None:
    """Raise the `KeyboardInterrupt` that Python dropped, if there is one."""
    if interrupt_dropped():
        _dropped.clear()
        raise KeyboardInterrupt


def interrupt_dropped() -> bool:
    """Whether Python dropped an interrupt that `raise_dropped` has not raised yet."""
    return bool(_dropped)
