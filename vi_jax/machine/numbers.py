"""Numbers of a machine by name, `"drive.frequency_ratio"` or `"stops.0.gap"`, their units, and
their representation as text and as tables."""

import dataclasses
import difflib
import inspect
from collections import OrderedDict
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .._checks import from_host, on_host
from .._types import Machine, Scalar, State
from .declared import warn_of_unread


def leaf_names(tree: object) -> list[str]:
    """Return the names of all numbers in a machine or a pytree, in the order of leaves."""
    return list(by_name(tree))


def by_name(tree: object) -> dict[str, Any]:
    """Return all numbers of a machine or a pytree by name, in the order of leaves."""
    leaves = ((path, x) for path, x in jtu.tree_leaves_with_path(tree) if eqx.is_array_like(x))
    return {jtu.keystr(path, simple=True, separator="."): x for path, x in leaves}


def components(state: State, lead: int = 0) -> dict[str, Any]:
    """Return all numbers of a state by name, those of an array as `name[i]`; with `lead` leading
    axes those of a batch of states."""
    found = {}
    for name, x in by_name(state).items():
        for index in np.ndindex(*jnp.shape(x)[lead:]):
            inner = str(list(index)) if index else ""
            found[name + inner] = x[(..., *index)] if index else x
    return found


def in_rows(states: State, lead: int = 1) -> Array:
    """Return a batch of states with `lead` leading axes as rows, in the order of `ravel_pytree`."""
    leaves = [jnp.asarray(x) for x in jtu.tree_leaves(states)]
    return jnp.concatenate([x.reshape(*x.shape[:lead], -1) for x in leaves], axis=-1)


def size_of(part: Callable[[State], Scalar], state: State, sizes: State) -> Scalar:
    """Return the sum over the state of |∂part/∂x| times the size of x."""
    slopes = jax.grad(lambda x: jnp.sum(part(x)))(state)
    each = jtu.tree_map(lambda slope, size: jnp.sum(jnp.abs(slope) * size), slopes, sizes)
    return sum(jtu.tree_leaves(each), start=jnp.zeros(()))


def state_in_words(state: State, digits: int, units: Mapping[str, str]) -> str:
    """Return the numbers of a state with their units, as text; of a long state the first few."""
    # JAX sorts the names of a dictionary, but not those of an `OrderedDict`.
    parts = components(OrderedDict(state) if isinstance(state, Mapping) else state).items()
    size = max((abs(float(x)) for _, x in parts), default=0.0)
    words = [f"{k} = {in_unit(plain(x, digits, size), units, k)}" for k, x in parts]
    return ", ".join(first_few(words))


def first_few(words: list[str]) -> list[str]:
    """Return a list of words, or the first few of a long one and the number of the others."""
    return words if len(words) <= _MANY else [*words[:_FEW], f"and {len(words) - _FEW} more"]


# A number is shown as 0 below this share of the largest beside it: a choice.
_NOTHING = 1e-28

# The length of a long list, and the number of its words that are printed: choices.
_MANY, _FEW = 16, 8


def plain(x: Any, digits: int, size: float = 0.0) -> str:
    """Return a number as text; zero has no sign. It is zero if it is rounding of rounding of
    numbers of this size."""
    x = float(x)
    return f"{0.0 if abs(x) < _NOTHING * size else x + 0.0:.{digits}g}"


def leaf(tree: object, name: str) -> Float[Array, "..."]:
    """Return the number with this name. **Raises:** `ValueError` that lists similar names."""
    base, index = _split_name(tree, check_leaf(tree, name))
    return jnp.asarray(by_name(tree)[base])[index]


