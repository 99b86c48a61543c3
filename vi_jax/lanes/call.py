"""Calls of a kernel from a compiled XLA program, by a foreign-function handler made with ctypes.

The structures are those of XLA's `xla/ffi/api/c_api.h`, version 0.3. jaxlib 0.10.2 has this header
in `jax.ffi.include_dir()`; its source is
https://github.com/openxla/xla/blob/main/xla/ffi/api/c_api.h. The handler states its version when
XLA registers it. XLA promises to support each version for twelve months, and refuses unsupported
ones. The handler also refuses an XLA that states other sizes of these structures. Programs then run
on XLA's backend, after a warning.
"""

import ctypes
import signal
import threading
import zlib
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from ctypes import POINTER, Structure, c_char_p, c_int, c_int32, c_int64, c_size_t, c_void_p

import jax
import numpy as np

from ._interrupts import SUCCESS, HandlerResult, guard, interrupt_dropped, interrupt_raises, watch
from ._shared import call_once
from ._tape import OUT_OF_MEMORY
from ._vector import Unsupported
from .runtime import KernelCall, kernel_by_key

TARGET = "vi_jax_lanes"

INTERRUPTED = "Lanes were interrupted before all of them had ended."
_NO_ROOM = (
    "The tape of this gradient needs more than 4 GiB in a thread, or more memory than there is. "
    "Simulate fewer cycles at once, or differentiate forward (`jax.jacfwd`)."
)

# The version of the interface that has these structures.
_MAJOR, _MINOR = 0, 3

# `XLA_FFI_Extension_Metadata`, `XLA_FFI_ExecutionStage_EXECUTE`, three of `XLA_FFI_Error_Code`.
_METADATA, _EXECUTE, _CANCELLED, _EXHAUSTED, _INTERNAL = 1, 3, 1, 8, 13


@contextmanager
def interruptible():
    """Raise `KeyboardInterrupt` instead of XLA's error for interrupted lanes."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        if INTERRUPTED in str(error):
            raise KeyboardInterrupt from None
        raise


class _Extension(Structure):
    pass


_Extension._fields_ = [
    ("struct_size", c_size_t), ("type", c_int), ("next", POINTER(_Extension)),
]  # fmt: skip


class _Sized(Structure):
    _fields_ = [("struct_size", c_size_t), ("extension", c_void_p)]


class _Version(_Sized):
    _fields_ = [("major", c_int), ("minor", c_int)]


class _Metadata(Structure):
    _fields_ = [("struct_size", c_size_t), ("version", _Version)]


class _MetadataExtension(Structure):
    _fields_ = [("base", _Extension), ("metadata", POINTER(_Metadata))]


class _Buffer(_Sized):
    _fields_ = [
        ("dtype", c_int), ("data", c_void_p), ("rank", c_int64), ("dims", POINTER(c_int64)),
    ]  # fmt: skip


class _Buffers(_Sized):
    _fields_ = [("size", c_int64), ("types", c_void_p), ("items", POINTER(POINTER(_Buffer)))]


class _ErrorArguments(_Sized):
    _fields_ = [("message", c_char_p), ("code", c_int)]


# The number of functions in `XLA_FFI_Api` between `XLA_FFI_Error_Create` and `XLA_FFI_RunId_Get`.
_BETWEEN = 15


class _Api(_Sized):
    _fields_ = [
        ("version", _Version), ("internal", c_void_p),
        ("error_create", ctypes.CFUNCTYPE(c_void_p, POINTER(_ErrorArguments))),
        ("others", c_void_p * _BETWEEN), ("run_get", c_void_p),
    ]  # fmt: skip


class _Run(_Sized):
    _fields_ = [("context", c_void_p), ("number", c_int64)]


_RunGetter = ctypes.CFUNCTYPE(c_void_p, POINTER(_Run))


class _Frame(Structure):
    _fields_ = [
        ("struct_size", c_size_t), ("extension", POINTER(_Extension)), ("api", POINTER(_Api)),
        ("context", c_void_p), ("stage", c_int), ("arguments", _Buffers), ("results", _Buffers),
    ]  # fmt: skip


def _error(frame: _Frame, message: str, code: int) -> int | None:
    """Return the address of a new XLA error, which XLA frees."""
    arguments = _ErrorArguments(
        ctypes.sizeof(_ErrorArguments), None, message.encode(errors="replace"), code
    )
    return frame.api.contents.error_create(ctypes.byref(arguments))


# Running calls, by the address of XLA's call frame.
_running: dict[int, KernelCall] = {}


@ctypes.CFUNCTYPE(None, POINTER(_Frame), POINTER(HandlerResult))
def _handler(frame, out):
    """Store the answer of a call. `call_handler` repeats it until there is one (see `guard`)."""
    out, frame = out.contents, frame.contents
    # An exception of a signal before this assignment leaves no answer. After it, Python raises it.
    out.answer = _answer_without_exceptions(frame, out)


def _answer_without_exceptions(frame: _Frame, out: HandlerResult) -> int | None:
    try:
        if out.lost or interrupt_dropped():
            raise KeyboardInterrupt
        return _answer(frame)
    except KeyboardInterrupt:
        _end_threads(frame)
        in_main = threading.current_thread() is threading.main_thread()
        # An interrupt that was dropped is raised by the current call, when it gets XLA's error.
        if in_main and interrupt_raises() and not interrupt_dropped():
            out.signal = signal.SIGINT
        return _error(frame, INTERRUPTED, _CANCELLED)
    except BaseException as error:
        _end_threads(frame)
        return _error(frame, f"{type(error).__name__}: {error}", _INTERNAL)


def _answer(frame: _Frame) -> int | None:
    """Answer XLA's query for metadata with the version; else run the kernel."""
    extension = frame.extension
    while extension:
        if extension.contents.type == _METADATA:
            metadata = ctypes.cast(extension, POINTER(_MetadataExtension)).contents.metadata
            version = metadata.contents.version
            # XLA refuses a handler of version -1.
            version.major, version.minor = (_MAJOR if _has_known_sizes(frame) else -1), _MINOR
            return SUCCESS
        extension = extension.contents.next
    return _run_kernel(frame) if frame.stage == _EXECUTE else SUCCESS


