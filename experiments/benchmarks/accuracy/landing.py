"""The landing on a stop, taken apart.

What the hybrid step does at an impact, beside what is simpler: the same steps on the 4π
motion (ζ = 0.9, k = 0.5, undamped), 4 cycles, with

- no landing: a step that ends beyond the stop is taken and its velocity reversed there;
- the interpolant: the state on the stop is read off a cubic Hermite polynomial of the step;
- a landing: a step that ends on the stop, aimed by the interpolant and then by Newton's method
  until it is within 1e-3, 1e-6 or 1e-9 of it, where the jump is applied;
- a landing with its correction: the same, with the second-order Taylor step onto the stop.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from tools.study import QUICK

ORBIT = vi.closed_form_orbits(vi.Scene.ideal(frequency_ratio=0.9), cycles=2)
SOLVER = vi.Unrolled(vi.Verner9())


def pulled(s: Any, y: Any) -> Any:
    """d(Y, V)/dφ of the undamped machine at ζ = 0.9."""
    return jnp.stack([y[1], jnp.cos(s) - y[0]]) / 0.9


def moved(s: Any, y: Any, h: Any) -> Any:
    """One step."""
    term = diffrax.ODETerm(lambda s, y, args: pulled(s, y))
    return SOLVER.step(term, s, s + h, y, None, None, made_jump=True)[0]


def crossing(s: Any, y0: Any, y1: Any, h: Any) -> tuple[Any, Any]:
    """Where the Hermite cubic of a step meets the stop (share of the step), and its state there."""
    f0, f1 = pulled(s, y0), pulled(s + h, y1)

    def at(t):
        a, b = (1 + 2 * t) * (1 - t) ** 2, t * (1 - t) ** 2
        c, d = t * t * (3 - 2 * t), t * t * (t - 1)
        return a * y0 + b * h * f0 + c * y1 + d * h * f1

    def halved(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        beyond = at(middle)[0] > 2.0
        return jnp.where(beyond, low, middle), jnp.where(beyond, middle, high)

    ends = jax.lax.fori_loop(0, 60, halved, (jnp.zeros_like(h), jnp.ones_like(h)))
    share = jax.lax.stop_gradient(0.5 * (ends[0] + ends[1]))
    g, slope = at(share)[0] - 2.0, jax.jvp(at, (share,), (jnp.ones_like(share),))[1][0]
    share = share - g / jax.lax.stop_gradient(slope)  # its derivative, by the implicit function
    return share, at(share)


def through(y: Any, how: str, steps: int, close: float = 0.0) -> Any:
    """The section state four cycles after `y`."""
    h = jnp.asarray(2 * np.pi / steps)

    def step(y, i):
        s = 2 * np.pi * (i % steps) / steps
        free = moved(s, y, h)
        hit = (free[0] > 2.0) & (free[1] > 0)
        if how == "none":
            return jnp.where(hit, jnp.stack([free[0], -0.5 * free[1]]), free), None
        share, there = crossing(s, y, free, h)
        place = share * h
        if how != "interpolant":
            place = jax.lax.stop_gradient(place)
            for _ in range(6):
                there = moved(s, y, place)
                offset = (2.0 - there[0]) / pulled(s + place, there)[0]
                further = jax.lax.stop_gradient(jnp.where(jnp.abs(offset) > close, offset, 0.0))
                place = place + further
            there = moved(s, y, place)
            if how == "corrected":
                rate = pulled(s + place, there)
                bend = jax.jvp(pulled, (s + place, there), (jnp.ones_like(h), rate))[1]
                away = 2.0 - there[0]
                offset = away / rate[0]
                offset = away / (rate[0] + 0.5 * bend[0] * offset)
                there = there + offset * rate + 0.5 * offset**2 * bend
                place = place + offset
        struck = jnp.stack([there[0], -0.5 * there[1]])
        after = moved(s + place, struck, h - place)
        return jnp.where(hit, after, free), None

    return jax.lax.scan(step, y, jnp.arange(4 * steps))[0]


def landings() -> list[tuple[str, int, float, float]]:
    """Errors of the state and of its derivative by the start, for each way and number of steps."""
    scene = vi.Scene.ideal(frequency_ratio=0.9)
    start = scene.start(Y=ORBIT.Y[0] + 0.01, V=ORBIT.V[0])
    exact = vi.cycle_map(scene, 4)
    after, slope = exact(start), np.asarray(exact.jacobian(start))
    state = np.array([float(after.Y), float(after.V)])
    y = jnp.stack([start.Y, start.V])
    ways = [("no landing", "none", 0.0), ("interpolant", "interpolant", 0.0)]
    for close in (1e-6,) if QUICK else (1e-3, 1e-6, 1e-9):
        ways.append((f"landing within {close:.0e}", "landing", close))
        ways.append((f"the same, corrected ({close:.0e})", "corrected", close))
    rows = []
    for name, how, close in ways:
        for steps in (16,) if QUICK else (16, 64, 256):
            run = jax.jit(lambda y, h=how, n=steps, c=close: through(y, h, n, c))
            error = np.abs(np.asarray(run(y)) - state).max()
            wrong = np.abs(np.asarray(jax.jacfwd(run)(y)) - slope).max() / np.abs(slope).max()
            rows.append((name, steps, float(error), float(wrong)))
    return rows
