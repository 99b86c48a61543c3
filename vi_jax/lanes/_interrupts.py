"""Ctrl-C while lanes run on any of XLA's threads.

Python handles a signal only in its main thread, between two Python instructions
(https://docs.python.org/3/library/signal.html#execution-of-python-signal-handlers). So signals
wait while that thread is within XLA, and XLA's threads get none. Also, an exception that leaves a
`ctypes` function called from C is printed and lost. So there are two functions of machine code.
`count_interrupt` is the process's signal handler: it counts interrupts and calls the previous
handler. XLA calls `call_handler`, which calls a Python function until that has stored a result.
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
from ._shared import Recent, call_once

# The answer of a handler without an error; `call_handler` below compares with it.
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

# Seconds between two checks of the count in `Watch`'s thread, and until an idle thread ends.
_POLL, _LINGER = 0.05, 1.0


class HandlerResult(ctypes.Structure):
    """The output of the function behind `guard`: `%out` in `call_handler`."""

    _fields_ = [
        ("answer", ctypes.c_void_p),  # null: no answer yet; SUCCESS; or the address of XLA's error
        ("signal", ctypes.c_int64),  # a signal to raise again, or 0
        ("lost", ctypes.c_int64),  # 1 if an earlier call of the function left no answer
    ]


class _Native(NamedTuple):
    """The machine code, its global variables, and C's functions for signal handlers."""

    engine: Any
    count: Any
    """The number of interrupts so far."""
    previous: Any
    """The address of the previous handler."""
    count_interrupt: int
    """The address of the counting function."""
    get: Any
    """`PyOS_getsig(number)`: the address of a signal's handler."""
    put: Any
    """`PyOS_setsig(number, address)`."""


# Programs are lowered on several threads. With two engines, the first would be freed while XLA may
# have the address of its code.
@call_once
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
    """Return the address of a handler for XLA that calls `handler(frame, out)`, made by `ctypes`,
    until it has an answer. The handler stores into `out`, a `HandlerResult`, its answer and a
    signal that it caught, which is then raised again. An exception that leaves it, such as one
    raised by a signal, leaves no answer. Then it is called again, with `out.lost` set."""
    engine = _native().engine
    for name, function in {
        "handler": handler, "interrupt_again": ctypes.pythonapi.PyErr_SetInterruptEx,
    }.items():  # fmt: skip
        address = engine.get_global_value_address(name)
        ctypes.c_void_p.from_address(address).value = ctypes.cast(function, ctypes.c_void_p).value
    return engine.get_function_address("call_handler")


def install_counter() -> None:
    """Count interrupts from now on, and keep calling the previous handler.

    If a program has its own handler, nothing is installed: it may want the lanes to continue.
    """
    if not interrupt_raises():
        return
    native = _native()
    current = native.get(signal.SIGINT)
    if current == native.count_interrupt or native.previous.value not in (None, current):
        return
    if native.previous.value is None:
        native.previous.value = current
        atexit.register(_remove_counter)
    native.put(signal.SIGINT, native.count_interrupt)


def _remove_counter() -> None:
    """Restore the handler at exit, since the machine code is freed before the process ends."""
    native = _native()
    if native.get(signal.SIGINT) == native.count_interrupt:
        native.put(signal.SIGINT, native.previous.value)


def interrupt_count() -> int:
    return _native().count.value


def interrupt_raises() -> bool:
    """Return whether Ctrl-C raises `KeyboardInterrupt` in the main thread."""
    return signal.getsignal(signal.SIGINT) is signal.default_int_handler


# The count at the first lanes of each of XLA's runs, by the run's number. An interrupt between two
# calls of one run stops the later calls.
_counts_at_start: "Recent[int, int]" = Recent(256)


class Watch:
    """Stops lanes at Ctrl-C that run on threads to which Python delivers no signals.

    One thread checks the count during such calls.
    """

    def __init__(self):
        self._lock = threading.Lock()
        self._stops: dict[int, tuple[int, Any]] = {}
        self._thread: threading.Thread | None = None

    @contextmanager
    def stopping(self, run: int, stop: Any) -> Iterator[None]:
        """Set `stop`, which the kernel reads, to 1 on an interrupt within this context; at once if
        there was one since the first lanes of this run of XLA."""
        install_counter()
        count_at_start = _counts_at_start.get(run)
        if count_at_start is None:
            count_at_start = interrupt_count()
            _counts_at_start.put(run, count_at_start)
        if interrupt_count() != count_at_start and interrupt_raises():
            stop.value = 1
        with self._lock:
            self._stops[id(stop)] = (count_at_start, stop)
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
                    count = interrupt_count()
                    stops = [stop for first, stop in self._stops.values() if count != first]
                    if stops and interrupt_raises():
                        for stop in stops:
                            stop.value = 1
                elif time.monotonic() - last > _LINGER:
                    self._thread = None
                    return


watch = Watch()


# Not empty if an interrupt was dropped during the package's current call.
_dropped: list[bool] = []


@contextmanager
def raise_interrupts_within() -> Iterator[None]:
    """Raise an interrupt that Python drops within this context, at its end at the latest. One
    dropped earlier within an outer context is raised at the beginning.

    An exception in a callback of the garbage collector is printed and dropped, and JAX has such a
    callback. Other exceptions that Python drops are shown as before.
    """
    if threading.current_thread() is not threading.main_thread():  # others get no interrupts
        yield
        return
    raise_dropped()
    previous = sys.unraisablehook

    def record_dropped(unraisable: Any, /) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            _dropped.append(True)
        else:
            previous(unraisable)

    sys.unraisablehook = record_dropped
    try:
        yield
        raise_dropped()
    except Exception:  # such as the error of stopped lanes
        raise_dropped()
        raise
    finally:
        sys.unraisablehook = previous
        if getattr(previous, "__module__", None) != __name__:  # the outermost context
            _dropped.clear()


def raise_dropped() -> None:
    if interrupt_dropped():
        _dropped.clear()
        raise KeyboardInterrupt


def interrupt_dropped() -> bool:
    """Return whether Python dropped an interrupt that `raise_dropped` has not raised yet."""
    return bool(_dropped)
