"""NumPy functions in compiled programs, for the linear algebra of small matrices.

XLA would compile it for longer than a search for an orbit takes, and for LAPACK JAX loads SciPy.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from ._vector import Unsupported
from .call import header, numpy_key, register_handler
from .elementary import run_outside_jit


def call_numpy(
    function: Callable[..., Sequence[np.ndarray]], shapes: Sequence[tuple[int, ...]], *arrays: Any
) -> list[Any]:
    """Return the results of a NumPy function, which have no derivatives.

    **Arguments:** `function`, of a module; it gets arrays whose first axes are those of a batch,
    and returns arrays with the same first axes. `shapes`, those of the results without a batch;
    their type is that of the first argument.
    """
    shapes = tuple(map(tuple, shapes))
    return numpy_call_p.bind(*map(jnp.asarray, arrays), function=function, shapes=shapes, batch=())


numpy_call_p = Primitive("numpy_call")
numpy_call_p.multiple_results = True
run_outside_jit(numpy_call_p)


@numpy_call_p.def_abstract_eval
def _(*arrays, function, shapes, batch):
    return [ShapedArray((*batch, *shape), arrays[0].dtype) for shape in shapes]


def _batched(arrays, dims, *, function, shapes, batch):
    size = next(x.shape[d] for x, d in zip(arrays, dims, strict=True) if d is not None)
    moved = [
        jnp.broadcast_to(x, (size, *x.shape)) if d is None else jnp.moveaxis(x, d, 0)
        for x, d in zip(arrays, dims, strict=True)
    ]
    out = numpy_call_p.bind(*moved, function=function, shapes=shapes, batch=(size, *batch))
    return out, [0] * len(out)


batching.primitive_batchers[numpy_call_p] = _batched


def _results(arrays, shapes, batch):
    return [jax.ShapeDtypeStruct((*batch, *shape), arrays[0].dtype) for shape in shapes]


def _by_handler(*arrays, function, shapes, batch):
    head = header(numpy_key(function), 0, 0, [0] * len(arrays))
    call = jax.ffi.ffi_call(register_handler(), _results(arrays, shapes, batch))
    return call(head, *arrays)


# Several threads at once may wait for each other here on a CPU with few cores: see
# https://github.com/jax-ml/jax/issues/25861. It is used on a GPU, and without LLVM.
def _by_callback(*arrays, function, shapes, batch):
    kind = arrays[0].dtype
    call = lambda *x: [np.asarray(y, kind) for y in function(*map(np.asarray, x))]
    return jax.pure_callback(call, _results(arrays, shapes, batch), *arrays)


_lowered_by_callback = mlir.lower_fun(_by_callback, multiple_results=True)


def _lowered(ctx, *arrays, **parameters):
    try:
        register_handler()
    except Unsupported:
        return _lowered_by_callback(ctx, *arrays, **parameters)
    return mlir.lower_fun(_by_handler, multiple_results=True)(ctx, *arrays, **parameters)


mlir.register_lowering(numpy_call_p, _lowered, platform="cpu")
mlir.register_lowering(numpy_call_p, _lowered_by_callback)
