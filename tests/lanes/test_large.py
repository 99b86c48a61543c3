"""Operations on arrays that are too large for registers agree with XLA's."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax import lanes

N = 23
R = np.random.default_rng(7)
X = R.normal(size=(11, N))
Y = R.normal(size=(11, N))
A = R.normal(size=(N, N))
I = R.integers(-3, N + 3, size=(11,))
TABLE = np.cumsum(R.uniform(0.1, 1, size=40))


def shrunk(x):
    return jax.lax.while_loop(lambda c: jnp.abs(c).max() > 0.5, lambda c: c * 0.6, x)


def deep(x, y):
    def turn(c, row):
        return jnp.roll(c, 1) * 0.5 + row, c[:3] + row[0]

    return jax.lax.scan(turn, x, jnp.stack([y, x, y * x, -y]), reverse=True)


def until(x):
    return jax.lax.while_loop(
        lambda c: c[1] < jnp.abs(c[0][0]) * 4 + 3,
        lambda c: (jnp.roll(c[0], 1) * 0.9, c[1] + 1),
        (x, 0.0),
    )


def swapped(x, y):
    return jax.lax.fori_loop(0, 5, lambda i, c: (c[1] + i, c[0][::-1]), (x, y))


def long(x):
    return jax.lax.scan(lambda c, r: (c * 0.9 + r, c.sum()), x[:3], jnp.tile(x, 40)[:, None])


def branches(x, y):
    return jax.lax.cond(
        x[0] > 0, lambda x, y: (x * y, y, x[0]), lambda x, y: (x + jnp.roll(y, 2), y, y[1]), x, y
    )


def three(x, y):
    return jax.lax.switch(
        jnp.asarray(jnp.floor(x[0] * 2), int),
        [lambda x, y: x, lambda x, y: y.at[0].set(x[3]), lambda x, y: jnp.sin(x) * y], x, y,
    )  # fmt: skip


def mlp(x):
    W = jnp.asarray(A)
    return jnp.tanh(W @ jnp.tanh(W[:, :7] @ x[:7] + x) - 1.0) @ jnp.ones(N)


# Functions of two arrays and an integer per lane.
FUNCTIONS = {
    "elementwise": lambda x, y, i: (x * y + jnp.sin(x) * 3, jnp.where(x > y, x, y), x > 0, -x / 2),
    "one number": lambda x, y, i: (x * 0 + 3.0, jnp.full(N, x[0]) * 2 + y, jnp.zeros(N)),
    "sincos": lambda x, y, i: lanes.sincos(x + y),
    "parts": lambda x, y, i: (x[3], x[-1], x[2:19] - y[4:21], x[::2], x[::-1] * y, x[1:3]),
    "set": lambda x, y, i: (
        x.at[0].add(y[2]), x.at[-1].set(3.0), x.at[3:8].mul(y[:5]),
        (x + y).at[2].add(1.0).at[3].set(0.0),
    ),
    "set where": lambda x, y, i: (
        x.at[i].set(7.0), x.at[i].add(y[0]), x.at[i].set(7.0, mode="clip"),
        x.at[jnp.asarray([2, 5, 2])].add(y[:3]),
        x.at[jnp.asarray([i, i + 1, i])].multiply(2.0), x.at[i].min(0.0), x.at[i].max(0.0),
    ),
    "scattered": lambda x, y, i: (
        jnp.zeros(5).at[jnp.arange(N) % 5].add(x), jnp.zeros(40).at[jnp.arange(N) * i].add(x),
    ),
    "taken": lambda x, y, i: (
        x[i], jnp.take(x, i, mode="fill"), x[jnp.asarray([5, 0, 5])], x[jnp.arange(N)[::-1]] - y,
        jnp.take(x, jnp.arange(N) + i, mode="clip"), jnp.asarray(A)[i], jnp.asarray(A)[:, i],
    ),
    "dynamic": lambda x, y, i: (
        jax.lax.dynamic_slice(x, (i,), (18,)), jax.lax.dynamic_slice(x * y, (i,), (2,)),
        jax.lax.dynamic_update_slice(x, y[:4], (i,)), jax.lax.dynamic_update_slice(x, y[:4], (3,)),
        jax.lax.dynamic_slice(jnp.asarray(A), (i, 2), (3, 20)),
    ),
    "joined": lambda x, y, i: (
        jnp.concatenate([x, y[:2], x[4:5]]), jnp.stack([x, y]), jnp.pad(x, (2, 3)),
        jnp.roll(x, 3) * y,
        jnp.stack([x[0]] * 18), jnp.concatenate([y[:2], x])[1:20] * 2, jnp.append(x, 3.0),
        jnp.tile(x, 2),
    ),
    "padded": lambda x, y, i: (
        jax.lax.pad(x, 2.0, [(1, -3, 2)]), jax.lax.pad(x * y, y[0], [(-2, 4, 0)]),
        jax.lax.pad(x[:4], 2.0, [(-1, 3, 1)]), jax.lax.pad(x[:4], 2.0, [(-1, 20, 1)]),
        jax.lax.pad(x, 9.0, [(25, -24, 0)]), jax.lax.pad(x, 9.0, [(-24, 25, 0)]),
        jax.lax.pad(jnp.outer(x, y), 1.0, [(0, 1, 0), (-1, 2, 1)]),
    ),
    "shapes": lambda x, y, i: (
        (x[:, None] * y).T, (x[:20] * 2).reshape(4, 5).T, jnp.outer(x, y).reshape(-1)[::7],
        jnp.broadcast_to(x[:5] * 2, (7, 5)), jnp.split(x + y, [3, 22]),
        jnp.expand_dims(x, 1) + y[None],
    ),
    "sums": lambda x, y, i: (
        x.sum(), (x * y).mean(), x.max(), x.min(), jnp.prod(x), (x > 0).any(), (x > -9).all(),
        jnp.outer(x, y).sum(0), jnp.outer(x, y).max(1), jnp.outer(x, y).sum(),
        x.at[2].set(0.0).sum(),
        jnp.outer(x[:3], y).sum(1), jnp.linalg.norm(x), jnp.concatenate([x, y]).sum(),
    ),
    "running": lambda x, y, i: (
        jnp.cumsum(x), jnp.cumprod(x + y), jax.lax.cummax(x), jax.lax.cummin(x, reverse=True),
        jnp.cumprod(x[:4]), jax.lax.cummax(x[:5]), jax.lax.cummin(x[:5]),
        jnp.cumsum(jnp.outer(x, y), axis=1), jnp.cumsum(jnp.outer(x, y), axis=0),
    ),
    "products": lambda x, y, i: (
        jnp.asarray(A) @ x, -jnp.asarray(A) @ (x * y), x @ jnp.asarray(A), jnp.asarray(A)[:3] @ x,
        x @ y,
        jnp.outer(x, y) @ x, jnp.outer(x, y)[:4] @ jnp.asarray(A),
        jnp.einsum("i,ij,j", x, jnp.asarray(A), y),
        jnp.tensordot(jnp.outer(x, y), jnp.asarray(A)),
    ),
    "mapped": lambda x, y, i: (
        jax.vmap(lambda a, b: a * b + jnp.where(a > 0, a, b))(x, y),
        jax.vmap(lambda r, a: r @ y * a)(jnp.asarray(A), x),
        jax.vmap(lambda k: jnp.roll(x, 1).at[k].set(0.0))(jnp.arange(3)),
    ),
    "loops": lambda x, y, i: (deep(x, y), until(x), swapped(x, y), long(x)),
    "conditions": lambda x, y, i: (branches(x, y), three(x, y)),
    "table": lambda x, y, i: (
        jnp.interp(x[0] * 5, jnp.asarray(TABLE), jnp.sin(jnp.asarray(TABLE))),
        jnp.interp(x, jnp.asarray(TABLE[:20]), y[:20]), jnp.polyval(jnp.asarray(TABLE[:5]), x[1]),
        jnp.searchsorted(jnp.asarray(TABLE), x[0]),
    ),
    "network": lambda x, y, i: (mlp(x), jax.nn.softplus(x), jax.nn.gelu(x), jax.nn.softmax(x),
        jax.nn.relu(x)),
    "integers": lambda x, y, i: (
        jnp.arange(N) * i, (jnp.arange(30) + i) % 7, jnp.argmax(x), jnp.argmin(x * y),
        jnp.floor(x).astype(int),
    ),
    "not a number": lambda x, y, i: tuple(
        f(jnp.where(a > 0.3, jnp.nan, jnp.where(a < -0.3, a, -0.0 * a)))
        for f in (jnp.sort, jnp.argsort, jnp.median, jnp.max, jnp.min) for a in (x, x[:7])
    ),
    "unsigned": lambda x, y, i: tuple(
        f((jnp.abs(a) * 3e9).astype(jnp.uint32))
        for f in (
            jnp.max, jnp.min, jnp.argmax, jnp.sort, jax.lax.cummin,
            lambda u: u.at[0].max(jnp.uint32(7)), lambda u: u.at[i].min(jnp.uint32(2**31 + 1)),
        )
        for a in (x / 4, y[:5] / 4)
    ),
    "loops beside each other": lambda x, y, i: tuple(
        jax.vmap(shrunk)(a) for a in (x, x[:6], x[:20].reshape(4, 5), y[:8].reshape(2, 4))
    ),
    "sorted": lambda x, y, i: (jnp.sort(x), jnp.argsort(x[:9]), jnp.sort(x[:4]), jnp.median(x)),
    "solved": lambda x, y, i: (
        jnp.linalg.solve(jnp.outer(x[:3], y[:3]) + jnp.eye(3), x[:3]),
        jnp.linalg.solve(jnp.asarray(A[:6, :6]) + x[0] * jnp.eye(6), y[:6]),
        jnp.linalg.inv(jnp.asarray(A[:3, :3]) + 4 * jnp.eye(3) + x[0] ** 2),
        jnp.linalg.cholesky(jnp.outer(x[:5], x[:5]) + jnp.eye(5)),
        jnp.linalg.det(jnp.asarray(A[:3, :3]) + x[0]),
    ),
    "single precision": lambda x, y, i: (
        (x.astype(jnp.float32) * 3)[2:], jnp.asarray(A, jnp.float32) @ y.astype(jnp.float32),
    ),
}  # fmt: skip


def _once(function, args):
    """Evaluate the function in every lane by vector code; a fallback to XLA is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return jax.jit(jax.vmap(lambda *a: lanes.once(lambda a: function(*a), a)))(*args)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_results_agree_with_xla(name):
    function = FUNCTIONS[name]
    args = jnp.asarray(X), jnp.asarray(Y), jnp.asarray(I)
    ours, truth = _once(function, args), jax.jit(jax.vmap(function))(*args)
    # Sums of some hundred numbers have another order.
    rtol = 2e-4 if name == "single precision" else 2e-11
    for a, b in zip(*map(jax.tree_util.tree_leaves, (ours, truth)), strict=True):
        assert a.dtype == b.dtype and a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)


