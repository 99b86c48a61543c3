"""From LLVM's text to machine code for this processor, and its call on several threads."""

import ctypes
import functools
import hashlib
import os
import threading
import time
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np

from ._code import begun, function_at, llvm
from ._context import within
from ._kernel import kernel_text
from ._program import LaneProgram
from ._recent import Recent
from ._vector import check

_KEPT = 64

# Of the vector unit; half as many where they are narrower, with half the lanes in each.
_REGISTERS = 32

# More than any machine has cores; a process may not be granted so many threads.
_MOST_THREADS = 1024

# Seconds between two looks at threads that are about to stop.
_PATIENCE = 1e-3

_threads: ContextVar[int | None] = ContextVar("threads", default=None)
_entered: list[int] = []
_cpu: ContextVar[str | None] = ContextVar("cpu", default=None)


def threads(number: int) -> AbstractContextManager:
    """Run lanes on so many threads within this context (default: the cores of this process).

    XLA runs larger programs on threads of its own, which belong to no context. Wait for what they
    compute before you leave; if several of your threads have such a context, the one entered last
    holds for all of them there.

    **Arguments:** `number` of threads, from 1 to 1,024.

    **Raises:** `TypeError` or `ValueError` for what is no such number.
    """
    if isinstance(number, bool) or not isinstance(number, int | np.integer):
        raise TypeError(f"Argument `number` must be an integer, but got {number!r}.")
    if not 1 <= number <= _MOST_THREADS:
        raise ValueError(f"Argument `number` must be from 1 to {_MOST_THREADS}, but got {number}.")
    return _threads_within(int(number))


@contextmanager
def _threads_within(number: int) -> Iterator[None]:
    with within(_threads, number):
        _entered.append(number)
        try:
            yield
        finally:
            _entered.remove(number)


def processor(name: str) -> AbstractContextManager:
    """Write machine code for this processor (in LLVM's words, such as `"x86-64-v3"`) within this
    context; it must be one that this one can stand in for."""
    return within(_cpu, name)


def thread_count() -> int:
    """Threads that lanes run on."""
    asked = _threads.get()
    if asked is None:
        asked = next(reversed(_entered), None)
    return cores() if asked is None else asked


def cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


@functools.cache
def _register_bits(cpu: str | None) -> int:
    """Width of the vector registers."""
    if cpu is not None:
        return {"x86-64-v4": 512, "x86-64-v3": 256}.get(cpu, 128)
    features = llvm().get_host_cpu_features()
    if features.get("avx512f") and features.get("avx512dq") and features.get("avx512vl"):
        return 512
    return 256 if features.get("avx2") else 128


class Kernel:
    """Machine code of a program, perhaps still to come. It lives as long as this object."""

    def __init__(self, text: str, cpu: str | None, width: int):
        self.key, self.width = key_of(text, cpu), width
        self._code = begun(text, cpu)

    @functools.cached_property
    def _call(self) -> Any:
        """**Raises:** `RuntimeError` if LLVM could not compile it."""
        try:
            self._engine, address = self._code.result()
        except RuntimeError as error:
            raise RuntimeError(f'LLVM: {error}; `vi_jax.backend("xla")` does without it') from None
        return function_at(address)

    def work(self, inputs: list[int], strides: list[int], outputs: list[int], lanes: int) -> "Work":
        """All lanes, from and to the arrays at these addresses."""
        return Work(self._call, self.width, inputs, strides, outputs, lanes)


