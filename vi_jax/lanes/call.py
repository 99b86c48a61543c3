"""The way from a compiled XLA program into a kernel: a foreign-function handler made by ctypes.

The call frame is read as XLA's `ffi/api/c_api.h` lays it out, whose version the handler states.
"""

import ctypes
import signal
import threading
from contextlib import contextmanager
from ctypes import POINTER, Structure, c_char_p, c_int, c_int32, c_int64, c_size_t, c_void_p

import jax
import numpy as np

from ._interrupts import WELL, Out, guard, raises, watch
from ._recent import once
from .runtime import Work, living

TARGET = "vi_jax_lanes"

INTERRUPTED = "Lanes were interrupted before all of them had ended."

# Of the interface that is written out below.
_MAJOR, _MINOR = 0, 3

_METADATA, _EXECUTE, _CANCELLED, _INTERNAL = 1, 3, 1, 13


@contextmanager
def interruptible():
    """An interrupt while lanes run, of which XLA makes an error, is a `KeyboardInterrupt` again."""
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


class _Version(Structure):
    _fields_ = [
        ("struct_size", c_size_t), ("extension", c_void_p), ("major", c_int), ("minor", c_int),
    ]  # fmt: skip


class _Metadata(Structure):
    _fields_ = [("struct_size", c_size_t), ("version", _Version)]


class _MetadataExtension(Structure):
    _fields_ = [("base", _Extension), ("metadata", POINTER(_Metadata))]


class _Buffer(Structure):
    _fields_ = [
        ("struct_size", c_size_t), ("extension", c_void_p), ("dtype", c_int), ("data", c_void_p),
        ("rank", c_int64), ("dims", POINTER(c_int64)),
    ]  # fmt: skip


class _Buffers(Structure):
    _fields_ = [
        ("struct_size", c_size_t), ("extension", c_void_p), ("size", c_int64),
        ("types", c_void_p), ("items", POINTER(POINTER(_Buffer))),
    ]  # fmt: skip


class _ErrorArguments(Structure):
    _fields_ = [
        ("struct_size", c_size_t), ("extension", c_void_p), ("message", c_char_p), ("code", c_int),
    ]  # fmt: skip


# Functions of the interface between that which makes errors and that which tells runs apart.
_BETWEEN = 15


class _Api(Structure):
    _fields_ = [
        ("struct_size", c_size_t), ("extension", c_void_p), ("version", _Version),
        ("internal", c_void_p),
        ("error_create", ctypes.CFUNCTYPE(c_void_p, POINTER(_ErrorArguments))),
        ("others", c_void_p * _BETWEEN), ("run_get", c_void_p),
    ]  # fmt: skip


class _Run(Structure):
    _fields_ = [
        ("struct_size", c_size_t), ("extension", c_void_p), ("context", c_void_p),
        ("number", c_int64),
    ]  # fmt: skip


_RunGetter = ctypes.CFUNCTYPE(c_void_p, POINTER(_Run))


class _Frame(Structure):
    _fields_ = [
        ("struct_size", c_size_t), ("extension", POINTER(_Extension)), ("api", POINTER(_Api)),
        ("context", c_void_p), ("stage", c_int), ("arguments", _Buffers), ("results", _Buffers),
    ]  # fmt: skip


def _failed(frame: _Frame, message: str, code: int) -> int | None:
    arguments = _ErrorArguments(
        ctypes.sizeof(_ErrorArguments), None, message.encode(errors="replace"), code
    )
    return frame.api.contents.error_create(ctypes.byref(arguments))


# Of calls that are under way, by the address of XLA's frame.
_works: dict[int, Work] = {}


@ctypes.CFUNCTYPE(None, POINTER(_Frame), POINTER(Out))
def _handler(frame, out):
    """Called until it has put an answer there (see `guard`)."""
    out, frame = out.contents, frame.contents
    out.answer = _answered(frame, out)  # the last that a signal can come before


def _answered(frame: _Frame, out: Out) -> int | None:
    try:
        if out.lost:
            raise KeyboardInterrupt
        return _answer(frame)
    except KeyboardInterrupt:
        _left(frame)
        if threading.current_thread() is threading.main_thread() and raises():
            out.signal = signal.SIGINT
        return _failed(frame, INTERRUPTED, _CANCELLED)
    except BaseException as error:  # nothing may escape into XLA
        _left(frame)
        return _failed(frame, f"{type(error).__name__}: {error}", _INTERNAL)


def _answer(frame: _Frame) -> int | None:
    extension = frame.extension
    while extension:
        if extension.contents.type == _METADATA:
            metadata = ctypes.cast(extension, POINTER(_MetadataExtension)).contents.metadata
            metadata.contents.version.major, metadata.contents.version.minor = _MAJOR, _MINOR
            return WELL
        extension = extension.contents.next
    return _run(frame) if frame.stage == _EXECUTE else WELL


def _left(frame: _Frame) -> None:
    """Nothing of this call is under way any more."""
    work = _works.get(ctypes.addressof(frame))
    if work is not None:
        work.leave()
        del _works[ctypes.addressof(frame)]


def _run(frame: _Frame) -> int | None:
    arguments, results = frame.arguments, frame.results
    head = arguments.items[0].contents
    # Which kernel, how many lanes, and the strides of the inputs, as pairs of 32 bits.
    numbers = np.ctypeslib.as_array(
        ctypes.cast(head.data, POINTER(c_int32)), (2 * (arguments.size + 1),)
    )
    key, lanes, *strides = (int(x) for x in numbers.view(np.int64))
    kernel = living(key)
    if kernel is None:
        return _failed(frame, "The kernel of this program is not of this process.", _INTERNAL)
    inputs = [arguments.items[i].contents.data or 0 for i in range(1, arguments.size)]
    outputs = [results.items[i].contents.data or 0 for i in range(results.size)]
    work = _works[ctypes.addressof(frame)] = kernel.work(inputs, strides, outputs, lanes)
    if threading.current_thread() is threading.main_thread():
        well = work.run()
    else:
        with watch.told(_run_of(frame), work.stop):
            well = work.run()
    del _works[ctypes.addressof(frame)]
    if well:
        return WELL
    if work.stop.value:
        return _failed(frame, INTERRUPTED, _CANCELLED)
    return _failed(frame, "Not all lanes were run.", _INTERNAL)


def _run_of(frame: _Frame) -> int:
    """A number of XLA's run; 0 where XLA does not tell."""
    api = frame.api.contents
    if api.struct_size < _Api.run_get.offset + ctypes.sizeof(c_void_p) or not api.run_get:
        return 0
    run = _Run(ctypes.sizeof(_Run), None, frame.context, 0)
    _RunGetter(api.run_get)(ctypes.byref(run))
    return run.number


@once
def registered() -> str:
    """The name by which XLA knows the handler; registered on first use, whichever thread's."""
    handler = ctypes.c_void_p(guard(_handler))
    jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(handler), platform="cpu", api_version=1)
    return TARGET


def header(key: int, lanes: int, strides: list[int]) -> np.ndarray:
    """The first argument of a call; of 32 bits, since 64 may be switched off."""
    return np.asarray([key, lanes, *strides], np.int64).view(np.int32)
