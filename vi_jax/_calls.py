"""Calls with arguments that a function does not have: refused, with the names that it has."""

import difflib
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_BY_PLACE = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


def named(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: a class method whose unknown arguments are refused by `check_call`."""
    who = function.__qualname__

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        check_call(function, who, args, kwargs, bound=1)
        return function(*args, **kwargs)

    return called


def check_call(
    function: Callable[..., Any], who: str, args: tuple[Any, ...], kwargs: Mapping[str, Any], *,
    bound: int = 0,
) -> None:  # fmt: skip
    """**Raises:** `TypeError` for an argument that the function does not have by this name, or for
    more arguments than it takes without their names. What is missing Python says itself.

    **Arguments:** `who`, the function in words; `bound`, how many of its first arguments no caller
    gives (`self` or `cls`).
    """
    names, places, open_ended = _arguments(function)
    if open_ended:
        return
    for name in kwargs:
        if name not in names:
            offered = names[bound:]
            near = difflib.get_close_matches(name.lower(), offered, n=3, cutoff=0.6)
            near += [x for x in offered if x.lower() == name.lower() and x not in near]
            hint = f"near names: {', '.join(near)}" if near else f"it has: {', '.join(offered)}"
            raise TypeError(f"`{who}` has no argument `{name}`; {hint}.")
    if len(args) > places:
        rest = ", ".join(f"{name}=…" for name in names[places:])
        first = ", ".join(names[bound:places])
        beyond = f" after {first}" if first else ""
        ask = f"takes its arguments{beyond} by name, as {rest}" if rest else f"takes only {first}"
        raise TypeError(f"`{who}` {ask}, but got {len(args) - places} without a name.")


@functools.lru_cache(maxsize=512)
def _arguments(function: Callable[..., Any]) -> tuple[list[str], int, bool]:
    """Names of a function's arguments, how many of them may be given by their places, and whether
    it takes any others."""
    parts = inspect.signature(function).parameters.values()
    named = [part for part in parts if part.kind not in (part.VAR_POSITIONAL, part.VAR_KEYWORD)]
    places = sum(part.kind in _BY_PLACE for part in named)
    return [part.name for part in named], places, len(named) < len(parts)
