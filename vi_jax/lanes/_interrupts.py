"""Ctrl-C while lanes run, on whatever thread XLA runs them.

Python handles a signal only in its main thread, between two instructions of its own
(https://docs.python.org/3/library/signal.html#execution-of-python-signal-handlers): not while that
thread waits within XLA, nor on XLA's threads; and an exception that leaves a function which C has
called through `ctypes` is printed and lost. So two functions of machine code are put between:
`count_interrupt`, the process's handler of the signal, counts interrupts and calls the handler that
was there before; `call_handler`, which XLA calls, calls the Python function until that has stored a
result.
"""

import atexit
import ctypes
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from ._code import engine_of
from ._shared import Recent, made_once

# The answer of a handler that has no error to report; `call_handler` below compares with it.
SUCCESS = 1

_TEXT = """
@count = global i32 0
@previous = global ptr null
@handler = global ptr null
@interrupt_again = global ptr null

define void @count_interrupt(i32 %signal) {
  %old = atomicrmw add ptr @count, i32 1 seq_cst
  %previous = load ptr, ptr @previous
  call void %previous(i32 %signal)
  ret void
}

define ptr @call_handler(ptr %frame) {
entry:
  %handler = load ptr, ptr @handler
  %out = alloca { ptr, i64, i64 }
  store { ptr, i64, i64 } zeroinitializer, ptr %out
  br label %ask
ask:
  call void %handler(ptr %frame, ptr %out)
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
  %interrupt_again = load ptr, ptr @interrupt_again
  call void %interrupt_again(i32 %taken)
  br label %end
end:
  %well = icmp eq ptr %answer, inttoptr (i64 1 to ptr)
  %error = select i1 %well, ptr null, ptr %answer
  ret ptr %error
}
"""

# Seconds between two looks of `Watch`'s thread at the count, and until it ends without calls.
_POLL, _LINGER = 0.05, 1.0


class HandlerResult(ctypes.Structure):
    """What the function behind `guard` stores for `call_handler`, whose `%out` it is."""

    _fields_ = [
        ("answer", ctypes.c_void_p),  # null: none yet; SUCCESS; or the address of XLA's error
        ("signal", ctypes.c_int64),  # to be raised again, or 0
        ("lost", ctypes.c_int64),  # 1 if the function was called before and left without an answer
    ]


class _Native(NamedTuple):
    """The machine code, its global variables, and C's functions for signal handlers."""

    engine: Any
    count: Any
    """How many interrupts there were."""
    previous: Any
    """The address of the handler that was there before."""
    count_interrupt: int
    """The address of the function that counts."""
    get: Any
    """`PyOS_getsig(number)`: the address of a signal's handler."""
    put: Any
    """`PyOS_setsig(number, address)`."""


# Programs are lowered on several threads. Of two engines the first would be dropped, although XLA
# may have the address of its code.
@made_once
def _native() -> _Native:
    engine = engine_of(_TEXT)
    place, number = ctypes.c_void_p, ctypes.c_int
    return _Native(
        engine,
        ctypes.c_int32.from_address(engine.get_global_value_address("count")),
        place.from_address(engine.get_global_value_address("previous")),
        engine.get_function_address("count_interrupt"),
        ctypes.PYFUNCTYPE(place, number)(("PyOS_getsig", ctypes.pythonapi)),
        ctypes.PYFUNCTYPE(place, number, place)(("PyOS_setsig", ctypes.pythonapi)),
    )


def guard(handler: object) -> int:
    """The address of a handler for XLA that calls this function until it has an answer.

    **Arguments:** `handler(frame, out)`, made by `ctypes`, which stores into `out`, a
    `HandlerResult`, the answer, and a signal that it took, which is then raised again. An exception
    that leaves it, such as a signal's between two instructions, leaves no answer: then it is called
    again, with `out.lost`.
    """
    engine = _native().engine
    for name, function in {
        "handler": handler, "interrupt_again": ctypes.pythonapi.PyErr_SetInterruptEx,
    }.items():  # fmt: skip
        address = engine.get_global_value_address(name)
        ctypes.c_void_p.from_address(address).value = ctypes.cast(function, ctypes.c_void_p).value
    return engine.get_function_address("call_handler")


def install_counter() -> None:
    """Count interrupts from now on; the handler that is there is called as before.

    Nothing is done where a program has a handler of its own, which may want the lanes to go on.
    """
    if not interrupt_raises():
        return
    native = _native()
    there = native.get(signal.SIGINT)
    if there == native.count_interrupt or native.previous.value not in (None, there):
        return
    if native.previous.value is None:
        native.previous.value = there
        atexit.register(_remove_counter)
    native.put(signal.SIGINT, native.count_interrupt)


def _remove_counter() -> None:
    """At exit, when the machine code's memory is freed before the process ends."""
    native = _native()
    if native.get(signal.SIGINT) == native.count_interrupt:
        native.put(signal.SIGINT, native.previous.value)


def interrupt_count() -> int:
    """How many interrupts there have been since `install_counter`."""
    return _native().count.value


def interrupt_raises() -> bool:
    """Whether Ctrl-C raises `KeyboardInterrupt`, which ends what the main thread does."""
    return signal.getsignal(signal.SIGINT) is signal.default_int_handler


# The count when each of XLA's runs came to its first lanes, by the run's number: an interrupt
# between two calls of one run is meant for those that follow.
_counts_at_start: "Recent[int, int]" = Recent(256)


class Watch:
    """Stops lanes at Ctrl-C that run on threads to which Python brings no signals.

    One thread looks at the count as long as there are such calls.
    """

    def __init__(self):
        self._lock = threading.Lock()
        self._stops: dict[int, tuple[int, Any]] = {}
        self._thread: threading.Thread | None = None

    @contextmanager
    def stopping(self, run: int, stop: Any) -> Iterator[None]:
        """Within this context an interrupt sets `stop` to 1; at once if there was one since this
        run of XLA's came to its first lanes.

        **Arguments:** XLA's number of the run; the `ctypes` number that the kernel reads.
        """
        install_counter()
        begun = _counts_at_start.get(run)
        if begun is None:
            begun = interrupt_count()
            _counts_at_start.put(run, begun)
        if interrupt_count() != begun and interrupt_raises():
            stop.value = 1
        with self._lock:
            self._stops[id(stop)] = (begun, stop)
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._poll, name="lanes-interrupts", daemon=True
                )
                self._thread.start()
        try:
            yield
        finally:
            with self._lock:
                del self._stops[id(stop)]

    def _poll(self) -> None:
        last = time.monotonic()
        while True:
            time.sleep(_POLL)
            with self._lock:
                if self._stops:
                    last = time.monotonic()
                    counted = interrupt_count()
                    late = [stop for begun, stop in self._stops.values() if counted != begun]
                    if late and interrupt_raises():
                        for stop in late:
                            stop.value = 1
                elif time.monotonic() - last > _LINGER:
                    self._thread = None
                    return


watch = Watch()


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
