"""A function of numbers, computed by NumPy: at once, where XLA would first compile it."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import eval_jaxpr

from ..lanes import called

_SAME = """add sub:subtract mul:multiply div:divide neg:negative sign abs floor ceil max:maximum
min:minimum rem:fmod pow square sqrt cbrt exp exp2 log log1p expm1 sin cos tan asin acos atan atan2
sinh cosh tanh asinh acosh atanh lt:less le:less_equal gt:greater ge:greater_equal eq:equal
ne:not_equal and:bitwise_and or:bitwise_or not:invert xor:bitwise_xor is_finite:isfinite"""

_NAMES = (word.partition(":")[::2] for word in _SAME.split())
_RULES: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, own or name) for name, own in _NAMES},
    "convert_element_type": lambda x, *, new_dtype, **_: np.asarray(x).astype(new_dtype),
    "integer_pow": lambda x, *, y: np.asarray(x) ** float(y),
    "logistic": lambda x, **_: 1 / (1 + np.exp(-x)),
    "stop_gradient": lambda x, **_: x,
    "rsqrt": lambda x, **_: 1 / np.sqrt(x),
    "select_n": lambda which, *cases: np.choose(np.asarray(which, int), cases),
}


def by_numpy(function: Callable[..., Any], *arguments: Any) -> Any:
    """What the function of JAX arrays returns, its leaves as NumPy arrays.

    Traced once for each structure of its arguments, whose parts that are no numbers must be such
    as can be looked up.
    """
    numbers, others = eqx.partition(arguments, eqx.is_array_like)
    numbers, treedef = jtu.tree_flatten(numbers)
    others, frame = jtu.tree_flatten(others)
    traced = _traced.trace(function, treedef, tuple(others), frame, numbers)
    with np.errstate(all="ignore"):
        found = _run(traced.jaxpr, numbers)
    return jtu.tree_unflatten(jtu.tree_structure(traced.out_info), map(np.asarray, found))


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _traced(function: Any, treedef: Any, others: Any, frame: Any, numbers: list[Any]) -> Any:
    """The function's value, its arguments put together from their parts; traced, never run.

    **Arguments:** `treedef` and `numbers`, the structure and the leaves of those parts that are
    numbers; `frame` and `others`, those of the rest.
    """
    parts = jtu.tree_unflatten(treedef, numbers), jtu.tree_unflatten(frame, others)
    return function(*eqx.combine(*parts))


def _run(traced: Any, arguments: list[Any]) -> list[Any]:
    """The results of a `ClosedJaxpr`, or of a `Jaxpr` without constants."""
    jaxpr = getattr(traced, "jaxpr", traced)
    names, consts = [*jaxpr.constvars, *jaxpr.invars], getattr(traced, "consts", [])
    known = dict(zip(names, [*consts, *arguments], strict=True))

    def value(x: Any) -> Any:
        return np.asarray(x.val if hasattr(x, "val") else known[x])

    for equation in jaxpr.eqns:
        values = [value(x) for x in equation.invars]
        results = _results(equation, values)
        if results is None:
            results = _by_xla(jaxpr, equation, values)
        known.update(zip(equation.outvars, results, strict=True))
    return [value(x) for x in jaxpr.outvars]


def _by_xla(jaxpr: Any, equation: Any, values: list[Any]) -> list[Any]:
    """What any operation gives, compiled as it is."""
    given = [x for x in equation.invars if not hasattr(x, "val")]
    alone = jaxpr.replace(constvars=[], invars=given, outvars=equation.outvars, eqns=[equation])
    known = (v for x, v in zip(equation.invars, values, strict=True) if not hasattr(x, "val"))
    return eval_jaxpr(alone, [], *known)


def _results(equation: Any, values: list[Any]) -> list[Any] | None:
    """What an operation gives; `None` if it is none of those above."""
    name, params = equation.primitive.name, equation.params
    if (body := called(equation)) is not None:
        return _run(body, values)
    of_whole = name == "div" and np.issubdtype(values[0].dtype, np.integer)
    if name not in _RULES or of_whole:
        return None
    own = params if name in ("convert_element_type", "integer_pow") else {}
    return [_RULES[name](*values, **own)]
