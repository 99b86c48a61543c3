"""Settings that hold within a `with` block, in this thread and task alone."""

from contextlib import contextmanager
from contextvars import ContextVar


@contextmanager
def within(setting: ContextVar, value: object):
    """`setting` has this value within this context."""
    token = setting.set(value)
    try:
        yield
    finally:
        setting.reset(token)
