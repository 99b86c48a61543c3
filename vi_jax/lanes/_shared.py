"""What threads share: the values used last, values made once; and what one keeps to itself."""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class Recent(Generic[K, V]):
    """The `most` values that were used last, by their keys; safe to use from several threads."""

    def __init__(self, most: int):
        self.most = most
        self._values: OrderedDict[K, V] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._values)

    def clear(self) -> None:
        """Forget all values that are kept."""
        with self._lock:
            self._values.clear()

    def get(self, key: K) -> V | None:
        """The value of a key, or `None`."""
        with self._lock:
            value = self._values.get(key)
            if value is not None:
                self._values.move_to_end(key)
        return value

    def put(self, key: K, value: V) -> None:
        """Keep a value, and drop the one used longest ago if there are more than `most`."""
        with self._lock:
            self._values[key] = value
            self._values.move_to_end(key)
            while len(self._values) > self.most:
                self._values.popitem(last=False)


def made_once(make: Callable[[], V]) -> Callable[[], V]:
    """Decorator: the function is called once, whichever thread asks first, and its value kept.

    `functools.cache` would let two threads that ask at the same time both call it, and drop one of
    the values although it may be in use.
    """
    lock, kept = threading.Lock(), functools.cache(make)

    @functools.wraps(make)
    def made() -> V:
        with lock:
            return kept()

    return made


@contextmanager
def within(setting: ContextVar, value: object) -> Iterator[None]:
    """`setting` has this value within this context, in this thread and task alone."""
    token = setting.set(value)
    try:
        yield
    finally:
        setting.reset(token)
