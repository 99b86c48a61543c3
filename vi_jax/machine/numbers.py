"""Numbers of a machine by name: `"drive.frequency_ratio"`, `"stops.0.gap"`, …"""

import difflib
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._types import Machine, Scalar, State
from .units import in_unit


def leaf_names(tree: object) -> list[str]:
    """Names of all numbers in a machine (or another pytree), in the order of its leaves."""
    return list(by_name(tree))


def by_name(tree: object) -> dict[str, Any]:
    """All numbers of a machine, a state or another pytree by their names, in the order of its
    leaves."""
    leaves = ((path, x) for path, x in jtu.tree_leaves_with_path(tree) if eqx.is_array_like(x))
    return {jtu.keystr(path, simple=True, separator="."): x for path, x in leaves}


def components(state: State, lead: int = 0) -> dict[str, Any]:
    """All numbers of a state by their names, those of an array `name[i]`; of several states beside
    each other, which have `lead` axes in front, rows of them."""
    found = {}
    for name, x in by_name(state).items():
        for place in np.ndindex(*jnp.shape(x)[lead:]):
            inner = str(list(place)) if place else ""
            found[name + inner] = x[(..., *place)] if place else x
    return found


def in_rows(states: State, lead: int = 1) -> Array:
    """Several states beside each other, which have `lead` axes in front, as rows of all their
    numbers, in the order of `ravel_pytree`."""
    leaves = [jnp.asarray(x) for x in jtu.tree_leaves(states)]
    return jnp.concatenate([x.reshape(*x.shape[:lead], -1) for x in leaves], axis=-1)


def size_of(part: Callable[[State], Scalar], state: State, sizes: State) -> Scalar:
    """The size of what a function of the state adds up where its numbers have these sizes."""
    slopes = jax.grad(lambda x: jnp.sum(part(x)))(state)
    each = jtu.tree_map(lambda slope, size: jnp.sum(jnp.abs(slope) * size), slopes, sizes)
    return sum(jtu.tree_leaves(each), start=jnp.zeros(()))


def state_in_words(state: State, digits: int, units: Mapping[str, str]) -> str:
    """The numbers of a state of any kind, in their units; of one with many the first few."""
    parts = components(state).items()
    return ", ".join(first_few([f"{k} = {in_unit(plain(x, digits), units, k)}" for k, x in parts]))


def first_few(words: list[str]) -> list[str]:
    """A list's words, of a long one the first few and how many more there are."""
    return words if len(words) <= _MANY else [*words[:_FEW], f"and {len(words) - _FEW} more"]


# What is printed of long lists: choices.
_MANY, _FEW = 16, 8


def plain(x: Any, digits: int) -> str:
    """A number for print, where zero has no sign."""
    return f"{float(x) + 0.0:.{digits}g}"


def leaf(tree: object, name: str) -> Float[Array, "..."]:
    """The number of that name. **Raises:** `ValueError` that lists the near names."""
    base, place = _place_in(tree, check_leaf(tree, name))
    return jnp.asarray(by_name(tree)[base])[place]


def with_leaf(tree: Any, name: str, value: Any) -> Any:
    """The same machine with another number in place of that name; traced values pass."""
    base, place = _place_in(tree, check_leaf(tree, name))
    index = leaf_names(tree).index(base)
    leaves, treedef = jtu.tree_flatten(tree)
    arrays = [i for i, x in enumerate(leaves) if eqx.is_array_like(x)]
    old = leaves[arrays[index]]
    kind = jnp.result_type(old)
    if jnp.issubdtype(kind, jnp.integer) and jnp.issubdtype(jnp.result_type(value), jnp.floating):
        kind = jnp.result_type(float)  # or else it would be cut off
    if place:
        leaves[arrays[index]] = jnp.asarray(old, kind).at[place].set(value)
    elif jnp.ndim(old) and not jnp.ndim(value):
        raise ValueError(
            f"A name must be that of one number of the machine, but {name!r} is an array of shape "
            f"{jnp.shape(old)}; name one of its numbers, as {name + str([0] * jnp.ndim(old))!r}."
        )
    else:
        leaves[arrays[index]] = jnp.asarray(value, kind)
    return jtu.tree_unflatten(treedef, leaves)


def with_leaves(tree: Any, values: Mapping[str, Any]) -> Any:
    """Replace several numbers of a machine, given by name."""
    for name, value in values.items():
        tree = with_leaf(tree, name, value)
    return tree


def _place_in(tree: object, name: str) -> tuple[str, tuple[int, ...]]:
    """The array that a number's name begins with, and its place in it: none of the number itself or
    of a whole array."""
    return (name, ()) if name in by_name(tree) else split_place(name)


def split_place(name: str) -> tuple[str, tuple[int, ...]]:
    """An array's name and a place in it, of `"x[1, 2]"`; no place of a name without one."""
    if not name.endswith("]"):
        return name, ()
    base, _, inner = name.removesuffix("]").rpartition("[")
    return base, tuple(int(i) for i in inner.split(","))


def check_leaf(tree: object, name: str, *, argument: str = "parameter") -> str:
    """`name`, if the machine has such a number, or such an array, whose numbers are called
    `name[i]`."""
    names = leaf_names(tree)
    return name if name in names else check_name(list(components(tree)), name, argument, tree)


def check_name(names: list[str], name: str, argument: str, machine: object = None) -> str:
    """`name`, if it is among the names of numbers of a machine, or another tree. **Raises:** as
    `leaf`."""
    if name in names:
        return name
    untyped = getattr(type(machine), str(name), None)
    if isinstance(untyped, int | float):
        raise ValueError(
            f"Argument `{argument}` must be a number of the machine, but {name!r} has no type in "
            f"the class. Write `{name}: float = {untyped!r}`."
        )
    near = difflib.get_close_matches(str(name), names, n=3, cutoff=0.3)
    ending = [other for other in names if str(name).split(".")[-1] in other]
    near = list(dict.fromkeys(ending + near))
    hint = f"near names: {', '.join(near)}" if near else f"its names: {', '.join(names)}"
    raise ValueError(
        f"Argument `{argument}` must be a number of the machine, but got {name!r}; {hint}."
    )


def check_again(machine: Machine) -> None:
    """Run the machine's own checks: a number put in place of another has passed none."""
    parts = jtu.tree_leaves(
        machine, is_leaf=lambda x: isinstance(x, eqx.Module) and x is not machine
    )
    for part in [*parts, machine]:
        check = getattr(part, "__check_init__", None)
        if check is not None:
            check()
