"""Names that this package once had, or never: refused, with the one to take."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from ._calls import check_call
from ._numbers import saying_once

P = ParamSpec("P")
R = TypeVar("R")

NAMES = {
    "AbstractScene": "AbstractMachine",
    "AbstractSearch": "AbstractRootFinder",
    "road": "backend",
}
"""Of the package, the old name and the new one."""


def renamed(**new_by_old: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator: a function whose arguments once had other names. What it warns of it says once.

    **Raises:** in a call, `TypeError` for an old name, with the new one, and for one that it never
    had.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def called(*args: P.args, **kwargs: P.kwargs) -> R:
            for old, new in new_by_old.items():
                if old in kwargs:
                    raise TypeError(
                        f"Argument `{old}` of `{function.__name__}` is called `{new}` now."
                    )
            check_call(function, function.__name__, args, kwargs)
            with saying_once():
                return function(*args, **kwargs)

        return called

    return decorate


def refuse_attribute(thing: object, name: str, new_by_old: dict[str, str]) -> AttributeError:
    """The error for an attribute that is not there, with the new name of an old one."""
    kind = type(thing).__name__
    if name in new_by_old:
        return AttributeError(f"`{name}` of a `{kind}` is called `{new_by_old[name]}` now.")
    return AttributeError(f"`{kind}` object has no attribute `{name}`")
