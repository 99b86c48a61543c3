"""Messages to the user: progress bars, warnings, and the error that keeps partial results."""

import functools
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.metadata import PackageNotFoundError, version
from typing import Any, ParamSpec, TypeVar

import numpy as np
from tqdm import tqdm

P = ParamSpec("P")
R = TypeVar("R")

Tell = Callable[[int], Any]
"""Receives how many more units of work are done."""


class Interrupted(KeyboardInterrupt):
    """Raised by a long function on Ctrl-C when there are partial results.

    Before that it is a plain `KeyboardInterrupt`.
    """

    partial: Any
    """What was computed, of the kind that the function returns: a `Sweep` of the values that were
    done, a `Branch`, a `Boundary` or a `Manifold` that ends where it was interrupted, the
    `Lyapunov` exponents of the cycles that were observed, an `EdgeState` without its orbit, the
    `MinimalKick` found so far, an `AllOrbits` of the periods that were searched, a `Grazing`
    without the simulated motions; of `scan`, `basins` and `integrity_profile` the data set."""

    def __init__(
        self, what: str, partial: object, where: str = "what was computed is in `.partial`"
    ):
        super().__init__(f"the {what} was interrupted; {where}")
        self.partial = partial


def silent(done: int) -> None:
    """Show nothing."""


@contextmanager
def at_work(
    what: str,
    kept: Callable[[], Interrupted | None],
    *,
    progress: bool,
    unit: str = "it",
    total: int | None = None,
    done: int = 0,
) -> Iterator[Tell]:
    """Show a progress bar during a long part of a function, and keep its results on Ctrl-C. Gives a
    function that is called with the units that were done; it also raises an interrupt that Python
    dropped.

    **Arguments:** `what`, the word before the bar; `kept`, called on Ctrl-C, returns an
    `Interrupted` with what was computed, or `None` if there is nothing to keep yet; `progress`,
    whether a bar is shown (only in a terminal or a notebook); the `total` of units, if known; those
    `done` already.

    **Raises:** what `kept` returns, on Ctrl-C; else the `KeyboardInterrupt` itself.
    """
    from .lanes import interrupts_heard, raise_dropped  # not at once: it loads JAX

    def tell(done: int) -> None:
        bar.update(done)
        raise_dropped()

    try:
        with interrupts_heard(), tqdm(
            desc=what, total=total, initial=done, unit=f" {unit}", unit_scale=True,
            disable=None if progress else True,
        ) as bar:  # fmt: skip
            yield tell
    except KeyboardInterrupt:
        interrupted = kept()
        if interrupted is None:
            raise
        raise interrupted from None


def in_parts(
    what: str,
    step: Callable[[Any, Any], tuple[Any, Any]],
    carry: Any,
    pieces: Iterable[tuple[int, Any]],
    joined: Callable[[Any, list[Any]], R],
    **options: Any,
) -> R:
    """Do a long computation (`what`) piece by piece, so that an interrupt loses one of them.

    **Arguments:** `step(carry, piece)` returns the next carry and a part of the result; `pieces`
    with their sizes; `joined(carry, parts)` makes the result, also the partial one of an
    `Interrupted`; `options` as for `at_work`.
    """
    import jax

    parts: list[Any] = []

    def kept() -> Interrupted | None:
        return Interrupted(what, joined(carry, parts)) if parts else None

    with at_work(what, kept, **options) as tell:
        for size, piece in pieces:
            carry, part = jax.block_until_ready(step(carry, piece))
            parts.append(part)
            tell(size)
    return joined(carry, parts)


# The warnings that were given in the user's call under way.
_GIVEN: ContextVar[set[str] | None] = ContextVar("given", default=None)

# Packages whose frames are skipped to find the user's line.
_SKIPPED = {
    __name__.partition(".")[0], "beartype", "contextlib", "diffrax", "equinox", "functools", "jax",
    "jaxtyping", "lineax", "optimistix",
}  # fmt: skip


def warning_once(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: within one call each warning is given once, however often JAX traces, and no
    interrupt is lost."""

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        from .lanes import interrupts_heard

        token = _GIVEN.set(set()) if _GIVEN.get() is None else None
        try:
            with interrupts_heard():
                return function(*args, **kwargs)
        finally:
            if token is not None:
                _GIVEN.reset(token)

    return called


def warn(words: str) -> None:
    """Warn at the user's line that called this package."""
    given = _GIVEN.get()
    if given is not None:
        if words in given:
            return
        given.add(words)
    frame, level = sys._getframe(), 1
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in _SKIPPED:
        frame, level = frame.f_back, level + 1
    warnings.warn(words, stacklevel=level)


def so_many(number: int | np.integer, noun: str) -> str:
    """Return a number with its noun, which takes an s."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def installed_version() -> str:
    """Return the version of the installed distribution, or "not installed"."""
    try:
        return version("vi-jax")
    except PackageNotFoundError:
        return "not installed"
