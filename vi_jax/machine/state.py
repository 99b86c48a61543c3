"""States with named components, and states from the values that a user's function returns."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu

from .leaves import split_index
from .printing import in_words, known


class State:
    """A state with components of any names: `vi.State(x=0.0, u=1.0)`, then `z.x`. It is a pytree.

    A component is a number, an array, or another state.
    """

    def __init__(self, **components: Any):
        for name in components:
            if hasattr(State, name):
                raise ValueError(f"A component of a state cannot be called {name!r}.")
        self.__dict__.update(components)

    def replace(self, **components: Any) -> "State":
        """Return the state with other values of these components. **Raises:** `TypeError` for a
        name that the state does not have."""
        unknown = [name for name in components if name not in vars(self)]
        if unknown:
            raise TypeError(
                f"The state has no component {unknown[0]!r}; it has {', '.join(vars(self))}."
            )
        return _state(vars(self) | components)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"A state cannot be changed. Use `state.replace({name}=...)`.")

    def __getattr__(self, name: str) -> Any:  # of missing names
        known = ", ".join(vars(self))
        raise AttributeError(f"The state has no component {name!r}; it has {known}.")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, State) and bool(eqx.tree_equal(self, other))

    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __repr__(self) -> str:
        return in_words(self) if known(self) else f"State({', '.join(vars(self))})"


def _state(components: Mapping[str, Any]) -> State:
    """Return a state whose components may also be placeholders of JAX."""
    new = object.__new__(State)
    new.__dict__.update(components)
    return new


def _parts_with_keys(state: State) -> tuple[list[tuple[Any, Any]], tuple[str, ...]]:
    return [(jtu.GetAttrKey(k), x) for k, x in vars(state).items()], tuple(vars(state))


def _parts(state: State) -> tuple[tuple[Any, ...], tuple[str, ...]]:
    return tuple(vars(state).values()), tuple(vars(state))


jtu.register_pytree_with_keys(
    State,
    _parts_with_keys,
    lambda names, parts: _state(dict(zip(names, parts, strict=True))),
    _parts,
)


def like(state: Any, found: Any, whose: str) -> Any:
    """Return the result of a user's function, also a dictionary, in the form of a state; raise
    `TypeError` that names a missing or an unknown component."""
    if isinstance(found, State):
        return with_components(state, vars(found), whose, all_of_them=True)
    if isinstance(found, Mapping) and type(found) is not type(state):
        return with_components(state, found, whose, all_of_them=True)
    if jtu.tree_structure(found) != jtu.tree_structure(state):
        return found
    return jtu.tree_map(_as_array, state, found)


def changed(state: Any, found: Any, whose: str) -> Any:
    """Return the state after a jump, for which a function returned the changed components."""
    if isinstance(found, Mapping):
        return with_components(state, found, whose, all_of_them=False)
    return like(state, found, whose)


def with_components(state: Any, given: Mapping[str, Any], whose: str, *, all_of_them: bool) -> Any:
    """Return a state with these components, each with the type of the old one."""
    if isinstance(state, Mapping):
        parts = state
    elif hasattr(state, "__dict__"):
        parts = vars(state)
    else:
        raise TypeError(f"{whose} returned names, but its state has none: {type(state).__name__}.")
    names = list(parts)
    given = _in_arrays(parts, given)
    missing = [x for x in names if x not in given] if all_of_them else []
    extra = [x for x in given if x not in names]
    if missing or extra:
        wrong = f"there is no {extra[0]!r}" if extra else f"{missing[0]!r} is missing"
        raise TypeError(f"{whose} must return the components {', '.join(names)}, but {wrong}.")
    new = {x: _component(parts[x], given[x], whose) for x in names if x in given}
    if isinstance(state, State):
        return _state({**parts, **new})
    if isinstance(state, Mapping):
        return type(state)({**parts, **new})  # pyright: ignore
    return eqx.tree_at(lambda z: [getattr(z, x) for x in new], state, list(new.values()))


def _in_arrays(parts: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return components, of which some were given by single numbers such as `"x[3]"`."""
    found: dict[str, Any] = {}
    for name, value in given.items():
        base, index = (name, ()) if name in parts else split_index(name)
        old = found.get(base, parts.get(base)) if index else None
        found[name if old is None else base] = value if old is None else old.at[index].set(value)
    return found


def _component(old: Any, new: Any, whose: str) -> Any:
    if isinstance(old, State) or isinstance(new, Mapping):
        return like(old, new, whose)
    return jtu.tree_map(_as_array, old, new)


def _as_array(old: Any, new: Any) -> Any:
    """Return a plain number as an array like `old`; all else unchanged."""
    if hasattr(new, "dtype") or not isinstance(new, int | float) or isinstance(new, bool):
        return new
    return jnp.full(jnp.shape(old), new, jnp.result_type(float, old))
