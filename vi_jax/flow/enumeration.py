"""Enumerations of reasons whose members print by their names."""

import difflib
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Int

# Of a batch no more than so many are listed one by one: a choice, what fits a line.
_LISTED = 8

if TYPE_CHECKING:
    from equinox import Enumeration as NamedEnumeration

    _Member: Any = None
else:

    class _Member(eqx.Module):
        """A member of an enumeration, or one for each lane of a batch."""

        number: Any
        kind: type = eqx.field(static=True)

        def __eq__(self, other):
            if not isinstance(other, self.kind):
                raise ValueError(f"A {self.kind.__name__} has no order with {other!r}.")
            return jnp.equal(self.number, other.number)

        def __ne__(self, other):
            return ~(self == other)

        def __repr__(self) -> str:
            name, number = self.kind.__name__, self.number
            if isinstance(number, Tracer):
                return f"{name}<traced>"
            if not isinstance(number, jnp.ndarray | np.ndarray):
                return f"{name}<unknown>"
            found = names_of(self.kind)[number]
            if not found.ndim:
                return f"{name}.{found}"
            if found.size <= _LISTED:
                return f"{name}{found.tolist()}".replace("'", "")
            kinds, counts = np.unique(found, return_counts=True)
            parts = (f"{count:,} {kind}" for kind, count in zip(kinds, counts, strict=True))
            return f"{name}[{', '.join(parts)}; shape {found.shape}]"

    class _Kind(type):
        def __new__(mcs, name, bases, namespace):
            texts = {k: x for k, x in namespace.items() if isinstance(x, str) and k[0] != "_"}
            cls = super().__new__(mcs, name, bases, namespace)
            cls._texts = texts
            for number, word in enumerate(texts):
                setattr(cls, word, _Member(np.asarray(number, np.int32), cls))
            return cls

        def __instancecheck__(cls, value):
            return isinstance(value, _Member) and value.kind is cls

        def __getitem__(cls, item):
            return list(cls._texts.values())[int(item.number)]

        def __getattr__(cls, name: str) -> Any:
            if name.startswith("_"):
                raise AttributeError(name)
            near = difflib.get_close_matches(name, cls._texts, n=3, cutoff=0.5)
            words = f"{'near names' if near else 'its members'}: {', '.join(near or cls._texts)}"
            raise AttributeError(f"`{cls.__name__}` has no member {name!r}; {words}.")

    class NamedEnumeration(metaclass=_Kind):
        """Names with a text each, as class attributes. Members are pytrees, which may be traced and
        batched, and `RESULTS[item]` is the text of one."""

        @classmethod
        def where(cls, condition, a, b):
            """`jnp.where` of two members."""
            return _Member(jnp.where(condition, a.number, b.number), cls)


def names_of(kind: Any) -> np.ndarray:
    """The names of the members of an enumeration, in their order."""
    return np.asarray(list(kind._texts))


def in_names(member: Any) -> np.ndarray:
    """The names of members, one for each lane."""
    return np.asarray(names_of(member.kind)[np.asarray(member.number)])


def number_of(member: Any) -> Int[Array, "..."]:
    """The place of a member in its enumeration; a number for each lane."""
    return jnp.asarray(member.number)


def member_of(kind: Any, number: Any) -> Any:
    """The member of an enumeration at this place; one for each lane."""
    return _Member(jnp.asarray(number, jnp.int32), kind)
