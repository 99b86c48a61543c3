"""Caches: machine code in files, kernels, and programs of equal functions."""

from functools import partial, wraps

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax import lanes
from vi_jax.lanes import _code, runtime

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