def test_blocks_of_the_carry_are_written_in_place():
    """A row is replaced in each iteration; what was read before keeps its old numbers."""
    size, width = 40, 5

    def begin(x):
        carry = jnp.zeros((size, width)) + x, x * 0, x
        return carry, lanes.Emitted(True, False, (x * jnp.ones(width), x * jnp.ones(3 * width)))

    def step(x, carry):
        table, n, y = carry
        at = jnp.mod(3 * n + jnp.floor(x), size).astype(jnp.int32)
        zero = jnp.zeros_like(at)
        before = jax.lax.dynamic_slice(table, (at, zero), (1, width))[0]
        many = 2 * table[3:7].ravel()  # computed when it is used, after the row is replaced
        row = y * jnp.arange(1.0, width + 1)
        table = jax.lax.dynamic_update_slice(table, row[None], (at, zero))
        y = 0.9 * y + 0.1 * jnp.sum(before) + 0.01 * jnp.sum(many)
        return (table, n + 1, jnp.sin(y)), lanes.Emitted(n < 30 + x, False, (before, many[:15]))

    def run(x, backend):
        out, _ = lanes.run(begin, step, lambda x, c: c[:1] + c[2:], x, rows=0, backend=backend)
        return out

    xs = jnp.linspace(0.3, 9.7, 20)
    for function in (run, lambda x, b: jax.jvp(lambda x: run(x, b), (x,), (1.0,))[1]):
        fast, plain = (jax.vmap(lambda x, b=b, f=function: f(x, b))(xs) for b in ("auto", "xla"))
        for a, b in zip(fast, plain, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
