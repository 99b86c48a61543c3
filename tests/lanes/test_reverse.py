"""Reverse derivatives by a tape agree with those by columns, for all orders and sizes of tape."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax import lanes
from vi_jax.lanes import _backward, _code, runtime

from differences import quick
from lanes.toys import batch, fall, logistic

P, V, W = (jnp.asarray(x) for x in ([0.2, 0.33, 0.71, 3.7], [0.3, -0.2, 0.5, 0.1],
                                    [0.1, -0.7, 0.2, 0.4]))  # fmt: skip


@pytest.fixture
def by_tape(monkeypatch):
    """Use a tape for any number of inputs and cotangents."""
    monkeypatch.setattr(_backward, "_BY_COLUMNS", 0)
    monkeypatch.setattr(_backward, "_COLUMNS_EACH", 0)


def loss(p, backend=None):
    """A loss of results and rows; lanes share `r`, and some do not reach all rows."""
    x, r = p[:3], p[3]
    (last, _), rows = jax.vmap(lambda x: logistic(x, r, 6.0, backend=backend))(x)
    return jnp.sum(jnp.sin(last)) + jnp.sum(jnp.nan_to_num(rows["x"]) ** 2)


def primitives(function, *args):
    return {e.primitive.name for e in jax.make_jaxpr(function)(*args).eqns}


def test_a_tape_is_used_for_many_inputs():
    many = jnp.linspace(0.1, 0.9, 5)
    one = lambda x: logistic(x[0] * x[1], 3 + x[2] * x[3] * x[4], 6.0)[0][0]
    shared = lambda x, backend: lanes.run(
        lambda x: (x, lanes.Emitted(True, False, None)),
        lambda x, c: (c * c, lanes.Emitted(False, False, None)),
        lambda x, c: jnp.sum(c * x), x, rows=0, backend=backend,
    )[0]  # fmt: skip
    assert "lanes_backward" not in primitives(jax.grad(one), many)
    assert "lanes_backward" in primitives(jax.grad(lambda x: shared(x, None)), many)
    assert "lanes_backward" not in primitives(jax.grad(lambda x: shared(x, "xla")), many)
    for backend in (None, "xla"):
        slope = jax.grad(lambda x, b=backend: shared(x, b))(many)
        np.testing.assert_allclose(slope, 3 * many**2, rtol=1e-15)


ORDERS = {
    "gradient": lambda f: jax.grad(f),
    "checkpoint": lambda f: jax.grad(jax.checkpoint(f)),
    "forward over reverse": lambda f: lambda p: jax.jvp(jax.grad(f), (p,), (V,))[1],
    "hessian": jax.hessian,
    "third": lambda f: lambda p: jax.jvp(ORDERS["forward over reverse"](f), (p,), (W,))[1],
}


@pytest.mark.parametrize("order", quick(ORDERS, "gradient"))
def test_derivatives_of_any_order_agree_with_those_by_columns(by_tape, order):
    program = jax.make_jaxpr(ORDERS[order](loss))(P)
    # A failure means that JAX has renamed primitives in transposed derivatives (see `reverse`).
    assert "lanes_backward" in str(program), "no tape"
    taped = jax.jit(ORDERS[order](loss))(P)
    columns = jax.jit(ORDERS[order](lambda p: loss(p, "xla")))(P)
    np.testing.assert_allclose(taped, columns, rtol=1e-12, atol=1e-12 * np.abs(columns).max())


@pytest.mark.parametrize(
    "derivative",
    [
        lambda f: jax.jacrev(jax.jacrev(f)),
        lambda f: jax.grad(lambda p: jax.jvp(jax.grad(f), (p,), (V,))[1] @ W),
    ],
)
def test_reverse_mode_of_a_tape_is_refused(by_tape, derivative):
    with pytest.raises(NotImplementedError, match=r"Use forward mode .* `jax.jacfwd\(jax.grad"):
        jax.make_jaxpr(derivative(loss))(P)


def gradients(x, r, n):
    def one(x, r, n):
        (last, _), rows = logistic(x, r, n)
        return jnp.sin(last) + jnp.sum(jnp.nan_to_num(rows["x"]))

    return jax.jit(jax.vmap(jax.grad(one, (0, 1))))(x, r, n)


@pytest.mark.slow
def test_gradients_do_not_depend_on_tape_threads_or_batch(by_tape, monkeypatch):
    """A growing tape stores the same states. The maps are chaotic: over 100 steps, a difference in
    rounding would dominate."""
    x, r, n = batch(37)
    n = 8 * n
    with lanes.threads(1):
        whole = gradients(x, r, n)
    chosen = np.array([3, 17, 30, 9, 1])
    with lanes.threads(2):
        part = gradients(x[chosen], r[chosen], n[chosen])
    for a, b in zip(whole, part, strict=True):
        assert np.isfinite(a).all()
        np.testing.assert_array_equal(a[chosen], b)
    write = runtime.reverse_text
    for entries in (1, 6):
        monkeypatch.setattr(runtime, "reverse_text", functools.partial(write, entries=entries))
        monkeypatch.setattr(runtime, "_keys", type(runtime._keys)())
        jax.clear_caches()
        with lanes.threads(2):
            again = gradients(x, r, n)
        for a, b in zip(whole, again, strict=True):
            np.testing.assert_array_equal(a, b)


def ring(x, mix, weights):
    """Twenty chaotic maps, coupled by a matrix that all lanes share."""

    def begin(inputs):
        x, _, _ = inputs
        return (x, jnp.zeros(()), jnp.arange(20)), lanes.Emitted(True, True, x)

    def step(inputs, carry):
        (_, mix, weights), (x, n, order) = inputs, carry
        y = 3.9 * x * (1 - x) * (1 - mix) + mix * (weights @ x)
        y = jax.lax.cond(y[0] > 0.5, lambda y: jnp.roll(y, 1).at[3].multiply(0.9), lambda y: y, y)
        y = jnp.where(y > 0.95, 0.95 * x, y)[order]
        return (y, n + 1, order), lanes.Emitted(n < 10 * x[0] + 10, n % 2 > 0, y)

    end = lambda inputs, carry: (carry[0], carry[1])
    return lanes.run(begin, step, end, (x, mix, weights), rows=9)


@pytest.mark.slow
def test_gradients_of_arrays_in_memory(by_tape, monkeypatch):
    rng = np.random.default_rng(3)
    x, mix = rng.uniform(0.1, 0.9, (11, 20)), rng.uniform(0.1, 0.3, 11)
    weights = rng.dirichlet(np.ones(20), 20)

    def lane(x, mix, weights):
        (last, _), rows = ring(x, mix, weights)
        return jnp.sum(last[::2] ** 2) + jnp.sum(jnp.sin(jnp.nan_to_num(rows)))

    def slopes(x, mix):
        loss = lambda x, mix, weights: jnp.sum(jax.vmap(lane, (0, 0, None))(x, mix, weights))
        return jax.jit(jax.grad(loss, (0, 1, 2)))(x, mix, weights)

    whole = slopes(x, mix)
    way = [jnp.cos(jnp.arange(a.size)).reshape(a.shape) for a in (x, mix, weights)]
    _, along = jax.jvp(
        lambda *a: jnp.sum(jax.vmap(lane, (0, 0, None))(*a)), (x, mix, weights), tuple(way)
    )
    total = sum(jnp.sum(a * b) for a, b in zip(whole, way, strict=True))
    np.testing.assert_allclose(total, along, rtol=1e-10)
    np.testing.assert_array_equal(slopes(x[:3], mix[:3])[0], whole[0][:3])
    write = runtime.reverse_text
    monkeypatch.setattr(runtime, "reverse_text", functools.partial(write, entries=4))
    monkeypatch.setattr(runtime, "_keys", type(runtime._keys)())
    jax.clear_caches()
    for a, b in zip(whole, slopes(x, mix), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_gradients_of_functions_written_in_jax(by_tape, size=23):
    """Compare with JAX's derivatives of the same steps without a loop."""
    functions = (
        lambda c, p: jnp.linalg.solve(jnp.outer(p, p)[:5, :5] + jnp.eye(5), c[:5]).sum() * c,
        lambda c, p: jax.lax.cumprod(c + 0.5) * p,
        lambda c, p: jax.lax.cummax(c * p),
        lambda c, p: jax.lax.pad(c[:4] * p[1], 0.0, [(2, 1, 2)]).sum() * c + jnp.sort(p),
    )

    def all_steps(c, p):
        for f in functions:
            c = f(c, p)
        return c

    def loss(p):
        step = lambda p, c: (all_steps(c, p), lanes.Emitted(False, False, ()))
        begin = lambda p: (p, lanes.Emitted(True, False, ()))
        return jnp.sum(lanes.run(begin, step, lambda p, c: c, p, rows=0)[0] ** 2)

    p = jnp.asarray(np.random.default_rng(1).permutation(np.linspace(0.1, 1, size)))
    wanted = jax.grad(lambda p: jnp.sum(all_steps(p, p) ** 2))(p)
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(p), wanted, rtol=1e-9)
    np.testing.assert_allclose(jax.jvp(loss, (p,), (p,))[1], wanted @ p, rtol=1e-9)


