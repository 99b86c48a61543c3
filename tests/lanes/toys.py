"""Loops for the tests of lanes: a logistic map and a falling ball."""

import jax
import jax.numpy as jnp
import numpy as np
from vi_jax import lanes

ROWS = 12


def logistic(x, r, n, *, backend=None):
    """Iterate x ← r x (1 - x) n times, with a rare branch and one row per step."""

    def begin(inputs):
        x, _, n = inputs
        return (x, jnp.zeros_like(x)), lanes.Emitted(n > 0, True, {"x": x, "steps": 0})

    def step(inputs, carry):
        _, r, n = inputs
        x, done = carry
        x = r * x * (1 - x)
        x = jax.lax.cond(x > 0.9, lambda x: 0.9 + 0.1 * jnp.sin(x - 0.9), lambda x: x, x)
        done = done + 1
        row = {"x": x, "steps": done.astype(jnp.int32)}
        # Not `done < n`: a lane that continues after its end then runs to 99 steps.
        return (x, done), lanes.Emitted((done != n) & (done < 99), True, row)

    def end(inputs, carry):
        return carry[0], carry[1].astype(jnp.int32)

    return lanes.run(begin, step, end, (x, r, n), rows=ROWS, backend=backend)


def fall(height, gravity, h=0.05, *, backend=None):
    """Return time and velocity of a ball when it hits the floor; the time step is h."""

    def begin(inputs):
        height, _ = inputs
        return (height, 0 * height, 0 * height), lanes.Emitted(True, False, height)

    def step(inputs, carry):
        _, gravity = inputs
        x, v, t = carry
        x1, v1 = x + v * h - 0.5 * gravity * h * h, v - gravity * h
        hits = x1 <= 0
        left = (v + jnp.sqrt(v * v + 2 * gravity * jnp.maximum(x, 0.0))) / gravity
        carry = (
            jnp.where(hits, 0.0, x1), jnp.where(hits, v - gravity * left, v1),
            t + jnp.where(hits, left, h),
        )  # fmt: skip
        return carry, lanes.Emitted(~hits, hits, carry[1])

    def end(inputs, carry):
        return carry[2], carry[1]

    return lanes.run(begin, step, end, (height, gravity), rows=1, backend=backend)


def batch(size):
    draw = np.random.default_rng(size).uniform
    return draw(0.1, 0.9, size), draw(2.5, 3.99, size), np.floor(draw(0, 16, size))


MANY = jax.jit(jax.vmap(logistic))


def failing(*_):
    """Raise an error, in place of a function of LLVM."""
    raise RuntimeError("no such instruction")