def with_leaf(tree: Any, name: str, value: Any) -> Any:
    """Return the same machine with another value of this number, which may be traced."""
    base, index = _split_name(tree, check_leaf(tree, name))
    number = leaf_names(tree).index(base)
    leaves, treedef = jtu.tree_flatten(tree)
    arrays = [i for i, x in enumerate(leaves) if eqx.is_array_like(x)]
    old = leaves[arrays[number]]
    kind = jnp.result_type(old)
    if jnp.issubdtype(kind, jnp.integer) and jnp.issubdtype(jnp.result_type(value), jnp.floating):
        kind = jnp.result_type(float)  # or else it would be truncated
    if index:
        leaves[arrays[number]] = jnp.asarray(old, kind).at[index].set(value)
    elif jnp.ndim(old) and not jnp.ndim(value):
        raise ValueError(
            f"A name must be that of one number of the machine, but {name!r} is an array of shape "
            f"{jnp.shape(old)}; name one of its numbers, as {name + str([0] * jnp.ndim(old))!r}."
        )
    else:
        is_array = isinstance(value, jax.Array)
        new = jnp.asarray(value, kind) if is_array else from_host(np.asarray(value, kind))
        leaves[arrays[number]] = new
    return jtu.tree_unflatten(treedef, leaves)


def with_leaves(tree: Any, values: Mapping[str, Any]) -> Any:
    """Return the same machine with other values of several numbers, by name."""
    for name, value in values.items():
        tree = with_leaf(tree, name, value)
    return tree


def _split_name(tree: object, name: str) -> tuple[str, tuple[int, ...]]:
    return (name, ()) if name in by_name(tree) else split_index(name)


def split_index(name: str) -> tuple[str, tuple[int, ...]]:
    """Return an array's name and an index in it, of `"x[1, 2]"`; `()` without brackets."""
    if not name.endswith("]"):
        return name, ()
    base, _, inner = name.removesuffix("]").rpartition("[")
    return base, tuple(int(i) for i in inner.split(","))


def check_leaf(tree: object, name: str, *, argument: str = "parameter") -> str:
    """Return `name`, if it is that of a number, of an array, or of an array's number `name[i]`."""
    if name not in leaf_names(tree):
        check_name(list(components(tree)), name, argument, tree)
    warn_of_unread(type(tree), name)
    return name


def check_name(names: list[str], name: str, argument: str, machine: object = None) -> str:
    """Return `name`, if it is among the names of numbers. **Raises:** as `leaf`."""
    if name in names:
        return name
    untyped = getattr(type(machine), str(name), None)
    if isinstance(untyped, int | float):
        raise ValueError(
            f"Argument `{argument}` must be a number of the machine, but {name!r} has no type in "
            f"the class. Write `{name}: float = {untyped!r}`."
        )
    raise ValueError(
        f"Argument `{argument}` must be a number of the machine, but got {name!r}; "
        f"{near_names(name, names)}."
    )


def near_names(name: object, names: list[str]) -> str:
    """Return the names that are near `name`, or else all of them, in words."""
    last = str(name).split(".")[-1]
    ends = {other: other.split(".")[-1] for other in names}
    near = [
        other
        for other, end in ends.items()
        if (len(last) > 1 and last in end) or difflib.get_close_matches(last, [end])
    ]
    near = list(dict.fromkeys(near + difflib.get_close_matches(str(name), names)))
    found = "near" if near else "its"
    return f"{found} names: {', '.join(first_few(near or names))}"


def check_again(machine: Machine) -> None:
    """Run the machine's own checks: a replaced number has not been checked."""
    parts = jtu.tree_leaves(
        machine, is_leaf=lambda x: isinstance(x, eqx.Module) and x is not machine
    )
    for part in [*parts, machine]:
        check = getattr(part, "__check_init__", None)
        if check is not None:
            check()


NONE: Mapping[str, str] = MappingProxyType({})

Stated = tuple[tuple[str, str], ...]
"""The units of a machine as pairs of names and units, comparable and therefore static."""


PLAIN = "position", "velocity"
"""The labels of a machine without others."""


def unit_of(units: Mapping[str, str], name: str) -> str:
    """Return the unit of a quantity or a number, also by its last word; "" if unknown."""
    last = name.split(".")[-1].split("[")[0]
    for key in (name, "" if name.startswith("v.") else last, ""):  # `v.x` and `x` differ
        if key in units:
            return units[key]
    return ""


