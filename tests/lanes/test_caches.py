"""Caches: machine code in files, kernels, and programs of equal functions."""

import gc
import weakref
from functools import partial, wraps

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax import lanes
from vi_jax._programs import maps_used
from vi_jax.lanes import _code, _text, runtime

from lanes.toys import failing


def program_of(function, *args):
    equations = jax.make_jaxpr(function)(*args).jaxpr.eqns
    return next(e.params["program"] for e in equations if e.primitive.name == "lanes")


def test_machine_code_is_cached_in_files(monkeypatch, tmp_path):
    def fallen():
        kernel = runtime.Kernel("define void @kernel() { ret void }", None, 8)
        return kernel.function

    monkeypatch.setattr(_code, "_cache_folder", lambda: tmp_path)
    fallen()
    (kept,) = tmp_path.rglob("*.o")
    content = kept.read_bytes()
    with monkeypatch.context() as patched:
        patched.setattr(_code, "object_code", failing)
        fallen()  # from the file
        kept.write_bytes(content[:-1])
        with pytest.raises(RuntimeError, match="LLVM: no such"):
            fallen()
    fallen()
    assert kept.read_bytes() == content


def test_the_cache_folder_is_within_that_of_jax(tmp_path):
    before = jax.config.jax_compilation_cache_dir  # pyright: ignore
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path))
        assert _code._cache_folder() == tmp_path / "vi_jax_lanes"
        jax.config.update("jax_compilation_cache_dir", "gs://far/away")
        assert _code._cache_folder() is None
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_old_programs_are_dropped():
    """Memory maps and kernels stay few after many programs in one process."""

    def one(number):
        begin = lambda x: (x, lanes.Emitted(True, False, None))
        step = lambda x, carry: (carry + number, lanes.Emitted(False, False, None))
        return lanes.run(begin, step, lambda x, carry: carry, 1.0, rows=0)[0]

    def kernels(numbers):
        for number in numbers:
            runtime.kernel_of(program_of(partial(one, float(number))), 1)

    kernels(range(80))
    before = maps_used() or 0
    kernels(range(80, 240))
    assert (maps_used() or 0) - before < 160
    assert len(runtime._recent) <= runtime._MOST_KERNELS


def test_arrays_are_freed_without_the_garbage_collector(monkeypatch):
    """Otherwise texts, and so the names of cached files, would depend on when it runs."""
    function = lambda x: (jnp.outer(x, x) @ jnp.sin(x), jnp.sort(x), jnp.cumsum(x))
    program = program_of(lambda x: lanes.once(function, x), jnp.ones(23))
    blocks, take = [], _text.Arena.take
    kept = lambda *args: (blocks.append(weakref.ref(block := take(*args))), block)[1]
    monkeypatch.setattr(_text.Arena, "take", kept)
    gc.disable()
    runtime.kernel_text(program, 8, 512)
    gc.enable()
    assert blocks and not any(block() for block in blocks)


def _sum(bound, x):
    return x + bound["offset"] if isinstance(bound["offset"], float) else x - bound["offset"]


@pytest.mark.slow
def test_constants_bound_to_a_function_distinguish_programs():
    """Equal constants share a program, unless types or signs of zero differ."""

    def found(offset):
        return program_of(lambda x: lanes.once(partial(_sum, {"offset": offset}), x), 1.0)

    assert found(2.0) is found(2.0) and found(2) is found(2)
    assert found(np.array([1.0, 2.0])[1]) is found(np.float64(2.0))
    several = 1.0, 1, True, np.float32(1.0), 0.0, -0.0, 0, np.float32(-0.0), Metres(1.29)
    programs = [found(x) for x in (*several, Metres(1.31), 0j, complex(0.0, -0.0))]
    assert len(set(map(id, programs))) == len(programs)
    x = jnp.asarray(3.0)
    assert lanes.once(partial(_sum, {"offset": 1.0}), x) == 4.0
    assert lanes.once(partial(_sum, {"offset": 1}), x) == 2.0


class Metres(float):
    """A number whose `repr` is rounded."""

    def __repr__(self):
        return f"{float(self):.1f} m"


FACTOR = 2.0


def _scaled(x):
    return FACTOR * x


@pytest.mark.slow
def test_clearing_the_caches_of_jax_clears_those_of_lanes(monkeypatch):
    x = jnp.asarray(3.0)
    assert lanes.once(_scaled, x) == 6.0
    monkeypatch.setitem(globals(), "FACTOR", 5.0)
    jax.clear_caches()
    assert lanes.once(_scaled, x) == 15.0


def test_decorated_functions_are_distinguished_by_their_wrapper():
    def times(box):
        @wraps(_scaled)
        def wrapper(x):
            return box[0] * x

        return wrapper

    box, x = [2.0], jnp.asarray(3.0)
    scaled = times(box)
    assert lanes.once(scaled, x) == 6.0
    box[0] = 5.0
    assert lanes.once(scaled, x) == 15.0


def test_traced_numbers_are_not_cached():
    """A function bound as a constant may close over traced numbers."""

    def along(k):
        return lanes.once(partial(_applied, Law(lambda x: k * x)), jnp.asarray(2.0))

    np.testing.assert_allclose(jax.vmap(along)(jnp.arange(3.0)), [0.0, 2.0, 4.0])
    np.testing.assert_allclose(jax.grad(along)(1.5), 2.0)
    np.testing.assert_allclose([along(k) for k in (1.0, jnp.asarray(4.0))], [2.0, 8.0])


class Law:
    """A plain object that holds a function."""

    def __init__(self, function):
        self.function = function


def _applied(law, x):
    return law.function(x)
