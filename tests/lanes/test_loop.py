"""The loop over lanes: batches, axes, threads, backends, precision and processors."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vi_jax import lanes
from vi_jax.lanes.runtime import thread_count

from lanes.toys import MANY, ROWS, batch, fall, logistic


def plain(x, r, n):
    """Iterate the map in Python for one lane."""
    out = [x]
    for _ in range(int(n)):
        x = r * x * (1 - x)
        x = 0.9 + 0.1 * np.sin(x - 0.9) if x > 0.9 else x
        out.append(x)
    return out


@pytest.mark.parametrize("size", [0, 1, 9, 101])
def test_batches_of_all_sizes(size):
    x, r, n = batch(size)
    (last, steps), rows = MANY(x, r, n)
    assert last.shape == (size,) and rows["x"].shape == (size, ROWS)
    np.testing.assert_array_equal(steps, n)
    for i in range(0, size, max(1, size // 20)):
        expected = plain(x[i], r[i], n[i])
        np.testing.assert_allclose(last[i], expected[-1], rtol=1e-9)
        kept = np.full(ROWS, np.nan)
        kept[: len(expected)] = expected[:ROWS]
        np.testing.assert_allclose(rows["x"][i], kept, rtol=1e-9)
        assert rows["steps"][i, min(len(expected), ROWS) - 1] == min(len(expected), ROWS) - 1


def test_the_context_sets_the_backend():
    with lanes.backend("xla"):
        jaxpr = jax.make_jaxpr(lambda x: logistic(x, 3.0, 4.0))(0.5)
    assert "backend=xla" in str(jaxpr)
    with pytest.raises(ValueError, match="name"), lanes.backend("motorway"):
        pass


@pytest.mark.slow
@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.data())
def test_lanes_do_not_depend_on_each_other(data):
    """Results are bitwise equal in any batch, in any order, on any number of threads."""
    size = 64 * lanes.cores() + 19  # in wide groups
    values = batch(size)
    with lanes.threads(1):
        whole = jax.tree.leaves(MANY(*values))
    chosen = data.draw(st.lists(st.integers(0, size - 1), min_size=1, max_size=40))
    chosen = np.resize(chosen, data.draw(st.sampled_from([3, 7, 40])))  # only three programs
    with lanes.threads(data.draw(st.integers(1, 4))):
        part = jax.tree.leaves(MANY(*(x[chosen] for x in values)))
    for a, b in zip(whole, part, strict=True):
        np.testing.assert_array_equal(np.asarray(a)[chosen], b)


def test_the_number_of_threads_holds_on_threads_without_a_context():
    """XLA runs larger programs on its own threads, which have no context."""

    def found():
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(thread_count).result()

    with lanes.threads(3):
        assert found() == thread_count() == 3
        with lanes.threads(1):
            assert found() == thread_count() == 1
        assert found() == 3
    assert found() == thread_count() == lanes.cores()


def test_nested_and_shared_axes():
    x, r, _ = batch(6)
    flat = MANY(np.repeat(x, 5), np.tile(r[:5], 6), np.full(30, 9.0))
    both = jax.vmap(jax.vmap(logistic, (None, 0, None)), (0, None, None))(x, r[:5], 9.0)
    swapped = jax.vmap(jax.vmap(logistic, (0, None, None)), (None, 0, None))(x, r[:5], 9.0)
    for a, b, c in zip(*map(jax.tree.leaves, (flat, both, swapped)), strict=True):
        np.testing.assert_array_equal(a.reshape(b.shape), b)
        np.testing.assert_array_equal(b, np.swapaxes(c, 0, 1))


def test_an_empty_batch_with_a_shared_result():
    alone = lambda x: lanes.once(lambda pair: (pair[0], pair[1] + 1.0), (jnp.asarray(2.0), x))
    assert [x.shape for x in jax.vmap(alone)(jnp.zeros(0))] == [(0,), (0,)]


def test_an_eager_call_is_compiled_once():
    lanes.once(jnp.sin, jnp.asarray(0.5))
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: compiled.append(name)
    )
    try:
        np.testing.assert_allclose(lanes.once(jnp.sin, jnp.asarray(0.7)), np.sin(0.7))
    finally:
        jax.monitoring.clear_event_listeners()
    assert not [name for name in compiled if "compile" in name or "trac" in name]


def test_a_falling_ball_agrees_with_the_closed_form():
    height = np.linspace(0.1, 5, 50)
    (time, speed), rows = jax.vmap(fall, (0, None))(height, 9.81)
    np.testing.assert_allclose(time, np.sqrt(2 * height / 9.81), rtol=1e-13)
    np.testing.assert_allclose(speed, -np.sqrt(2 * height * 9.81), rtol=1e-13)
    np.testing.assert_array_equal(rows[:, 0], speed)


def test_closed_over_arrays_are_inputs():
    """Numbers that the functions close over may be traced, batched and differentiated."""

    def shifted(offset):
        def begin(x):
            return x + offset, lanes.Emitted(True, False, None)

        def step(x, carry):
            return carry * offset, lanes.Emitted(jnp.abs(carry) > 1.0, False, None)

        return lanes.run(begin, step, lambda x, carry: carry, 3.0, rows=0)[0]

    offsets = jnp.asarray([0.5, 0.25, 0.1])
    loop = []
    for o in [0.5, 0.25, 0.1]:
        value = 3.0 + o
        going = True
        while going:
            going, value = abs(value) > 1.0, value * o
        loop.append(value)
    np.testing.assert_allclose(jax.vmap(shifted)(offsets), loop)
    slope = jax.vmap(jax.jacfwd(shifted))(offsets)
    h = 1e-6
    change = jax.vmap(shifted)(offsets + h) - jax.vmap(shifted)(offsets - h)
    np.testing.assert_allclose(slope, change / (2 * h), rtol=1e-7)


def test_single_precision():
    values = [x.astype(np.float32) for x in batch(50)]
    values[2] = np.minimum(values[2], 5)
    (last, _), rows = MANY(*values)
    assert last.dtype == np.float32 and rows["x"].dtype == np.float32
    wide = MANY(*(x.astype(float) for x in values))
    np.testing.assert_allclose(last, wide[0][0], rtol=2e-4)


@pytest.mark.parametrize("cpu", ["x86-64-v3", "x86-64"])
def test_code_for_older_processors(cpu):
    import platform

    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("another architecture")
    values = batch(33)
    with lanes.processor(cpu):
        mine = jax.jit(jax.vmap(logistic))(*values)
    for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(MANY(*values)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_a_wrong_carry_raises():
    def begin(x):
        return x, lanes.Emitted(True, False, None)

    def step(x, carry):
        return (carry, carry), lanes.Emitted(False, False, None)

    with pytest.raises(TypeError, match="carry of the structure"):
        lanes.run(begin, step, lambda x, carry: carry, 1.0, rows=0)
