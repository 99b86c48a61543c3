"""Messages to the user: progress bars, warnings, and the exception that holds partial results."""

import functools
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.metadata import PackageNotFoundError, version
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

ReportProgress = Callable[[int], Any]
"""A function of the number of further units of work that are done."""


IN_PARTIAL = "what was computed is in `.partial`"


class Interrupted(KeyboardInterrupt):
    """The exception that a long function raises on Ctrl-C if it has partial results.

    Before there are results, it raises a plain `KeyboardInterrupt`.
    """

    partial: Any
    """The partial result, of the same type as the function's result. A `Sweep` has the finished
    values. A `Branch`, `Boundary` or `Manifold` ends at the interruption. `Lyapunov` exponents are
    those of the observed cycles. An `EdgeState` lacks its orbit. A `MinimalKick` is the smallest
    found so far, and `AllOrbits` has the searched periods. A `Grazing` lacks the simulated motions.
    `scan`, `basins` and `integrity_profile` return the data set."""

    def __init__(self, what: str, partial: object, where: str = IN_PARTIAL):
        super().__init__(f"the {what} was interrupted; {where}")
        self.partial = partial


def silent(done: int) -> None:
    """Show nothing."""


@contextmanager
def at_work(
    what: str,
    partial: Callable[[], Any],
    *,
    progress: bool,
    unit: str = "it",
    total: int | None = None,
    done: int = 0,
    where: str = IN_PARTIAL,
) -> Iterator[ReportProgress]:
    """Show a progress bar during a long part of a function, and keep its results on Ctrl-C.

    Yield a function of the number of units done since its last call. It updates the bar, and raises
    an interrupt that Python dropped.

    **Arguments:** `what`, a noun for the work; `partial`, a function called on Ctrl-C that returns
    the partial result, or `None` without any; `progress`, whether to show a bar (only in a terminal
    or a notebook); `unit`, its name; `total`, the number of units, if known; `done`, the units done
    before; `where`, the place of the partial result in words.

    **Raises:** on Ctrl-C `Interrupted`, or the `KeyboardInterrupt` itself without a result.
    """
    from tqdm import tqdm  # slow to load

    from .lanes import raise_dropped, raise_interrupts_within  # here, since it loads JAX

    def report(done: int) -> None:
        bar.update(done)
        raise_dropped()

    try:
        with raise_interrupts_within(), tqdm(
            desc=what, total=total, initial=done, unit=f" {unit}", unit_scale=True,
            disable=None if progress else True,
        ) as bar:  # fmt: skip
            yield report
    except KeyboardInterrupt:
        found = partial()
        if found is None:
            raise
        raise Interrupted(what, found, where) from None


def in_parts(
    what: str,
    step: Callable[[Any, Any], tuple[Any, Any]],
    carry: Any,
    pieces: Iterable[tuple[int, Any]],
    joined: Callable[[Any, list[Any]], R],
    **options: Any,
) -> R:
    """Run a long computation piece by piece, so that an interrupt loses at most one piece.

    **Arguments:** `what`, a noun for the computation; `step(carry, piece)`, which returns the next
    carry and a part of the result; `pieces`, pairs of a size and a piece; `joined(carry, parts)`,
    which returns the result, also the partial one of an `Interrupted`; `options` of `at_work`.
    """
    import jax

    parts: list[Any] = []
    partial = lambda: joined(carry, parts) if parts else None
    with at_work(what, partial, **options) as report:
        for size, piece in pieces:
            carry, part = jax.block_until_ready(step(carry, piece))
            parts.append(part)
            report(size)
    return joined(carry, parts)


# Warnings already given during the user's current call.
_GIVEN: ContextVar[set[str] | None] = ContextVar("given", default=None)

# Packages whose frames are skipped to find the user's line.
_LIBRARIES = {
    __name__.partition(".")[0], "beartype", "contextlib", "diffrax", "equinox", "functools", "jax",
    "jaxtyping", "lineax", "optimistix",
}  # fmt: skip


def warning_once(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: give each warning once in a call, even if JAX traces several times. Interrupts
    that Python drops are raised (`raise_interrupts_within`)."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        from .lanes import raise_interrupts_within

        token = _GIVEN.set(set()) if _GIVEN.get() is None else None
        try:
            with raise_interrupts_within():
                return function(*args, **kwargs)
        finally:
            if token is not None:
                _GIVEN.reset(token)

    return wrapped


def warn(message: str) -> None:
    """Give a warning at the user's line that called this package."""
    given = _GIVEN.get()
    if given is not None:
        if message in given:
            return
        given.add(message)
    frame, level = sys._getframe(), 1
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in _LIBRARIES:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)


def count_of(number: int | np.integer, noun: str) -> str:
    """Return a number with its noun, in the plural unless the number is 1."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def installed_version() -> str:
    """Return the version of the installed distribution, or "not installed"."""
    try:
        return version("vi-jax")
    except PackageNotFoundError:
        return "not installed"
