"""Kernels for this processor: their width, their cache, and their calls on threads."""

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

from ._code import compile_in_background, llvm
from ._kernel import kernel_text
from ._program import LaneProgram
from ._reverse import ReverseProgram
from ._shared import Recent, set_within
from ._tape import reverse_text
from ._vector import check

# The number of kernels kept without a compiled program that uses them. A choice for notebooks, in
# which cells are run again.
_MOST_KERNELS = 64

# The most numbers in a lane's inputs and carry for groups of twice the width, by the bits of a
# register. Measured with AVX-512 (256 lanes on one core of an AMD EPYC). Savings for the motor:
# with extremes (36 numbers) 20 % of the time, by time (33) 10 %, with its log (49) 4 %, with its
# derivative with respect to one number none. With AVX2 only up to 32 numbers were measured.
_MOST_NUMBERS = {512: 64, 256: 32}

# Derivatives of so few lanes are compiled without LLVM's passes, which take half of its time. They
# run up to 9 % slower so, as the derivatives of a search for an orbit. Programs of values would run
# up to 29 % slower, and one lane would differ from the same lane of a batch by rounding.
_FEW_LANES = 2

# More than the cores of any machine; a process may not be granted as many threads.
_MOST_THREADS = 1024

# Seconds between two checks whether stopped threads have ended.
_POLL = 1e-3

# The program of a kernel.
AnyProgram = LaneProgram | ReverseProgram

_threads: ContextVar[int | None] = ContextVar("threads", default=None)
_entered: list[int] = []
_cpu: ContextVar[str | None] = ContextVar("cpu", default=None)


def threads(number: int) -> AbstractContextManager:
    """Run lanes on so many threads within this context (default: the cores of this process).

    XLA runs larger programs on its own threads, outside any context. Wait for their results before
    you leave the context. If several of your threads have such a context, the one entered last
    applies to XLA's threads.

    **Arguments:** `number` of threads, from 1 to 1,024.

    **Raises:** `TypeError` or `ValueError` for any other number.
    """
    if isinstance(number, bool) or not isinstance(number, int | np.integer):
        raise TypeError(f"Argument `number` must be an integer, but got {number!r}.")
    if not 1 <= number <= _MOST_THREADS:
        raise ValueError(f"Argument `number` must be from 1 to {_MOST_THREADS}, but got {number}.")
    return _threads_within(int(number))


@contextmanager
def _threads_within(number: int) -> Iterator[None]:
    with set_within(_threads, number):
        _entered.append(number)
        try:
            yield
        finally:
            _entered.remove(number)


def processor(name: str) -> AbstractContextManager:
    """Compile kernels for this processor (LLVM's name, such as `"x86-64-v3"`) within this context.
    The processor of this machine must be able to run its code."""
    return set_within(_cpu, name)


def thread_count() -> int:
    number = _threads.get()
    if number is None:
        number = next(reversed(_entered), None)
    return cores() if number is None else number


def cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


@functools.cache
def _register_bits(cpu: str | None) -> int:
    """Return the width of a processor's vector registers (LLVM's name, `None` for this one)."""
    if cpu is not None:
        return {"x86-64-v4": 512, "x86-64-v3": 256}.get(cpu, 128)
    features = llvm().get_host_cpu_features()
    if features.get("avx512f") and features.get("avx512dq") and features.get("avx512vl"):
        return 512
    return 256 if features.get("avx2") else 128


class Kernel:
    """The machine code of a program for groups of `width` lanes. It is compiled on another thread
    and lives as long as this object."""

    def __init__(self, text: str, cpu: str | None, width: int, passes: bool = True):
        self.key, self.width = key_of(text, cpu, passes), width
        self._code = compile_in_background(text, cpu, passes)

    @functools.cached_property
    def function(self) -> Any:
        """The kernel as a `ctypes` function with the arguments of `_kernel.py`; raises
        `RuntimeError` if LLVM could not compile it."""
        try:
            self._engine, address = self._code.result()
        except RuntimeError as error:
            raise RuntimeError(f'LLVM: {error}; `vi_jax.backend("xla")` does without it') from None
        pointer = ctypes.c_void_p
        kind = ctypes.CFUNCTYPE(None, pointer, pointer, pointer, ctypes.c_int64, pointer, pointer)
        return kind(address)


