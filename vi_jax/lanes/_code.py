"""Compilation of LLVM's text to machine code on a separate thread, with a cache in files."""

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
    """Return llvmlite's binding, initialized. **Raises:** `Unsupported` without llvmlite."""
    try:
        import llvmlite.binding as binding
    except ImportError as error:
        raise Unsupported(f"no llvmlite ({error})") from None
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    try:
        # A trial compilation: if it fails, programs take the other backend.
        _engine_with(binding, object_code(binding, "define void @kernel() { ret void }", None))
    except RuntimeError as error:
        raise Unsupported(f"LLVM: {error}") from None
    return binding


def engine_of(text: str) -> Any:
    """Return an engine with the machine code of a text, which lives as long as the engine."""
    return _engine_with(llvm(), object_code(llvm(), text, None))


def compile_in_background(text: str, cpu: str | None, passes: bool) -> Future:
    """Compile a kernel's text on another thread, with or without LLVM's passes. The future's result
    is the engine, which holds the code in memory, and the address of `kernel`."""
    options = _level(), passes
    return _worker().submit(_load_or_compile, llvm(), text, cpu, options, _cache_folder())


@functools.cache
def _worker() -> ThreadPoolExecutor:
    # One thread is enough: llvmlite (0.50) holds its own lock during compilation, but not Python's.
    return ThreadPoolExecutor(1, "vi_jax-llvm")


def _load_or_compile(
    binding: Any, text: str, cpu: str | None, options: tuple[int, bool], store: Path | None
) -> tuple[Any, int]:
    """Return an engine with a text's code and the address of `kernel`. The code is read from the
    folder `store` if it is there, else compiled and stored."""
    parts = (text, cpu, *options, *_host(binding), binding.llvm_version_info)
    name = f"{hashlib.blake2b(repr(parts).encode(), digest_size=20).hexdigest()}.o"
    code = store and _read(store / name)
    if code is None:
        code = object_code(binding, text, cpu, *options)
        if store is not None:
            _write(store / name, code)
    engine = _engine_with(binding, code)
    return engine, engine.get_function_address("kernel")


def _level() -> int:
    return 0 if jax.config.read("jax_disable_most_optimizations") else 1


def _host(binding: Any) -> tuple[str, str]:
    return binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()


def object_code(
    binding: Any, text: str, cpu: str | None, level: int = 1, passes: bool = True
) -> bytes:
    """Return the object code of a text for a processor (LLVM's name, or `None` for this one). LLVM
    does not vectorize, since the text is vector code already, and does not unroll loops."""
    name, features = _host(binding) if cpu is None else (cpu, "")
    target = binding.Target.from_default_triple()
    machine = target.create_target_machine(cpu=name, features=features, opt=level)
    try:
        module = binding.parse_assembly(text)
        module.verify()  # checks types and dominance in 0.1 to 1 ms; the rest takes 100 to 600 ms
    except RuntimeError as error:
        message = f"the code written for a loop is not valid, which is a fault of vi_jax: {error}"
        raise RuntimeError(message) from None
    module.triple = binding.get_default_triple()
    module.data_layout = str(machine.target_data)
    if passes:
        _run_passes(binding, machine, module, level)
    return machine.emit_object(module)


def _run_passes(binding: Any, machine: Any, module: Any, level: int) -> None:
    """Run LLVM's passes for functions. Those for modules took twice as long and made no kernel
    faster, except that unused arguments of functions cost a block on two corners 3 %."""
    options = binding.create_pipeline_tuning_options(speed_level=level)
    options.loop_vectorization = options.slp_vectorization = False
    options.loop_unrolling = False
    builder = binding.create_pass_builder(machine, options)
    before = binding.create_new_module_pass_manager()
    before.add_dead_arg_elimination_pass()
    before.run(module, builder)
    passes = builder.getFunctionPassManager()
    for function in module.functions:
        if not function.is_declaration:
            passes.run(function, builder)


def _engine_with(binding: Any, code: bytes) -> Any:
    machine = binding.Target.from_default_triple().create_target_machine()
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


def _cache_folder() -> Path | None:
    """Return a folder within JAX's compilation cache if that is on a local disk, else `None`."""
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    if not folder or not config.jax_enable_compilation_cache or "://" in folder:
        return None
    return Path(folder) / _FOLDER


def _read(path: Path) -> bytes | None:
    """Return code from a file, or `None` if there is no file or its checksum is wrong."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    code = content[_DIGEST:]
    return code if content[:_DIGEST] == _digest(code) else None


def _write(path: Path, code: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        with open(handle, "wb") as file:
            file.write(_digest(code) + code)
        os.replace(temporary, path)
    except OSError:
        pass


# Bytes of a checksum. A choice: as many as of a Git commit.
_DIGEST = 20


def _digest(code: bytes) -> bytes:
    return hashlib.blake2b(code, digest_size=_DIGEST).digest()
