"""Programs without vector code run on XLA's backend with one warning; failures of LLVM."""

import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax import lanes
from vi_jax._programs import compiled
from vi_jax.lanes import _code, _primitive, call, numpy_call, runtime

from lanes.toys import failing, fall


def inverse_of_erf(x, *, backend=None):
    def begin(x):
        return x, lanes.Emitted(True, False, None)

    def step(x, carry):
        return jax.scipy.special.erfinv(carry), lanes.Emitted(False, False, None)

    return lanes.run(begin, step, lambda x, carry: carry, x, rows=0, backend=backend)[0]


def test_sharded_batches_use_vector_code():
    """`shard_map` adds primitives that mark shared values; these need no computation."""
    mesh = jax.sharding.Mesh(np.asarray(jax.devices()[:1]), ("lanes",))
    split = jax.sharding.PartitionSpec("lanes")
    heights = jnp.linspace(0.5, 2.0, 13)

    def both(height):
        return jax.jvp(lambda x: fall(x, 9.81)[0], (height,), (jnp.ones_like(height),))

    def sharded(x):
        return jax.shard_map(
            jax.vmap(both), mesh=mesh, in_specs=split, out_specs=split, check_vma=False
        )(x)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = jax.jit(sharded)(heights)
    for a, b in zip(found, jax.vmap(both)(heights), strict=True):
        np.testing.assert_array_equal(a, b)


def test_functions_without_vector_code_use_xla_with_one_warning():

    _primitive._warn.cache_clear()
    with pytest.warns(UserWarning, match="`erf_inv`"):
        out = jax.vmap(inverse_of_erf)(jnp.asarray([0.0, 0.5]))
    np.testing.assert_allclose(out, [0.0, 0.4769362762044699], rtol=1e-13)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # once
        jax.vmap(inverse_of_erf)(jnp.asarray([0.0, 0.5, 0.6]))
        jax.vmap(lambda x: inverse_of_erf(x, backend="xla"))(jnp.asarray([0.0, 0.5]))


@pytest.mark.parametrize("fault", ["missing", "broken"])
def test_without_llvm(fault, monkeypatch):
    for cached in (_primitive._warn, _code.llvm, runtime._register_bits):
        cached.cache_clear()
    if fault == "missing":
        monkeypatch.setitem(sys.modules, "llvmlite.binding", None)
    else:
        monkeypatch.setattr(_code, "object_code", failing)
    try:
        with pytest.warns(UserWarning, match="llvmlite" if fault == "missing" else "LLVM: no such"):
            out = jax.vmap(lambda x: fall(x, 9.8125)[0][0])(jnp.linspace(1.0, 2.0, 5))
    finally:
        _code.llvm.cache_clear()
        runtime._register_bits.cache_clear()
    np.testing.assert_allclose(out, np.sqrt(2 * np.linspace(1, 2, 5) / 9.8125), rtol=1e-12)


def test_a_compiler_error_of_llvm_is_passed_on(monkeypatch):
    def begin(x):
        return x, lanes.Emitted(True, False, None)

    def step(x, carry):
        return carry + 0.15625, lanes.Emitted(False, False, None)

    _code.llvm()  # works before `object_code` is replaced
    monkeypatch.setattr(_code, "object_code", failing)
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"LLVM: no such.*backend\(.xla.\)"):
        jax.block_until_ready(lanes.run(begin, step, lambda x, carry: carry, 1.0, rows=0)[0])


def test_invalid_code_raises():
    """The text uses a value in a block that its definition does not dominate."""
    text = """define void @kernel(i1 %c) {
      entry: br i1 %c, label %a, label %b
      a: %x = add i32 1, 2
         br label %b
      b: %y = add i32 %x, 1
         ret void
    }"""
    with pytest.raises(RuntimeError, match=r"(?s)not valid.* fault of vi_jax.*does not dominate"):
        _code.object_code(_code.llvm(), text, None)


@pytest.mark.parametrize("difference", ["version", "layout"])
def test_another_version_of_xlas_call_interface(difference, monkeypatch):
    """XLA does not register a handler with an unknown version. If the sizes of XLA's structures
    differ, the handler states an unknown version."""
    if difference == "version":
        monkeypatch.setattr(call, "_MINOR", 99)
    else:
        monkeypatch.setattr(call, "_Buffers", call._Frame)  # of another size
    monkeypatch.setattr(call, "TARGET", f"vi_jax_lanes_of_another_{difference}")
    for module in (_primitive, numpy_call):
        monkeypatch.setattr(module, "register_handler", call.register_handler.__wrapped__)
    _primitive._warn.cache_clear()
    heights = jnp.linspace(1.0, 2.0, 5)
    words = r"version 0\.\d+ of XLA's call interface .* is incompatible"
    with pytest.warns(UserWarning, match=words) as seen:
        for gravity in (9.75, jnp.float32(9.5)):  # two programs
            found = jax.jit(jax.vmap(lambda x, g: fall(x, g)[0][0], (0, None)))(heights, gravity)
            np.testing.assert_allclose(found, np.sqrt(2 * heights / gravity), rtol=1e-6)
    assert len(seen) == 1
    assert_calls_numpy()


def sums_and_doubles(x, y):
    return (x + y).sum(axis=-1), 2 * y


def assert_calls_numpy():
    x, y = jnp.arange(6.0).reshape(2, 3), jnp.arange(24.0, dtype=jnp.float32).reshape(4, 3, 2)
    call = lambda x, y: lanes.call_numpy(sums_and_doubles, [(), (3,)], x, y)
    within = jax.vmap(call, (None, -1))
    for function in (jax.vmap(within, (0, 0)), jax.jit(jax.vmap(within, (0, 0)))):
        total, double = function(x, y[:2])
        wanted = x[:, None] + y[:2].transpose(0, 2, 1)
        np.testing.assert_array_equal(total, wanted.sum(axis=-1))
        np.testing.assert_array_equal(double, 2 * y[:2].transpose(0, 2, 1))
        assert double.dtype == total.dtype == jnp.float64


def test_numpy_functions_in_programs():
    assert_calls_numpy()
    with jax.disable_jit():
        assert_calls_numpy()
        np.testing.assert_allclose(fall(1.0, 9.8125)[0], fall(jnp.ones(()), 9.8125)[0])
    with pytest.raises(jax.errors.JaxRuntimeError, match="ValueError: could not be"):
        jax.block_until_ready(lanes.call_numpy(failing_function, [()], 1.0))


def failing_function(x):
    raise ValueError("could not be done")


def test_a_program_on_the_slower_backend_does_not_slow_others():
    """A string argument selects a function with vector code or one without."""
    functions = {"slow": jax.scipy.special.gammaln, "quick": jnp.sin}

    @compiled
    def chosen(word, x):
        return jax.vmap(lambda x: lanes.once(functions[word], x))(x)

    slowly, own = [], chosen._compiled
    chosen._compiled = lambda *arguments: (slowly.append(arguments[0]), own(*arguments))[1]
    x = jnp.linspace(1.0, 2.0, 3)
    with pytest.warns(UserWarning, match="slower backend"):
        chosen("slow", x)
    np.testing.assert_allclose(chosen("quick", x), np.sin(x))
    chosen("slow", 2 * x)
    assert slowly == ["slow", "slow"]
