"""Types of signatures, and libraries that are loaded at their first use."""

import importlib.util
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from jaxtyping import Array, Bool, Float

Scalar = Float[Array, ""]
"""One number of one lane."""
Flag = Bool[Array, ""]
"""One truth value of one lane."""
Scalars = tuple[Scalar, ...]
"""Several numbers of one lane, such as one per mode or per coordinate."""
Vector = Float[Array, " _"]
"""A state as a one-dimensional array."""
State = Any
"""The state of a machine: a pytree of numbers whose structure the machine defines. Some functions
also take arrays as its leaves. Its rate and other changes of it have the same structure."""


def _lazy(name: str) -> ModuleType:
    """Return a module whose code runs at the first access to it."""
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.find_spec(name)
    if spec is None or spec.loader is None:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    spec.loader = importlib.util.LazyLoader(spec.loader)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


if TYPE_CHECKING:
    import xarray as xr
    import zarr
    from jax.typing import ArrayLike as Number

    from .machine import AbstractMachine as Machine
else:
    xr, zarr = _lazy("xarray"), _lazy("zarr")
    Machine = Any  # the module of `AbstractMachine` imports this one
    Number = Any  # our own checks refuse wrong values, with clearer messages
    """One number as a user passes it: Python's, NumPy's or JAX's, which may be traced."""
