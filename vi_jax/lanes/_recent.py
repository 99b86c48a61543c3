"""What is kept of what was made, as long as it is in use."""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


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


def once(make: Callable[[], V]) -> Callable[[], V]:
    """A function that makes something the first time, whichever thread asks: of two that ask at
    once `functools.cache` would let both make it, and drop one that may be in use."""
    lock, kept = threading.Lock(), functools.cache(make)

    @functools.wraps(make)
    def made() -> V:
        with lock:
            return kept()

    return made
