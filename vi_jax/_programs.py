"""Compiled functions of this package, and the number of memory maps that Linux grants a process.

A compiled program takes some hundreds of memory maps. If a process has none left, the compiler ends
with a segmentation fault. JAX keeps every program, so a long script reaches that limit.
"""

import contextlib
import functools
import gc
import os
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer

from ._checks import is_traced, unwritable
from ._loading import without_collection
from .lanes import (
    Unsupported,
    current_backend,
    raise_interrupts_within,
    vector_only,
)

# With these options XLA compiles two to three times faster. Most of the run time is spent in the
# lanes, whose code XLA does not compile. `PLAIN` alone saves half of the compile time and costs no
# run time. It is meant for programs that compute much outside the lanes.
PLAIN = {"xla_cpu_use_fusion_emitters": False}
_QUICK = {
    **PLAIN,
    "xla_backend_optimization_level": 0,
    "xla_cpu_parallel_codegen_split_count": 1,
}

# An argument for an operation that is no program.
_NOTHING = np.zeros(())

_MAPS, _MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")

# Shares of the granted maps. Programs are dropped above `_FULL`, until `_ROOM` is reached. Both are
# choices: they leave maps for other libraries and make dropping rare.
_FULL, _ROOM = 0.6, 0.4

# Counting the maps takes up to a tenth of a second. The time between two counts is at least
# `_SELDOM` times the duration of a count, and at least `_PAUSE` seconds.
_SELDOM, _PAUSE = 50, 0.5


class _Watch:
    """The compiled functions, least recently called first, and the time to count the maps next."""

    def __init__(self):
        self.lock = threading.Lock()
        self.programs: dict[CompiledFunction, None] = {}
        self.next_count = 0.0

    def record_call(self, program: "CompiledFunction") -> None:
        """Record a call. Drop programs if few maps are left."""
        if time.monotonic() < self.next_count and next(reversed(self.programs), None) is program:
            return
        with self.lock:
            self.programs.pop(program, None)
            self.programs[program] = None
            begin = time.monotonic()
            if begin < self.next_count:
                return
            self._drop_if_full()
            self.next_count = begin + max(_PAUSE, _SELDOM * (time.monotonic() - begin))

    def _drop_if_full(self) -> None:
        used, granted = maps_used(), maps_granted()
        if used is None or granted is None or used < _FULL * granted:
            return
        remaining = used
        for program in list(self.programs):
            program.drop()
            gc.collect()
            remaining = maps_used() or 0
            if remaining < _ROOM * granted:
                break
        advice = ""
        if remaining >= _FULL * granted:
            advice = (
                " Others take the most of it: call `jax.clear_caches()` now and then, or raise "
                f"{_MOST}, before the process dies."
            )
        warnings.warn(
            f"This process used {used:,} of the {granted:,} memory maps that Linux grants it, most "
            "of them for compiled programs. The oldest programs were dropped (they are compiled "
            f"again if called again), which leaves {remaining:,}.{advice}",
            RuntimeWarning,
            stacklevel=4,
        )


def maps_used() -> int | None:
    """Return the number of memory maps of this process, or `None` if it is unknown."""
    try:
        return _MAPS.read_bytes().count(b"\n")
    except OSError:
        return None


def maps_granted() -> int | None:
    """Return the number of memory maps that a process may have, or `None` if it is unknown."""
    try:
        return int(_MOST.read_text())
    except (OSError, ValueError):
        return None


_watch = _Watch()


