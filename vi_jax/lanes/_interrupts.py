"""Ctrl-C while lanes run, on whatever thread XLA runs them, and a way out that says so.

Python hears a signal in its main thread alone, between two instructions of its own: not while that
thread waits within XLA, nor on XLA's threads; and an exception that comes out of a function which C
has called is lost. So a few lines of machine code stand before Python on both ways. One counts the
signals as they come, and passes them on. The other passes XLA's calls on, and does not return to
XLA before it has an answer.
"""

import atexit
import ctypes
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from ._code import engine_of
from ._recent import Recent, once

# As `guarded` and `struck` below have it.
WELL = 1

_TEXT = """
@strokes = global i32 0
@before = global ptr null
@python = global ptr null
@again = global ptr null

define void @struck(i32 %signal) {
  %old = atomicrmw add ptr @strokes, i32 1 seq_cst
  %before = load ptr, ptr @before
  call void %before(i32 %signal)
  ret void
}

define ptr @guarded(ptr %frame) {
entry:
  %python = load ptr, ptr @python
  %out = alloca { ptr, i64, i64 }
  store { ptr, i64, i64 } zeroinitializer, ptr %out
  br label %ask
ask:
  call void %python(ptr %frame, ptr %out)
  %lost = getelementptr { ptr, i64, i64 }, ptr %out, i64 0, i32 2
  store i64 1, ptr %lost
  %answer = load ptr, ptr %out
  %none = icmp eq ptr %answer, null
  br i1 %none, label %ask, label %answered
answered:
  %place = getelementptr { ptr, i64, i64 }, ptr %out, i64 0, i32 1
  %signal = load i64, ptr %place
  %taken = trunc i64 %signal to i32
  %is = icmp ne i32 %taken, 0
  br i1 %is, label %raise, label %end
raise:
  %again = load ptr, ptr @again
  call void %again(i32 %taken)
  br label %end
end:
  %well = icmp eq ptr %answer, inttoptr (i64 1 to ptr)
  %error = select i1 %well, ptr null, ptr %answer
  ret ptr %error
}
"""

# How often those who run lanes are told of a stroke, and how long the one who tells them waits for
# others to come (seconds).
_LOOK, _LINGER = 0.05, 1.0


class Out(ctypes.Structure):
    """What the function behind `guard` tells, and is told."""

    _fields_ = [
        ("answer", ctypes.c_void_p), ("signal", ctypes.c_int64), ("lost", ctypes.c_int64),
    ]  # fmt: skip


class _Native(NamedTuple):
    """The machine code, what it keeps, and how Python tells it of signals."""

    engine: Any
    strokes: Any
    before: Any
    struck: int
    get: Any
    """What C calls when a signal comes."""
    put: Any


# Programs are lowered on several threads. Of two engines the first, whose code XLA may know by
# then, would be dropped.
@once
def _native() -> _Native:
    engine = engine_of(_TEXT)
    place, number = ctypes.c_void_p, ctypes.c_int
    return _Native(
        engine,
        ctypes.c_int32.from_address(engine.get_global_value_address("strokes")),
        place.from_address(engine.get_global_value_address("before")),
        engine.get_function_address("struck"),
        ctypes.PYFUNCTYPE(place, number)(("PyOS_getsig", ctypes.pythonapi)),
        ctypes.PYFUNCTYPE(place, number, place)(("PyOS_setsig", ctypes.pythonapi)),
    )


def guard(python: Any) -> int:
    """The address of a handler for XLA that calls this function until it has an answer.

    **Arguments:** `python(frame, out)`, made by `ctypes`, which puts into `out` the answer (`WELL`,
    or the address of an error), and a signal that it took, which is then raised again. An exception
    that comes out of it, such as a signal's between two instructions, leaves no answer: then it is
    called again, with `out.lost`.
    """
    engine = _native().engine
    for name, function in {
        "python": python, "again": ctypes.pythonapi.PyErr_SetInterruptEx,
    }.items():  # fmt: skip
        address = engine.get_global_value_address(name)
        ctypes.c_void_p.from_address(address).value = _pointer(function)
    return engine.get_function_address("guarded")


def _pointer(function: Any) -> int:
    found = ctypes.cast(function, ctypes.c_void_p).value
    assert found is not None
    return found


def listen() -> None:
    """Count strokes of Ctrl-C from now on; what hears them already does so as before.

    Nothing is done where a program has a handler of its own, which may want the work to go on.
    """
    if not raises():
        return
    native = _native()
    there = native.get(signal.SIGINT)
    if there == native.struck or native.before.value not in (None, there):
        return
    if native.before.value is None:
        native.before.value = there
        atexit.register(_deaf)
    native.put(signal.SIGINT, native.struck)


def _deaf() -> None:
    """The machine code goes with the process's memory."""
    native = _native()
    if native.get(signal.SIGINT) == native.struck:
        native.put(signal.SIGINT, native.before.value)


def strokes() -> int:
    """How many there have been."""
    return _native().strokes.value


def raises() -> bool:
    """Whether Ctrl-C raises `KeyboardInterrupt`, and so ends what the main thread does."""
    return signal.getsignal(signal.SIGINT) is signal.default_int_handler


# What was counted as each of XLA's runs came to its first lanes: a stroke between two of its calls
# is meant for those that follow.
_begun: "Recent[int, int]" = Recent(256)


class Watch:
    """Tells those who run lanes of Ctrl-C, on threads that hear nothing of it."""

    def __init__(self):
        self._lock = threading.Lock()
        self._stops: dict[int, tuple[int, Any]] = {}
        self._thread: threading.Thread | None = None

    @contextmanager
    def told(self, run: int, stop: Any) -> Iterator[None]:
        """Within it `stop`, a number that C sees, becomes 1 if there is a stroke; at once if there
        was one since this run of XLA's came to its first lanes."""
        listen()
        begun = _begun.get(run)
        if begun is None:
            begun = strokes()
            _begun.put(run, begun)
        if strokes() != begun and raises():
            stop.value = 1
        with self._lock:
            self._stops[id(stop)] = (begun, stop)
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._look, name="lanes-interrupts", daemon=True
                )
                self._thread.start()
        try:
            yield
        finally:
            with self._lock:
                del self._stops[id(stop)]

    def _look(self) -> None:
        last = time.monotonic()
        while True:
            time.sleep(_LOOK)
            with self._lock:
                if self._stops:
                    last = time.monotonic()
                    counted = strokes()
                    if any(counted != begun for begun, _ in self._stops.values()) and raises():
                        for begun, stop in self._stops.values():
                            if counted != begun:
                                stop.value = 1
                elif time.monotonic() - last > _LINGER:
                    self._thread = None
                    return


watch = Watch()