def _has_known_sizes(frame: _Frame) -> bool:
    """Return whether XLA states the expected sizes. Its frame may be longer."""
    size = ctypes.sizeof(_Buffers)
    sizes = frame.arguments.struct_size, frame.results.struct_size
    return frame.struct_size >= ctypes.sizeof(_Frame) and sizes == (size, size)


def _end_threads(frame: _Frame) -> None:
    work = _running.get(ctypes.addressof(frame))
    if work is not None:
        work.stop_and_wait()
        del _running[ctypes.addressof(frame)]


def _run_kernel(frame: _Frame) -> int | None:
    """Run all lanes of a call, or a NumPy function. The first argument is `header`, the others are
    the inputs."""
    arguments, results = frame.arguments, frame.results
    head = arguments.items[0].contents
    numbers = np.ctypeslib.as_array(
        ctypes.cast(head.data, POINTER(c_int32)), (2 * (arguments.size + 2),)
    )
    key, lanes, *sizes = (int(x) for x in numbers.view(np.int64))
    if key < 0:
        return _run_numpy(frame, _numpy_functions[key])
    kernel = kernel_by_key(key)
    if kernel is None:
        return _error(frame, "The kernel of this program is not of this process.", _INTERNAL)
    inputs = [arguments.items[i].contents.data or 0 for i in range(1, arguments.size)]
    outputs = [results.items[i].contents.data or 0 for i in range(results.size)]
    work = _running[ctypes.addressof(frame)] = KernelCall(kernel, inputs, sizes, outputs, lanes)
    if threading.current_thread() is threading.main_thread():
        succeeded = work.run()
    else:
        with watch.stopping(_run_number(frame), work.stop):
            succeeded = work.run()
    del _running[ctypes.addressof(frame)]
    if succeeded:
        return SUCCESS
    if work.stop.value == OUT_OF_MEMORY:
        return _error(frame, _NO_ROOM, _EXHAUSTED)
    if work.stop.value:
        return _error(frame, INTERRUPTED, _CANCELLED)
    return _error(frame, "Not all lanes were run.", _INTERNAL)


# NumPy's functions that programs call, by negative keys.
_numpy_functions: dict[int, Callable[..., Sequence[np.ndarray]]] = {}

# Types of numbers in `XLA_FFI_DataType`: F32, F64.
_TYPES = {11: ctypes.c_float, 12: ctypes.c_double}


def numpy_key(function: Callable[..., Sequence[np.ndarray]]) -> int:
    """Return the key of a NumPy function, the same in all processes, so that JAX's cache may keep
    the program."""
    key = -1 - zlib.crc32(f"{function.__module__}.{function.__qualname__}".encode())
    _numpy_functions[key] = function
    return key


def _run_numpy(frame: _Frame, function: Callable[..., Sequence[np.ndarray]]) -> int:
    def array(buffer: _Buffer) -> np.ndarray:
        data = ctypes.cast(buffer.data, POINTER(_TYPES[buffer.dtype]))
        return np.ctypeslib.as_array(data, buffer.dims[: buffer.rank])

    arguments, results = frame.arguments, frame.results
    found = function(*(array(arguments.items[i].contents) for i in range(1, arguments.size)))
    for i, x in enumerate(found):
        array(results.items[i].contents)[...] = x
    return SUCCESS


def _run_number(frame: _Frame) -> int:
    """Return XLA's number of the run with this call, or 0 if this XLA does not provide it."""
    api = frame.api.contents
    if api.struct_size < _Api.run_get.offset + ctypes.sizeof(c_void_p) or not api.run_get:
        return 0
    run = _Run(ctypes.sizeof(_Run), None, frame.context, 0)
    _RunGetter(api.run_get)(ctypes.byref(run))
    return run.number


@call_once
def register_handler() -> str:
    """Register the handler with XLA on first use, on any thread, and return its name.

    **Raises:** `Unsupported` if this XLA refuses the handler's version.
    """
    handler = jax.ffi.pycapsule(ctypes.c_void_p(guard(_handler)))
    try:
        jax.ffi.register_ffi_target(TARGET, handler, platform="cpu", api_version=1)
    except RuntimeError as error:  # `jax.errors.JaxRuntimeError`
        raise Unsupported(f"version {_MAJOR}.{_MINOR} of XLA's call interface ({error})") from None
    return TARGET


def header(key: int, lanes: int, rows: int, strides: list[int]) -> np.ndarray:
    """Return the first argument of a call: the kernel's key, the number of lanes, the greatest
    number of rows, and the numbers per lane of each input (0 for a shared one). Each is stored as
    two 32-bit integers, since JAX may be set to use no 64-bit ones."""
    return np.asarray([key, lanes, rows, *strides], np.int64).view(np.int32)