class CompiledFunction:
    """A function compiled with `eqx.filter_jit` whose compiled programs can be dropped.

    **Arguments:** the function; XLA's compiler options for calls whose lanes are vector code
    (`quick`); further arguments of `eqx.filter_jit` for calls whose lanes run on XLA's backend.
    """

    def __init__(
        self, function: Callable[..., Any], quick: Mapping[str, Any] = _QUICK, **options: Any
    ):
        functools.update_wrapper(self, function)
        self._function, self._quick_options = function, quick
        self._compiled = eqx.filter_jit(self._function, **options)
        # Structures of arguments whose lanes cannot be vector code. With the quick options XLA's
        # loops would be slow.
        self._never_quick: set[Any] = set()

    @functools.cached_property
    def _quick(self) -> Any:
        options: Any = {"compiler_options": _supported(self._quick_options)}
        return eqx.filter_jit(self._function, **options)

    def drop(self) -> None:
        """Drop the compiled programs. The next call compiles again."""
        # Equinox (0.13.8) has no public way to JAX's `clear_cache`. Dropping the wrapper is not
        # enough, since JAX keeps the programs (`tests/lanes/test_jax.py` detects a change).
        for program in (self._compiled, vars(self).get("_quick")):
            if program is not None:
                inner = getattr(program, "_cached", None)
                getattr(inner, "clear_cache", jax.clear_caches)()

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Return the function's result, computed by its compiled program. **Raises:**
        `KeyboardInterrupt`, also for an interrupt during the call that Python dropped."""
        with raise_interrupts_within(), without_collection():
            return self._called(arguments, keywords)

    def _called(self, arguments: tuple, keywords: dict[str, Any]) -> Any:
        _watch.record_call(self)
        kind = _kind_of(arguments, keywords)
        quick = kind not in self._never_quick and current_backend() != "xla"
        if quick and is_outermost(arguments, keywords):
            try:
                with vector_only():
                    return self._quick(*arguments, **keywords)
            except Unsupported:
                self._never_quick.add(kind)
            except ValueError as error:
                # JAX (0.10.2) refuses compiler options within another program, with a plain
                # `ValueError` (`tests/lanes/test_jax.py` tests its text). `is_outermost` does not
                # detect this case if an argument is a function that closes over a tracer.
                if "compiler_options" not in str(error):
                    raise
        return self._compiled(*arguments, **keywords)


def _kind_of(*arguments: Any) -> Any:
    """Return a key of the properties besides shapes that select a program; `None` without hash."""
    leaves, structure = jtu.tree_flatten(arguments)
    kind = structure, tuple(x for x in leaves if not eqx.is_array(x))
    try:
        hash(kind)
    except TypeError:
        return None
    return kind


def is_outermost(*arguments: Any) -> bool:
    """Return whether a call is outside any other program. Only then JAX takes compiler options."""
    if is_traced(*arguments):
        return False
    return not isinstance(jax.device_put(_NOTHING), Tracer)


def _supported(options: Mapping[str, Any]) -> dict[str, Any]:
    if jax.default_backend() != "cpu":
        return {}
    if _are_supported(*options.items()):
        return dict(options)
    return {name: value for name, value in options.items() if _are_supported((name, value))}


@functools.cache
def _are_supported(*options: tuple[str, object]) -> bool:
    with contextlib.suppress(jax.errors.JaxRuntimeError):
        jax.jit(lambda: 0, compiler_options=dict(options)).lower().compile()
        return True
    return False


def keep_programs(folder: str | Path | None = None) -> Path | None:
    """Store compiled programs in a folder, so that the next process need not compile them again.

    Call it once, before the first simulation. A program's name is computed from its content, so a
    changed class, function or number of a program is compiled anew. Only the user must be able to
    write to the folder, since its files are machine code. It may be deleted at any time.

    **Arguments:** `folder`, by default `vi_jax` in `$XDG_CACHE_HOME` or `~/.cache`. A folder that
    JAX has already, such as `$JAX_COMPILATION_CACHE_DIR`, is used instead of the default.

    **Returns:** the folder; `None` if it cannot be written to, or if JAX's cache is switched off.
    """
    config: Any = jax.config
    if not config.jax_enable_compilation_cache:
        return None
    if folder is None and config.jax_compilation_cache_dir:
        return Path(config.jax_compilation_cache_dir)
    if folder is None:
        try:
            folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vi_jax"
        except RuntimeError:  # no home
            return None
    folder = Path(folder).expanduser().absolute()
    if unwritable(folder) is not None:
        return None
    config.update("jax_compilation_cache_dir", str(folder))
    config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return folder


def compiled(function: Callable[..., Any]) -> CompiledFunction:
    """Decorator: compile a function. Its programs are dropped if memory maps run short."""
    return CompiledFunction(function)
