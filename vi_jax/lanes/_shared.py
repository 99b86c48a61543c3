"""Caches that threads share, and settings of one thread or task."""

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
        with self._lock:
            self._values.clear()

    def get(self, key: K) -> V | None:
        with self._lock:
            value = self._values.get(key)
            if value is not None:
                self._values.move_to_end(key)
        return value

    def put(self, key: K, value: V) -> None:
        with self._lock:
            self._values[key] = value
            self._values.move_to_end(key)
            while len(self._values) > self.most:
                self._values.popitem(last=False)


def call_once(make: Callable[[], V]) -> Callable[[], V]:
    """Decorator: call the function once, in the first thread that needs it, and keep its value.

    With `functools.cache` two concurrent calls could both run the function. One of the two values
    would be dropped although it may be in use.
    """
    lock, cached = threading.Lock(), functools.cache(make)

    @functools.wraps(make)
    def call() -> V:
        with lock:
            return cached()

    return call


@contextmanager
def set_within(setting: ContextVar, value: object) -> Iterator[None]:
    """Set `setting` to a value within this context, for this thread and task only."""
    token = setting.set(value)
    try:
        yield
    finally:
        setting.reset(token)
