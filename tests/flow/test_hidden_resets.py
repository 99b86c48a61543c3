"""Resets whose guard rises above zero and falls again within what would be one step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

BOUNCES = 6


def height(ramp, x):
    return 1 - x + ramp[0] * np.cos(ramp[1] * x)


def bounced(machine, s, z):
    normal = 1 + machine.wave * machine.number * jnp.sin(machine.number * z[0])
    change = 1.8 * (normal * z[2] + z[3]) / (normal**2 + 1)
    return z[0], z[1], z[2] - normal * change, z[3] - change


def inside(machine, s, z):
    return 1 - z[0] + machine.wave * jnp.cos(machine.number * z[0]) - z[1]


class Ramp(vi.AbstractMachine):
    """A ball on a ramp with waves; nothing in its field tells how long they are."""

    wave: float
    number: float
    events: tuple = (vi.Reset(inside, bounced),)
    coordinates: tuple = (
        vi.Coordinate(lambda z: z[1], lambda z: z[3], lambda z, Y, V: (z[0], Y, z[2], V)),
    )
    cycle: float = 1.0

    def field(self, s, z):
        return z[2], z[3], 0 * z[2], -9.8 + 0 * z[3]


def bounces(ramp, start):
    """Times of the first bounces, from parabola to parabola; and how close the ball came to the
    ramp without touching it, or how slowly it did."""
    z, t, times, close = np.array([*start, 0.0, 0.0]), 0.0, [], np.inf
    while len(times) < BOUNCES and t < 3:
        at = lambda d, z=z: (z[0] + z[2] * d, z[1] + z[3] * d - 4.9 * d * d)
        depth = lambda d, at=at: height(ramp, at(d)[0]) - at(d)[1]
        grid = np.linspace(0, 3, 60_001)
        values = depth(grid)
        values[0] = -1.0 if times else values[0]
        inside = np.flatnonzero(values[1:] > 0)
        if times:  # the first moments after a bounce are within rounding of the ramp
            inside = inside[inside > 1]
        if not inside.size:
            break
        low, high = grid[inside[0]], grid[inside[0] + 1]
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if depth(middle) <= 0 else (low, middle)
        before = values[2 : inside[0]]
        tops = before[1:-1][(before[1:-1] > before[:-2]) & (before[1:-1] > before[2:])]
        close = min(close, -tops.max()) if tops.size else close
        x, y = at(high)
        vx, vy = z[2], z[3] - 9.8 * high
        normal = 1 + ramp[0] * ramp[1] * np.sin(ramp[1] * x)
        close = min(close, abs(normal * vx + vy))
        change = 1.8 * (normal * vx + vy) / (normal**2 + 1)
        z, t = np.array([x, y, vx - normal * change, vy - change]), t + high
        times.append(t)
    return np.array(times), close


def draw(count, seed=7):
    random = np.random.default_rng(seed)
    waves = random.uniform(0.01, 0.08, count)
    ramps = np.stack([waves, random.uniform(10, 50, count)], axis=1)
    places = random.uniform(0, 0.6, count)
    heights = height(ramps.T, places) + random.uniform(0.05, 0.5, count)
    return ramps, np.stack([places, heights], axis=1)


def compared(count, seed=7):
    """Of motions that neither graze nor creep, how many there are, and which have other bounces."""
    ramps, starts = draw(count, seed)

    @jax.jit
    @jax.vmap
    def log(ramp, start):
        z = (start[0], start[1], 0 * start[0], 0 * start[0])
        run = vi.simulate(Ramp(*ramp), z, 1, event_log=BOUNCES + 2, method=vi.Adaptive(rtol=1e-12))
        return run.event_log.phase[0], run.event_log.kind[0], run.successful

    phases, kinds, good = map(np.asarray, log(jnp.asarray(ramps), jnp.asarray(starts)))
    wrong, fair = [], 0
    for n in range(count):
        truth, close = bounces(ramps[n], starts[n])
        truth = truth[truth < 0.99]
        if close < 1e-3 or not good[n]:
            continue
        fair += 1
        found = phases[n][kinds[n] == vi.EVENTS.index("reset")][: len(truth)]
        if len(found) < len(truth) or np.abs(found - truth).max(initial=0) > 1e-5:
            wrong.append((n, truth, found))
    return fair, wrong


@pytest.mark.slow
def test_bounces_on_a_ramp_whose_waves_are_shorter_than_steps():
    """Of 130 motions none goes through a crest, where a tenth of a second is a step."""
    fair, wrong = compared(140)
    assert fair > 120
    assert not wrong, wrong[0]