class Work:
    """One call of a kernel: what its threads read and write, which must be kept until they end."""

    def __init__(self, call: Any, width: int, inputs, strides, outputs, lanes: int):
        self._function, self._lanes = call, lanes
        self._table = (ctypes.c_void_p * max(1, len(inputs)))(*inputs)
        self._steps = (ctypes.c_int64 * max(1, len(strides)))(*strides)
        self._results = (ctypes.c_void_p * max(1, len(outputs)))(*outputs)
        self._given, self.stop = ctypes.c_int64(0), ctypes.c_int8(0)
        self._arguments = (
            ctypes.addressof(self._table), ctypes.addressof(self._steps),
            ctypes.addressof(self._results), lanes, ctypes.addressof(self._given),
            ctypes.addressof(self.stop),
        )  # fmt: skip
        self._number = min(thread_count(), -(-lanes // width))
        self._lock, self._inside = threading.Lock(), 0

    def run(self) -> bool:
        """Whether all lanes have ended, and not been stopped.

        **Raises:** what a signal raises, in the main thread; then `leave` is to be called.
        """
        if self._number == 1 and threading.current_thread() is not threading.main_thread():
            self._turn()
        else:
            # The main thread must stay free to hear an interrupt.
            jobs = [_pool(self._number).submit(self._turn) for _ in range(self._number)]
            for job in jobs:
                job.result()
        # A thread takes lanes until none are left, and ends when its own have, if not stopped.
        return self._given.value >= self._lanes and not self.stop.value

    def _turn(self) -> None:
        """What one thread does: lanes until none are left, unless the work was stopped before."""
        with self._lock:
            if self.stop.value:
                return
            self._inside += 1
        try:
            self._function(*self._arguments)
        finally:
            with self._lock:
                self._inside -= 1

    def leave(self) -> None:
        """Stop, and wait until no thread is at work; to be called again if a signal comes."""
        with self._lock:
            self.stop.value = 1
        while self._inside:
            time.sleep(_PATIENCE)


@functools.cache
def _pool(number: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(number, thread_name_prefix="lanes")


def key_of(text: str, cpu: str | None) -> int:
    """A name of a program's text for a processor, the same in every process."""
    digest = hashlib.blake2b((text + (cpu or "")).encode(), digest_size=7).digest()
    return int.from_bytes(digest, "little")


_living: "weakref.WeakValueDictionary[int, Kernel]" = weakref.WeakValueDictionary()
_recent: "Recent[int, Kernel]" = Recent(_KEPT)
_lock = threading.Lock()

# The keys of a program's texts, so that they need not be written again to be known.
_keys: "weakref.WeakKeyDictionary[LaneProgram, dict[tuple, int]]" = weakref.WeakKeyDictionary()


def kernel_of(program: LaneProgram, lanes: int) -> Kernel:
    """The kernel of a program for so many lanes: the same for the same text, compiled once while it
    is in use.

    **Raises:** `Unsupported` if the program has no vector form, or LLVM cannot be had.
    """
    cpu = _cpu.get()
    bits = _register_bits(cpu)
    width = _width(program, lanes, bits)
    with _lock:
        keys = _keys.setdefault(program, {})
        kernel = _living.get(keys.get((cpu, width), -1))
    if kernel is None:
        kernel = _written(program, cpu, width, bits)
        keys[cpu, width] = kernel.key
    _recent.put(kernel.key, kernel)
    return kernel


def _width(program: LaneProgram, lanes: int, bits: int) -> int:
    """Lanes of a group. The width changes no result."""
    avals = [*program.in_avals, *program.carry_avals]
    wide = any(np.dtype(a.dtype).itemsize == 8 for a in avals)
    # Two registers' worth where they are narrow, to hide the arithmetic's latency.
    full = max(4, bits // (64 if wide else 32))
    if lanes <= full // 2:
        return max(4, full // 2)  # short registers are quicker
    # A step is a chain of operations that wait for each other: a second group fills the gaps, for a
    # quarter less time where there are lanes enough, and no more numbers than registers.
    many = bits >= 256 and lanes >= 4 * full * cores()
    return 2 * full if many and sum(a.size for a in avals) <= _REGISTERS else full


def _written(program: LaneProgram, cpu: str | None, width: int, bits: int) -> Kernel:
    for jaxpr in program.jaxprs:
        check(jaxpr.jaxpr)
    text = kernel_text(program, width, bits)
    key = key_of(text, cpu)
    with _lock:
        kernel = _living.get(key)
        if kernel is None:
            kernel = _living[key] = Kernel(text, cpu, width)
    return kernel


def living(key: int) -> Kernel | None:
    """The kernel of this name, if it is in use."""
    return _living.get(key)