def test_a_zero_cotangent_times_an_infinite_slope_is_zero(by_tape):
    """√x at 0 is not selected: its slope is infinite, but does not enter the derivative."""

    def lane(x, y):
        def step(inputs, c):
            root = jnp.sqrt(c) + jnp.dot(jnp.stack([c, c]), jnp.stack([1 / c, inputs[1]]))
            return jnp.where(c > 0, root, inputs[1] * 2), lanes.Emitted(False, False, None)

        begin = lambda inputs: (inputs[0], lanes.Emitted(True, False, None))
        return lanes.run(begin, step, lambda inputs, c: c, (x, y), rows=0)[0]

    slopes = jax.jit(jax.vmap(jax.grad(lane, (0, 1))))(jnp.asarray([0.0, 4.0]), jnp.ones(2))
    np.testing.assert_allclose(slopes, [[0, 1.25], [2, 4]])


def test_derivatives_of_missing_rows_are_nan(by_tape):
    """Rows that a lane did not reach are NaN, and so are derivatives of functions of them."""
    row = lambda x, k: logistic(x, 3.7, 4.0)[1]["x"][k]
    slope = jax.jit(jax.vmap(jax.grad(row), (None, 0)))(0.3, jnp.arange(7))
    np.testing.assert_array_equal(np.isnan(slope), np.arange(7) > 4)


