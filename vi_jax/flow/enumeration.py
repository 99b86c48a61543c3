"""Enumerations of reasons whose members print by their names."""

import difflib
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

# Of a batch no more than so many are listed one by one: a choice, what fits a line.
_LISTED = 8


def _near(name: str, names: Any) -> str:
    near = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    return f"near names: {', '.join(near)}" if near else f"its members: {', '.join(names)}"


if TYPE_CHECKING:
    from equinox import Enumeration as NamedEnumeration
else:

    class _Plain(eqx.Enumeration):
        """Only for its members, whose class Equinox does not name."""

        member = ""

    class _Member(type(_Plain.member)):
        """A member, or a batch of them, that prints by name."""

        def __repr__(self) -> str:
            kind = self._enumeration
            place, names = self._value, np.asarray(list(kind._name_to_item))
            if isinstance(place, Tracer):
                return f"{kind.__name__}<traced>"
            if not isinstance(place, jnp.ndarray | np.ndarray):
                return f"{kind.__name__}<unknown>"
            found = names[np.asarray(place)]
            if not found.ndim:
                return f"{kind.__name__}.{found}"
            if found.size <= _LISTED:
                return f"{kind.__name__}{found.tolist()}".replace("'", "")
            kinds, counts = np.unique(found, return_counts=True)
            parts = (f"{count:,} {name}" for name, count in zip(kinds, counts, strict=True))
            return f"{kind.__name__}[{', '.join(parts)}; shape {found.shape}]"

    class _Kind(type(eqx.Enumeration)):
        """What makes the class, with members of that kind."""

        def __new__(mcs, name, bases, namespace):
            cls = super().__new__(mcs, name, bases, namespace)
            for word, item in cls._name_to_item.items():
                cls._name_to_item[word] = _Member(item._value, cls)
            return cls

        def __getattr__(cls, name: str) -> Any:
            try:
                return super().__getattr__(name)
            except AttributeError:
                if name.startswith("_"):
                    raise
                raise AttributeError(
                    f"`{cls.__name__}` has no member {name!r}; {_near(name, cls._name_to_item)}."
                ) from None

        def __dir__(cls) -> list[str]:
            return [*super().__dir__(), *cls._name_to_item]

    class NamedEnumeration(eqx.Enumeration, metaclass=_Kind):
        """An `equinox.Enumeration` whose members print by their names.

        As there, `RESULTS[item]` is what an item means, in words.
        """

    def _where(cls, pred, a, b):
        chosen = super(NamedEnumeration, cls).where(pred, a, b)
        return _Member(chosen._value, cls)

    # Equinox takes the name in a body for that of a member.
    NamedEnumeration.where = classmethod(_where)


def names_of(kind: type) -> tuple[str, ...]:
    """The names of the members of an enumeration, in their order."""
    return tuple(kind._name_to_item)  # pyright: ignore[reportAttributeAccessIssue]
