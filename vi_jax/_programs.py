"""The compiled functions of this package, and the memory maps that Linux grants a process.

A program takes some hundreds of memory maps; where a process has none left, the compiler dies with
a segmentation fault. JAX keeps every program, so that a long script gets there.
"""

import contextlib
import functools
import gc
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
from jax.core import Tracer

from .lanes import Unsupported, current_backend, interrupts_heard, vector_only

# With these XLA compiles two to three times faster. What runs for long is in the lanes, whose code
# is not XLA's. For programs that do much else, `PLAIN` alone saves half of that and costs nothing
# at run time.
PLAIN = {"xla_cpu_use_fusion_emitters": False}
_QUICK = {**PLAIN, "xla_backend_optimization_level": 0}

_MAPS, _MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")

# Parts of the maps beyond which programs are dropped, and down to which. Both are choices: they
# leave room for what else takes maps, and make dropping rare.
_FULL, _ROOM = 0.6, 0.4

# To count the maps takes up to a tenth of a second. So it is done at most once in `_SELDOM` times
# the time that it took, and once in `_PAUSE` seconds.
_SELDOM, _PAUSE = 50, 0.5


class _Watch:
    """The compiled functions, the least recently called first, and when to count the maps next."""

    def __init__(self):
        self.lock = threading.Lock()
        self.programs: dict[CompiledFunction, None] = {}
        self.next_look = 0.0

    def called(self, program: "CompiledFunction") -> None:
        """Note a call, and drop programs if the maps run out (see `_look`)."""
        if time.monotonic() < self.next_look and next(reversed(self.programs), None) is program:
            return
        with self.lock:
            self.programs.pop(program, None)
            self.programs[program] = None
            begin = time.monotonic()
            if begin < self.next_look:
                return
            self._look()
            self.next_look = begin + max(_PAUSE, _SELDOM * (time.monotonic() - begin))

    def _look(self) -> None:
        used, most = maps_used(), maps_granted()
        if used is None or most is None or used < _FULL * most:
            return
        left = used
        for program in list(self.programs):
            program.drop()
            gc.collect()
            left = maps_used() or 0
            if left < _ROOM * most:
                break
        advice = ""
        if left >= _FULL * most:
            advice = (
                " Others take the most of it: call `jax.clear_caches()` now and then, or raise "
                f"{_MOST}, before the process dies."
            )
        warnings.warn(
            f"This process used {used:,} of the {most:,} memory maps that Linux grants it, most of "
            "them for compiled programs. The oldest programs were dropped (they are compiled again "
            f"if called again), which leaves {left:,}.{advice}",
            RuntimeWarning,
            stacklevel=4,
        )


def maps_used() -> int | None:
    """The number of memory maps of this process, or `None` where it cannot be known."""
    try:
        return _MAPS.read_bytes().count(b"\n")
    except OSError:
        return None


def maps_granted() -> int | None:
    """The most that it may have, or `None` where that cannot be known."""
    try:
        return int(_MOST.read_text())
    except (OSError, ValueError):
        return None


_watch = _Watch()


class CompiledFunction:
    """A function that is compiled as by `eqx.filter_jit`, and whose programs can be dropped. (A
    `LaneProgram` is another thing: the loop of a lane within such a function.)

    **Arguments:** the function; XLA's compiler options where its lanes are vector code (`quick`);
    further arguments of `eqx.filter_jit` for where they run on XLA's backend.
    """

    def __init__(
        self, function: Callable[..., Any], quick: Mapping[str, Any] = _QUICK, **options: Any
    ):
        functools.update_wrapper(self, function)
        self._function, self._quick_options = _uncollected(function), quick
        self._compiled = eqx.filter_jit(self._function, **options)
        # The structures of arguments whose lanes are no vector code, so that XLA's loops would be
        # slow by quick options.
        self._never_quick: set[Any] = set()

    @functools.cached_property
    def _quick(self) -> Any:
        options: Any = {"compiler_options": _known(self._quick_options)}
        return eqx.filter_jit(self._function, **options)

    def drop(self) -> None:
        """Drop what was compiled; it is compiled again when it is called again."""
        # Equinox (0.13.8) has no public way to JAX's `clear_cache`, and to drop the wrapper is not
        # enough, since JAX keeps the programs (`tests/lanes/test_jax.py` notes a change).
        for made in (self._compiled, vars(self).get("_quick")):
            if made is not None:
                cached = getattr(made, "_cached", None)
                getattr(cached, "clear_cache", jax.clear_caches)()

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """What the function returns, by its compiled program. **Raises:** `KeyboardInterrupt` also
        for an interrupt that Python dropped meanwhile."""
        with interrupts_heard():
            return self._called(arguments, keywords)

    def _called(self, arguments: tuple, keywords: dict[str, Any]) -> Any:
        _watch.called(self)
        kind = _kind_of(arguments, keywords)
        quick = kind not in self._never_quick and current_backend() != "xla"
        if quick and is_outermost(arguments, keywords):
            try:
                with vector_only():
                    return self._quick(*arguments, **keywords)
            except Unsupported:
                self._never_quick.add(kind)
            except ValueError as error:
                # Within another program, which `is_outermost` does not see where an argument's
                # function closes over what is differentiated, JAX (0.10.2) refuses compiler options
                # with a plain `ValueError` (its text: `tests/lanes/test_jax.py`).
                if "compiler_options" not in str(error):
                    raise
        return self._compiled(*arguments, **keywords)


def _kind_of(*arguments: Any) -> Any:
    """What decides, besides shapes, which program a call gets; `None` if that has no hash."""
    leaves, structure = jtu.tree_flatten(arguments)
    kind = structure, tuple(x for x in leaves if not eqx.is_array(x))
    try:
        hash(kind)
    except TypeError:
        return None
    return kind


def _uncollected(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function without garbage collection while it runs, which is only to be traced: tracing
    makes hardly any garbage, and its many objects would make the collector run again and again."""

    @functools.wraps(function)
    def traced(*arguments: Any, **keywords: Any) -> Any:
        enabled = gc.isenabled()
        gc.disable()
        try:
            return function(*arguments, **keywords)
        finally:
            if enabled:
                gc.enable()

    return traced


def is_outermost(*arguments: Any) -> bool:
    """Whether a call is not a part of another program: only then JAX takes compiler options."""
    if any(isinstance(x, Tracer) for x in jtu.tree_leaves(arguments)):
        return False
    return not isinstance(jax.lax.full((1,), 0.0), Tracer)


def _known(options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the options that this XLA knows."""
    if jax.default_backend() != "cpu":
        return {}
    return {name: value for name, value in options.items() if _is_known(name, value)}


@functools.cache
def _is_known(name: str, value: object) -> bool:
    with contextlib.suppress(jax.errors.JaxRuntimeError):
        jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
        return True
    return False


def compiled(function: Callable[..., Any]) -> CompiledFunction:
    """Decorator: the function, compiled, its programs dropped if the room for them runs out."""
    return CompiledFunction(function)