@pytest.mark.parametrize("size", [1, 9, 40])
def test_gradients_through_an_event(by_tape, size):
    height, g = np.linspace(0.5, 2, size), 9.81
    time = lambda h, g: fall(h, g)[0][0]
    slopes = jax.jit(jax.vmap(jax.grad(time, (0, 1)), (0, None)))(height, g)
    wanted = 0.5 * np.sqrt(2 / height / g), -0.5 * np.sqrt(2 * height / g**3)
    for a, b in zip(slopes, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10)


def test_inner_loops_of_variable_length_use_columns(by_tape):
    """The numbers of iterations depend on the inputs; one loop is in a branch and has another."""

    def lane(x, y):
        def inside(c):
            turn = lambda c: c * y * jax.lax.while_loop(lambda a: a[0] < c, double, (y, 1.0))[1]
            return jax.lax.while_loop(lambda c: c < 50, turn, c)

        double = lambda a: (2 * a[0], a[1] + 1e-3 * jnp.sin(a[0] * y))

        def step(_, c):
            begin = c, y, 0
            c, b, _ = jax.lax.while_loop(
                lambda a: a[0] < 5, lambda a: (a[0] ** 2, a[1] * y * jnp.sin(a[0]), a[2] + 1), begin
            )
            c = jax.lax.cond(c > 6, inside, lambda c: c, jnp.abs(b * c) + 10)
            return c, lanes.Emitted(False, False, None)

        begin = lambda inputs: (inputs[0], lanes.Emitted(True, False, None))
        return lanes.run(begin, step, lambda inputs, c: c, (x, y), rows=0)[0]

    whole = lambda p: jnp.sum(jax.vmap(lane)(p[:3], p[3:]))
    p = jnp.asarray([1.5, 1.3, 2.2, 1.2, 1.4, 1.1])
    assert "lanes_backward" not in str(jax.make_jaxpr(jax.grad(whole))(p))
    wanted = jax.jit(jax.jacfwd(whole))(p)
    np.testing.assert_allclose(jax.jit(jax.grad(whole))(p), wanted, rtol=1e-12)


def test_derivatives_without_a_transpose_use_columns(by_tape):
    """A custom derivative with the tangent in a `while_loop` has no transpose."""

    @jax.custom_jvp
    def cube(c):
        return c**3

    @cube.defjvp
    def _(primals, tangents):
        slope = jax.lax.while_loop(lambda a: a[0] < 3, lambda a: (a[0] + 1, a[1] + primals[0] ** 2
                                   * tangents[0]), (0, 0.0 * tangents[0]))[1]  # fmt: skip
        return cube(primals[0]), slope

    def lane(x):
        step = lambda _, c: (cube(c), lanes.Emitted(False, False, None))
        begin = lambda x: (x, lanes.Emitted(True, False, None))
        return lanes.run(begin, step, lambda x, c: c, x, rows=0)[0]

    assert "lanes_backward" not in primitives(jax.grad(lane), 1.5)
    np.testing.assert_allclose(jax.jit(jax.grad(lane))(1.5), 3 * 1.5**2, rtol=1e-14)


@pytest.mark.slow
def test_columns_are_used_without_llvm(by_tape, monkeypatch):
    def missing():
        raise lanes.Unsupported("no llvmlite")

    monkeypatch.setattr(_code, "llvm", missing)
    monkeypatch.setattr(runtime, "llvm", missing)
    runtime._register_bits.cache_clear()
    with pytest.warns(UserWarning, match="no llvmlite"):
        slope = jax.jit(lambda p: jax.grad(loss)(1.0 * p))(P)
    runtime._register_bits.cache_clear()
    np.testing.assert_allclose(slope, jax.grad(lambda p: loss(p, "xla"))(P), rtol=1e-12)


@pytest.mark.parametrize("room", [{"entries": 1 << 44}, {"entries": 1, "most": 300}])
def test_too_little_memory_is_an_error(by_tape, monkeypatch, room):
    """The tape needs more memory than any machine has, or than a tape may use."""
    write = runtime.reverse_text
    monkeypatch.setattr(runtime, "reverse_text", functools.partial(write, **room))
    monkeypatch.setattr(runtime, "_keys", type(runtime._keys)())
    jax.clear_caches()
    with pytest.raises(Exception, match=r"tape of this gradient needs more .* forward \(`jax.jacf"):
        jax.block_until_ready(jax.jit(lambda p: jax.grad(loss)(p * 1.0))(P))
