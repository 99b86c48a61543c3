"""Settings that hold within a `with` block, in this thread and task alone, and what is kept."""

import threading
from collections import OrderedDict
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


@contextmanager
def within(setting: ContextVar, value: Any):
    """`setting` has this value within this context."""
    token = setting.set(value)
    try:
        yield
    finally:
        setting.reset(token)


class Recent(Generic[K, V]):
    """The most recently used of some values by their keys, shared by all threads."""

    def __init__(self, most: int):
        self.most = most
        self._values: OrderedDict[K, V] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._values)

    def clear(self) -> None:
        """Let go of all."""
        with self._lock:
            self._values.clear()

    def get(self, key: K) -> V | None:
        """What was put there, if it is still kept."""
        with self._lock:
            value = self._values.get(key)
            if value is not None:
                self._values.move_to_end(key)
        return value

    def put(self, key: K, value: V) -> None:
        """Keep it, and let go of the one used longest ago."""
        with self._lock:
            self._values[key] = value
            self._values.move_to_end(key)
            while len(self._values) > self.most:
                self._values.popitem(last=False)