class KernelCall:
    """One call of a kernel. It holds the memory that its threads use until they end. `sizes` are
    the greatest number of rows and the stride of each input: its numbers per lane, or 0 if all
    lanes share it."""

    def __init__(
        self, kernel: Kernel, inputs: list[int], sizes: list[int], outputs: list[int], lanes: int
    ):
        self._function, self._lanes = kernel.function, lanes
        self._table = (ctypes.c_void_p * max(1, len(inputs)))(*inputs)
        self._sizes = (ctypes.c_int64 * len(sizes))(*sizes)
        self._results = (ctypes.c_void_p * max(1, len(outputs)))(*outputs)
        self._next_lane, self.stop = ctypes.c_int64(0), ctypes.c_int8(0)
        self._arguments = (
            ctypes.addressof(self._table), ctypes.addressof(self._sizes),
            ctypes.addressof(self._results), lanes, ctypes.addressof(self._next_lane),
            ctypes.addressof(self.stop),
        )  # fmt: skip
        self._threads = min(thread_count(), -(-lanes // kernel.width))
        self._lock, self._running = threading.Lock(), 0

    def run(self) -> bool:
        """Run all lanes, on as many threads as have work. Return True if all have ended and the
        call was not stopped. Signals raise their exceptions in the main thread; then call
        `stop_and_wait`."""
        if self._threads == 1 and threading.current_thread() is not threading.main_thread():
            self._run_here()
        else:
            # The main thread must stay free to handle an interrupt.
            jobs = [_pool(self._threads).submit(self._run_here) for _ in range(self._threads)]
            for job in jobs:
                job.result()
        # Unless stopped, a thread takes lanes until none are left, and ends when its own have
        # ended.
        return self._next_lane.value >= self._lanes and not self.stop.value

    def _run_here(self) -> None:
        """Run lanes on one thread until none are left, unless the call was stopped before."""
        with self._lock:
            if self.stop.value:
                return
            self._running += 1
        try:
            self._function(*self._arguments)
        finally:
            with self._lock:
                self._running -= 1

    def stop_and_wait(self) -> None:
        """Stop the threads and wait for them. Call it again if a signal's exception leaves it."""
        with self._lock:
            self.stop.value = 1
        while self._running:
            time.sleep(_POLL)


@functools.cache
def _pool(number: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(number, thread_name_prefix="lanes")


def key_of(text: str, cpu: str | None, passes: bool = True) -> int:
    """Return a number for a program's text, a processor and LLVM's passes, equal in all
    processes."""
    content = text + (cpu or "") + ("" if passes else "without passes")
    digest = hashlib.blake2b(content.encode(), digest_size=7).digest()
    return int.from_bytes(digest, "little")


_in_use: "weakref.WeakValueDictionary[int, Kernel]" = weakref.WeakValueDictionary()
_recent: "Recent[int, Kernel]" = Recent(_MOST_KERNELS)
_lock = threading.Lock()

# The keys of a program's texts by processor and width, so that no text is written twice.
_keys: "weakref.WeakKeyDictionary[AnyProgram, dict[tuple, int]]" = weakref.WeakKeyDictionary()


def kernel_of(program: AnyProgram, lanes: int, one_for_all: tuple[bool, ...] = ()) -> Kernel:
    """Return the kernel of a program for a number of lanes. Equal texts share a kernel. Raise
    `Unsupported` if the program has no vector form, or LLVM is missing."""
    cpu = _cpu.get()
    bits = _register_bits(cpu)
    width = _width(program, lanes, bits)
    derived = isinstance(program, ReverseProgram) or any(program.tangents)
    # What is computed once, such as the sizes at the start, takes LLVM longer than it runs.
    passes = bool(program.carry_avals) and (not derived or lanes > _FEW_LANES)
    with _lock:
        keys = _keys.setdefault(program, {})
        kernel = _in_use.get(keys.get((cpu, passes, width, one_for_all), -1))
    if kernel is None:
        kernel = _new_kernel(program, cpu, passes, (width, bits, one_for_all))
        keys[cpu, passes, width, one_for_all] = kernel.key
    _recent.put(kernel.key, kernel)
    return kernel


def _width(program: AnyProgram, lanes: int, bits: int) -> int:
    """Return the lanes of a group: a power of two of at least 4. It does not change results."""
    avals = [*program.in_avals, *program.carry_avals]
    wide = any(np.dtype(a.dtype).itemsize == 8 for a in avals)
    # At least 4: two registers of 128 bits hide the latency of arithmetic.
    full = max(4, bits // (64 if wide else 32))
    if lanes <= full // 2:
        return max(4, full // 2)  # faster than a half-empty register
    # The operations of a step wait for each other. Two registers per operation save up to a quarter
    # of the time, if there are enough lanes for all cores.
    many = lanes >= 4 * full * cores()
    few_numbers = sum(a.size for a in avals) <= _MOST_NUMBERS.get(bits, 0)
    # A tape keeps its numbers in memory.
    return 2 * full if many and few_numbers and isinstance(program, LaneProgram) else full


def _new_kernel(
    program: AnyProgram, cpu: str | None, passes: bool, form: tuple[int, int, tuple[bool, ...]]
) -> Kernel:
    """Return a new kernel for arguments `form` of `kernel_text`, compiled if its text is new."""
    for jaxpr in program.jaxprs:
        check(jaxpr.jaxpr)
    backward = isinstance(program, ReverseProgram)
    text = reverse_text(program, *form) if backward else kernel_text(program, *form)
    key = key_of(text, cpu, passes)
    with _lock:
        kernel = _in_use.get(key)
        if kernel is None:
            kernel = _in_use[key] = Kernel(text, cpu, form[0], passes)
    return kernel


def kernel_by_key(key: int) -> Kernel | None:
    return _in_use.get(key)
