"""Numbers of a machine or a state by name: `"drive.frequency_ratio"`, `"stops.0.gap"`, `"v.x"`."""

import difflib
import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._checks import array_module, from_host
from .._types import Machine, Scalar, State
from .overrides import warn_of_unread


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


def in_rows(states: State, lead: int = 1) -> Any:
    """Return a batch of states with `lead` leading axes as rows, in the order of `ravel_pytree`; of
    NumPy arrays as one."""
    array = array_module(*jtu.tree_leaves(states))
    leaves = [array.asarray(x) for x in jtu.tree_leaves(states)]
    return array.concatenate([x.reshape(*x.shape[:lead], -1) for x in leaves], axis=-1)


def states_from_rows(like: State, rows: Any) -> State:
    """Return rows (..., numbers), in the order of `in_rows`, as states like this one with their
    leading axes; host-side, since `unravel` compiles a program for each leaf."""
    leaves, structure = jtu.tree_flatten(like)
    shapes, rows = [jnp.shape(x) for x in leaves], np.asarray(rows)
    parts = np.split(rows, np.cumsum([math.prod(x) for x in shapes])[:-1], axis=-1)
    found = [x.reshape((*rows.shape[:-1], *shape)) for x, shape in zip(parts, shapes, strict=True)]
    return from_host(jtu.tree_unflatten(structure, found))


def size_of(part: Callable[[State], Scalar], state: State, sizes: State) -> Scalar:
    """Return the sum over the state of |∂part/∂x| times the size of x."""
    return size_by(jax.grad(lambda x: jnp.sum(part(x)))(state), sizes)


def size_by(slopes: State, sizes: State) -> Scalar:
    """Return the sum of |slope| times the size of its number."""
    each = jtu.tree_map(lambda slope, size: jnp.sum(jnp.abs(slope) * size), slopes, sizes)
    return sum(jtu.tree_leaves(each), start=jnp.zeros(()))


# The length of a long list, and the number of its words that are printed: choices.
_MANY, _FEW = 16, 8


def first_few(words: list[str]) -> list[str]:
    """Return a list of words, or the first few of a long one and the number of the others."""
    return words if len(words) <= _MANY else [*words[:_FEW], f"and {len(words) - _FEW} more"]


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
