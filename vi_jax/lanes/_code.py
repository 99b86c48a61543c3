"""Machine code of a program's text, made beside other work and kept between processes."""

import ctypes
import functools
import hashlib
import os
import tempfile
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax

from ._vector import Unsupported

_FOLDER = "vi_jax_lanes"


@functools.cache
def llvm() -> Any:
    """llvmlite's binding, ready for this processor. **Raises:** `Unsupported` without it."""
    try:
        import llvmlite.binding as binding
    except ImportError as error:
        raise Unsupported(f"no llvmlite ({error})") from None
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    try:
        # Once, so that a program can be sent the other backend before any is under way.
        _loaded(binding, compiled(binding, "define void @kernel() { ret void }", None))
    except RuntimeError as error:
        raise Unsupported(f"LLVM: {error}") from None
    return binding


def engine_of(text: str) -> Any:
    """The engine that holds the machine code of a text, which must be kept."""
    return _loaded(llvm(), compiled(llvm(), text, None))


def begun(text: str, cpu: str | None) -> Future:
    """The code of a text, to come: its engine, which must be kept, and the address of `kernel`."""
    return _worker().submit(_made, llvm(), text, cpu, _store())


@functools.cache
def _worker() -> ThreadPoolExecutor:
    # LLVM is one at a time by llvmlite's own lock, and leaves Python to others meanwhile.
    return ThreadPoolExecutor(1, "vi_jax-llvm")


def _made(binding: Any, text: str, cpu: str | None, store: Path | None) -> tuple[Any, int]:
    if store is None:
        return _kernel(_loaded(binding, compiled(binding, text, cpu)))
    words = (text, cpu, *_host(binding), binding.llvm_version_info)
    place = store / f"{hashlib.blake2b(repr(words).encode(), digest_size=20).hexdigest()}.o"
    code = _read(place)
    if code is None:
        code = compiled(binding, text, cpu)
        _write(place, code)
    return _kernel(_loaded(binding, code))


def _kernel(engine: Any) -> tuple[Any, int]:
    return engine, engine.get_function_address("kernel")


def _host(binding: Any) -> tuple[str, str]:
    return binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()


def compiled(binding: Any, text: str, cpu: str | None) -> bytes:
    """Object code of a text, for a processor in LLVM's words or for this one."""
    name, features = _host(binding) if cpu is None else (cpu, "")
    target = binding.Target.from_default_triple()
    machine = target.create_target_machine(cpu=name, features=features, opt=1)
    module = binding.parse_assembly(text)
    module.triple = binding.get_default_triple()
    module.data_layout = str(machine.target_data)
    options = binding.create_pipeline_tuning_options(speed_level=1)
    options.loop_vectorization = options.slp_vectorization = False
    options.loop_unrolling = False
    builder = binding.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    return machine.emit_object(module)


def _loaded(binding: Any, code: bytes) -> Any:
    """An engine that holds object code."""
    machine = binding.Target.from_default_triple().create_target_machine()
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


def _store() -> Path | None:
    """Where JAX keeps compiled programs, if it does so in a folder of this machine."""
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    if not folder or not config.jax_enable_compilation_cache or "://" in folder:
        return None
    return Path(folder) / _FOLDER


def _read(place: Path) -> bytes | None:
    """Code that was kept; `None` if there is none, or if it is not what was written."""
    try:
        content = place.read_bytes()
    except OSError:
        return None
    code = content[_DIGEST:]
    return code if content[:_DIGEST] == _digest(code) else None


def _write(place: Path, code: bytes) -> None:
    """Keep code for other processes, if the folder takes it."""
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        handle, beside = tempfile.mkstemp(dir=place.parent)
        with open(handle, "wb") as file:
            file.write(_digest(code) + code)
        os.replace(beside, place)
    except OSError:
        pass


_DIGEST = 20


def _digest(code: bytes) -> bytes:
    return hashlib.blake2b(code, digest_size=_DIGEST).digest()


def function_at(address: int) -> Any:
    """The kernel at this address, to be called."""
    pointer = ctypes.c_void_p
    kind = ctypes.CFUNCTYPE(None, pointer, pointer, pointer, ctypes.c_int64, pointer, pointer)
    return kind(address)