def units_of(machine: Machine) -> dict[str, str]:
    """Return the units of a machine. By default, position and velocity have those of the components
    that are their labels."""
    units = dict(machine.units)
    for quantity, name in zip(PLAIN, machine.labels, strict=True):
        if name in units:
            units.setdefault(quantity, units[name])
    return units


def stated(machine: Machine) -> Stated:
    """Return the units of a machine as pairs."""
    return tuple(units_of(machine).items())


def attributes(unit: str) -> dict[str, str]:
    """Return the attribute of a variable in this unit; empty for an unknown unit."""
    return {"units": unit} if unit else {}


def in_unit(text: str, units: Mapping[str, str], name: str) -> str:
    """Return a number with the unit of this name, if it has one."""
    return with_unit(text, unit_of(units, name))


def with_unit(text: str, unit: str) -> str:
    """Return a number with its unit, if it has one."""
    return text if unit in ("", "1") else f"{text} {unit}"


QUANTITIES = {
    "y_min": "position", "y_max": "position", "clearance": "position",
    "impact_speed": "velocity", "log_speed": "velocity", "frequency_ratio": "frequency_ratio",
    "exponents": "rate", "spread": "rate", "impact_energy": "energy", "duration": "time",
    "log_phase": "phase", "impact_phase": "phase", "event_phase": "phase",
    "outcome_phase": "phase",
    "fastest_impact": "velocity", "slowest_impact": "velocity",
}  # fmt: skip
"""The quantities that the arrays of results contain."""

_PREFIXES = ("error_section_", "section_", "sample_", "error_", "start.")


def quantity_of(name: str) -> str | None:
    """Return the quantity or the component of a state in a variable of a data set, or `None`."""
    for prefix in _PREFIXES:
        if name.startswith(prefix):
            inner = name.removeprefix(prefix)
            return QUANTITIES.get(inner, inner)
    return QUANTITIES.get(name)


def with_units(data: Any, units: Mapping[str, str], named: Mapping[str, str] = NONE) -> Any:
    """Return a data set with units as attributes; `named` has names of numbers by variables."""
    for name in data.variables:
        quantity = named.get(name) or quantity_of(str(name))
        if quantity is not None:
            data[name].attrs |= attributes(unit_of(units, quantity))
    return data


def in_brackets(words: str, unit: str) -> str:
    """Return the label of an axis with its unit, if it has one."""
    return words if unit in ("", "1") else f"{words} ({unit})"


def drive_speed(units: Mapping[str, str]) -> str:
    """Return the name of the mean speed of a drive. In units of ω it is the frequency ratio ζ."""
    return "ζ" if unit_of(units, "frequency_ratio") == "ω" else "speed of the drive"


def unit_in(label: str) -> str:
    """Return the unit at the end of a label such as "height (g/ω²)"."""
    return label.partition(" (")[2].removesuffix(")")


def name_in(label: str) -> str:
    """Return the name at the beginning of a label such as "height (g/ω²)" or "Y = y/a"."""
    return label.partition(" (")[0].partition(" = ")[0]


# The longest text in one line, and the longest array that is printed in full.
_WIDTH, _LISTED = 88, 6


class Shown(eqx.Module):
    """A module whose representation has its numbers, with their units if it has `units`."""

    def __new__(cls, *args: Any, **kwargs: Any):
        fields = {field.name for field in dataclasses.fields(cls) if field.init}
        wrong = next((name for name in kwargs if name not in fields), None)
        if wrong is not None and isinstance(getattr(cls, wrong, None), int | float):
            raise TypeError(
                f"`{cls.__name__}` has no argument `{wrong}`: a number is declared with its "
                f"type in the class, `{wrong}: float = {getattr(cls, wrong)!r}`."
            )
        taken = inspect.signature(cls.__init__).parameters if wrong else {}  # also of its own
        if wrong and wrong not in taken and all(x.kind != x.VAR_KEYWORD for x in taken.values()):
            names = [name for name in taken if name != "self"]
            known = near_names(wrong, names) if names else "it takes none"
            raise TypeError(f"`{cls.__name__}` has no argument `{wrong}`; {known}.")
        return super().__new__(cls)

    def __repr__(self) -> str:
        return in_words(self, getattr(self, "units", NONE)) if known(self) else super().__repr__()


