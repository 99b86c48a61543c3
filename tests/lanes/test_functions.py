"""Operations of the vector code agree with XLA's, also for special values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax import lanes

X = np.concatenate(
    [
        np.random.default_rng(1).normal(0, 3, 300),
        [0.0, -0.0, 1.0, -1.0, 0.5, 1.5, 2.5, -2.5, 1e-300, 5e-324, 1e300, 708.0, -745.0, 1e5],
        [np.inf, -np.inf, np.nan],
    ]
)
Y = np.random.default_rng(2).permutation(X)


def once(function, *args, backend):
    """Evaluate `function` in every lane with a loop of one step."""

    def lane(*args):
        def begin(args):
            return jnp.zeros(()), lanes.Emitted(False, False, None)

        def end(args, carry):
            return function(*args)

        return lanes.run(
            begin, lambda args, carry: begin(args), end, args, rows=0, backend=backend
        )[0]

    return jax.jit(jax.vmap(lane))(*args)


# Functions, and the allowed difference in units of rounding for results near one.
FUNCTIONS = {
    "arithmetic": (lambda x, y: (x + y, x - y, x * y, x / y, -x), 1),
    "powers": (lambda x, y: (x**2, x**3, x**7, x**-1, x**-2, jnp.square(x), x**0), 2),
    "roots": (lambda x, y: (jnp.sqrt(x), jax.lax.rsqrt(x)), 2),
    "general power": (
        lambda x, y: (jnp.abs(x) ** 1.5, x**0.5, jnp.where(jnp.abs(x) < 1e-300, 1.0, x) ** -0.5,
                      jnp.abs(x) ** 0.3, jnp.abs(x) ** y), 8,
    ),
    "rounding": (
        lambda x, y: (jnp.round(x), jnp.floor(x), jnp.ceil(x), jax.lax.round(x)), 0,
    ),
    "extremes": (
        lambda x, y: (jnp.maximum(x, y), jnp.minimum(x, y), jnp.maximum(x, 1.0),
                      jnp.minimum(0.5, y), jnp.clip(x, -1.0, 1.0), jnp.abs(x)), 0,
    ),
    "signs": (lambda x, y: (jnp.sign(x), jnp.where(x < y, x, y)), 0),
    "large unsigned": (
        lambda x, y: (jnp.sign(jnp.where(x > 0, jnp.uint32(3_000_000_000), jnp.uint32(0))),), 0,
    ),
    "comparisons": (
        lambda x, y: (x < y, x <= y, x > y, x >= y, x == y, x != y, jnp.isfinite(x)), 0,
    ),
    "flags": (lambda x, y: ((x < 0) & (y < 0), (x < 0) | (y < 0), (x < 0) ^ (y < 0), ~(x < 0)), 0),
    "exponential": (lambda x, y: (jnp.exp(x), jax.nn.sigmoid(x)), 4),
    "logarithm": (lambda x, y: (jnp.log(x), jnp.log(jnp.abs(x))), 4),
    "circle": (lambda x, y: (jnp.sin(x), jnp.cos(x)), 4),
    "remainder": (lambda x, y: (jax.lax.rem(x, jnp.full_like(x, 2.0)),), 1),
    "whole numbers": (
        lambda x, y: (x.astype(jnp.int32), (x.astype(jnp.int32) % 7) // 3,
                      x.astype(jnp.int32) + 3, (x > 0).astype(jnp.int32)), 0,
    ),
    "shifts": (
        lambda x, y: tuple(
            move(x.astype(jnp.int32).astype(jnp.uint32) * jnp.uint32(2654435761), jnp.uint32(by))
            for move in (jax.lax.shift_left, jax.lax.shift_right_logical) for by in (0, 13, 31, 32)
        ), 0,
    ),
    "choice": (
        lambda x, y: (jax.lax.select_n(jnp.clip(x, 0, 2).astype(jnp.int32), x, y, x + y),), 1,
    ),
}  # fmt: skip


def _numbers(name, x, y):
    """Return the arguments; those for which the backends may differ are replaced."""
    kind = x.dtype.type
    if name == "whole numbers":
        whole = (np.abs(x) < 1e9) & (np.abs(y) < 1e9)
        return tuple(np.where(whole, z, kind(1.5)) for z in (x, y))
    if name == "circle":  # argument reduction loses digits for large arguments
        return np.where(np.abs(x) > 1e6, kind(1.0), x), y
    return x, y


@pytest.fixture(scope="module", params=[np.float64, np.float32])
def elementwise(request):
    """Return the type, and the results of all functions by one kernel and by XLA."""
    dtype = request.param
    with np.errstate(over="ignore"):
        x, y = X.astype(dtype), Y.astype(dtype)
    numbers = {name: _numbers(name, x, y) for name in FUNCTIONS}

    def all_of(numbers):
        return {name: FUNCTIONS[name][0](*pair) for name, pair in numbers.items()}

    mine = once(all_of, numbers, backend="auto")
    wanted = {name: FUNCTIONS[name][0](*map(jnp.asarray, pair)) for name, pair in numbers.items()}
    return dtype, mine, wanted


@pytest.mark.parametrize("name", FUNCTIONS)
def test_elementwise(name, elementwise):
    dtype, mine, wanted = elementwise
    units, eps = FUNCTIONS[name][1], np.finfo(dtype).eps
    for a, b in zip(mine[name], wanted[name], strict=True):
        assert a.dtype == b.dtype
        a, b = np.asarray(a), np.asarray(b)
        if a.dtype.kind != "f":
            np.testing.assert_array_equal(a, b)
            continue
        tiny = np.finfo(dtype).tiny  # XLA flushes smaller numbers to zero
        np.testing.assert_allclose(a, b, rtol=units * eps, atol=max(units * eps * 0.5, tiny))


def test_sine_and_cosine_are_accurate_to_rounding():
    x = np.linspace(-40, 40, 8001)
    sine, cosine = once(lambda x: lanes.sincos(x), x, backend="auto")
    np.testing.assert_allclose(sine, np.sin(x), atol=3e-16, rtol=0)
    np.testing.assert_allclose(cosine, np.cos(x), atol=3e-16, rtol=0)


def test_sine_and_cosine_of_huge_arguments_are_nan():
    """Neighbouring numbers beyond 2^52 differ by a radian or more."""
    x = np.array([1e15, -1e15, 1e18, -1e20, 1e300, np.inf, np.nan])
    for value in once(lambda x: (jnp.sin(x), jnp.cos(x)), x, backend="auto"):
        assert np.all(np.abs(value[:2]) <= 1) and np.all(np.isnan(value[2:]))


ARRAYS = {
    "product": lambda x, y: jnp.stack([x, y, x * y]) @ jnp.stack([y, x, 1 + x]),
    "matrix": lambda x, y: jnp.array([[1.0, x], [y, 2.0]]) @ jnp.array([[x, 0.5], [1.0, y]]),
    "sums": lambda x, y: jnp.sum(jnp.stack([x, y, x])) + jnp.max(jnp.stack([x, y])),
    "moved": lambda x, y: jnp.concatenate([jnp.stack([x, y]).T[::-1], jnp.zeros(2) + x])[1:],
    "running": lambda x, y: jnp.cumsum(jnp.stack([x, y, x + y])),
    "padded": lambda x, y: jnp.pad(jnp.stack([x, y]), (1, 2), constant_values=3.0),
    "placed": lambda x, y: jnp.where(jnp.arange(4) == (jnp.abs(x) % 4).astype(int), x, y),
    "sliced": lambda x, y: jax.lax.dynamic_slice(
        jnp.stack([x, y, x * y, x + y]), ((jnp.abs(x) % 5).astype(int),), (2,)
    ),
    "updated": lambda x, y: jax.lax.dynamic_update_slice(
        jnp.stack([x, y, x * y, x + y]), jnp.stack([y]), ((jnp.abs(x) % 5).astype(int),)
    ),
    "split": lambda x, y: jnp.split(jnp.stack([x, y, x, y]), 2)[1],
    "singular": lambda x, y: jnp.concatenate(
        jax.lax.linalg.lu(
            jnp.stack(
                [jnp.stack([0 * x, y, x]), jnp.stack([0 * x, 2 * y, x]), jnp.stack([x, y, y])]
            )
            * jnp.array([0.0, 1.0, 1.0])
        )[0]
    ),
    "zeros in order": lambda x, y: 1 / jnp.sort(jnp.stack([-0.0 * jnp.abs(x), jnp.abs(y)])),
    "several at once": lambda x, y: jax.vmap(lambda t: t * x + y)(jnp.arange(3.0)),
}


@pytest.fixture(scope="module")
def arrays():
    """Return the results of all functions by one kernel and by XLA."""
    x, y = np.random.default_rng(3).normal(0, 2, (2, 37))

    def all_of(x, y):
        return {name: function(x, y) for name, function in ARRAYS.items()}

    return once(all_of, x, y, backend="auto"), jax.vmap(all_of)(x, y)


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_in_a_lane(name, arrays):
    mine, wanted = arrays
    np.testing.assert_allclose(mine[name], wanted[name], rtol=1e-14, atol=1e-14)


def branches(x, y):
    """Nested branches in a loop whose length differs between lanes."""

    def body(state):
        i, total = state
        inner = jax.lax.cond(
            total > 1.0, lambda t: jax.lax.cond(t > 2.0, lambda t: 0.25 * t, lambda t: t - 0.5, t),
            lambda t: t + jnp.abs(y), total,
        )  # fmt: skip
        return i + 1, inner

    count, total = jax.lax.while_loop(lambda s: s[0] < jnp.abs(x) * 3, body, (0.0, y))
    doubled, steps = jax.lax.scan(lambda c, k: (c * 0.5 + k, c), total, jnp.arange(4.0))
    case = jax.lax.switch(
        jnp.clip(x, 0, 3).astype(int), [lambda t: t, jnp.sin, lambda t: t * t, lambda t: -t], y
    )
    return count, total, doubled, steps, case, jax.lax.fori_loop(0, 3, lambda i, t: t * x, y)


def test_control_flow():
    x, y = np.random.default_rng(4).normal(0, 2, (2, 203))
    for a, b in zip(once(branches, x, y, backend="auto"), jax.vmap(branches)(x, y), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15)


def quotients(x, y):
    """Divisions in all kinds of sub-jaxprs, by variables and constants, and reciprocals."""
    inner = jax.jit(lambda a: jnp.sin(a) / (1 + a * a))
    branch = jax.lax.cond(x > 0, lambda a: a / y, lambda a: y / (2 + a), jnp.abs(x))
    loop = jax.lax.fori_loop(0, 3, lambda i, a: a / (1 + y * y), x)
    rows = jax.lax.scan(lambda a, b: (a / (1 + b * b), a / 3), y, jnp.stack([x, y]))[1]
    return x / y + 1 / y - x / 2 + inner(y) + branch + loop + rows.sum()


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["auto", "xla"])
def test_derivatives_of_quotients(backend):
    rng = np.random.default_rng(4)
    x, y = rng.normal(0, 3, 50), rng.uniform(0.5, 3, 50) * rng.choice([-1, 1], 50)

    def derivatives(function):
        first = jax.jacfwd(function, (0, 1))
        return function, first, jax.jacfwd(first, (0, 1))

    def here(x, y):
        return once(lambda x, y: (quotients(x, y),), x[None], y[None], backend=backend)[0][0]

    for lanes_, plain in zip(derivatives(here), derivatives(quotients), strict=True):
        found, wanted = jax.jit(jax.vmap(lanes_))(x, y), jax.jit(jax.vmap(plain))(x, y)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", [jnp.int32, jnp.int64, jnp.uint32])
@pytest.mark.parametrize("count", [3, 64])
def test_division_of_integers(kind, count):
    """Agree with XLA, also for divisors 0 and -1. Three lanes leave empty slots in their group."""
    rng = np.random.default_rng(5)
    low = 0 if kind == jnp.uint32 else -4
    info = jnp.iinfo(kind)
    a = rng.integers(low, 100, count).astype(kind)
    a[:2] = info.min, info.max
    b = rng.integers(low, 4, count).astype(kind)
    b[:3] = kind(-1) if low else 1, 0, 0

    def both(a, b):
        return jax.lax.div(a, b), jax.lax.rem(a, b)

    mine = once(both, a, b, backend="auto")
    for x, y in zip(mine, jax.jit(jax.vmap(both))(a, b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_equal_calls_are_made_once_and_unused_results_are_not_computed(monkeypatch):
    """A part with a square root and a long chain is called three times, twice with the
    same numbers, and a fourth time for the root alone."""
    texts, write = [], lanes.runtime.kernel_text
    monkeypatch.setattr(
        lanes.runtime, "kernel_text", lambda *a: texts.append(write(*a)) or texts[-1]
    )

    @jax.jit
    def part(x):
        y = x
        for n in range(60):
            y = 0.5 * y + jnp.tanh(x + n)
        return jnp.sqrt(jnp.abs(x)), y

    def several(x, y):
        return part(x), part(y), part(x), part(x * y)[0]

    compiled, expected = (once(several, X[:8], Y[:8], backend=b) for b in ("llvm", "xla"))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), compiled, expected)
    (text,) = texts
    kernel = text.split("define void @kernel")[1]
    assert kernel.count("call fastcc") == 2