class Summarized(eqx.Module):
    """A result whose representation is a summary."""

    def summary(self) -> str:
        """Return a summary: a line of text, then indented lines "name: value"."""
        raise NotImplementedError

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:  # of missing names
            kind = type(self)
            if name.startswith("_") or hasattr(kind, name):
                return object.__getattribute__(self, name)  # its own error
            names = [*vars(self), *(x for x in dir(kind) if x[0] != "_" and x not in vars(self))]
            raise AttributeError(
                f"`{kind.__name__}` has no attribute `{name}`; {near_names(name, names)}."
            )

    def __repr__(self) -> str:
        return on_host(self).summary() if known(self) else super().__repr__()


def known(tree: object) -> bool:
    """Return whether all numbers in a tree are known: not traced, placeholders, or deleted."""
    return all(_is_shown(x) for x in jtu.tree_leaves(tree))


def _is_shown(x: object) -> bool:
    # JAX's own placeholder is a bare object; a solver's leaves may be functions and strings.
    if isinstance(x, Tracer | jax.ShapeDtypeStruct) or type(x) is object:
        return False
    return not (isinstance(x, jax.Array) and x.is_deleted())


def in_words(x: object, units: Mapping[str, str] = NONE, name: str = "", indent: int = 0) -> str:
    """Return a module, a state or a number as text, as in Python, with units."""
    if eqx.is_array_like(x) and not isinstance(x, bool):
        return number_in_words(x, unit_of(units, name) if name else "")
    opened, parts, closed = _parts(x)
    parts = [
        (f"{key}=" if key else "") + in_words(part, units, key or name, indent + 2)
        for key, part in parts
    ]
    text = opened + ", ".join(parts) + closed
    if "\n" not in text and indent + len(text) <= _WIDTH:
        return text
    margin, end = "\n" + " " * (indent + 2), "\n" + " " * indent
    return opened + "".join(f"{margin}{part}," for part in parts) + end + closed.lstrip(",")


def _parts(x: object) -> tuple[str, list[tuple[str, Any]], str]:
    """Return the beginning of an object's text, its parts by name, and the end of the text."""
    name = f"{type(x).__name__}("
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        values = [(f.name, getattr(x, f.name, None)) for f in dataclasses.fields(x) if f.repr]
        left_out = (type(None), tuple, str)  # absent or empty
        shown = [(k, part) for k, part in values if not isinstance(part, left_out) or part]
        return name, shown, ")"
    if isinstance(x, tuple) and hasattr(x, "_fields"):
        return name, list(zip(x._fields, x, strict=True)), ")"  # pyright: ignore
    if name == "State(":
        return name, list(vars(x).items()), ")"
    if isinstance(x, Mapping):
        return "{", [(str(key), part) for key, part in x.items()], "}"
    if isinstance(x, tuple | list):
        left, right = "[]" if isinstance(x, list) else "()"
        return left, [("", part) for part in x], "," * (right == ")" and len(x) == 1) + right
    return getattr(x, "__qualname__", None) or repr(x), [], ""


def number_in_words(x: object, unit: str = "") -> str:
    """Return a number with its unit; of a large array the range and the shape."""
    x = np.asarray(x)
    if not x.ndim:
        return with_unit(f"{x + 0.0:.9g}" if x.dtype.kind == "f" else str(x), unit)
    if x.ndim == 1 and x.size <= _LISTED:
        return with_unit(f"[{', '.join(map(number_in_words, x))}]", unit)
    shape = " × ".join(map(str, x.shape))
    if not x.size or x.dtype.kind not in "fiu" or np.isnan(x).all():
        return f"{x.dtype} ({shape})"
    low, high = (number_in_words(f(x)) for f in (np.nanmin, np.nanmax))
    return f"{with_unit(f'{low} … {high}', unit)} ({shape})"
