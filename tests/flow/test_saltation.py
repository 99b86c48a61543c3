"""Derivatives through impacts, compared with differences."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

ZETA, XI, K, GAP = 0.9, 0.05, 0.5, 2.0


def final(method, cycles):
    def f(x):
        zeta, xi, k, d, Y, V = x
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=d, damping_ratio=xi)
        run = vi.simulate(scene, scene.start(Y=Y, V=V), cycles, method=method)
        return jnp.stack([run.sections.Y[-1], run.sections.V[-1]])

    return f


@pytest.mark.slow
def test_higher_derivatives_pass_through_impacts():
    """Along a line in parameters and start, compare with differences of the next lower order."""
    at, along = jnp.array([ZETA, XI, K, GAP, 0.1, 0.2]), jnp.array([0.3, 0.2, -0.4, 0.1, 0.5, -0.2])
    functions = [lambda t: final(vi.ExactFlight(), 3)(at + t * along)]
    for _ in range(3):
        functions.append(jax.jit(jax.jacfwd(functions[-1])))
    h = 1e-3
    for lower, higher in pairwise(functions):
        near, far = ((lower(x) - lower(-x)) / (2 * x) for x in (h, 2 * h))
        # The error of the fourth-order difference is h⁴/30 times the derivative of order + 4.
        np.testing.assert_allclose(higher(0.0), (4 * near - far) / 3, rtol=1e-6)


RECORDED = [
    ("ideal", "phase", vi.ExactFlight()),
    ("motor", "time", vi.FixedStep(steps_per_cycle=40)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "clock", "method"), RECORDED)
def test_derivatives_of_all_that_is_recorded(kind, clock, method):
    """Compare derivatives of states, extremes, times, impact phases and speeds with differences."""

    def recorded(x):
        xi, k, gap, speed, V, section = x
        drive = vi.Motor(0.6, speed, 0.1, 0.05) if kind == "motor" else vi.IdealDrive(speed)
        stops = (vi.RigidStop(gap, k), vi.RigidStop(1.3 + gap, 0.5 * k, side="left"))
        scene = vi.Scene(
            damping_ratio=xi, drive=drive, stops=stops, clock_name=clock,
            section_phase=section,
        )  # fmt: skip
        start = scene.start(V=V, W=speed) if kind == "motor" else scene.start(V=V)
        run = vi.simulate(scene, start, 3, method=method, impact_log=6, samples=3)
        log = jax.tree.map(jnp.nan_to_num, (run.impact_log.phase, run.impact_log.speed))
        every = (run.sections, run.samples.state, run.samples.time, run.y_max, run.y_min)
        return (*every, run.impact_speed, *log), run.impacts

    rng = np.random.default_rng(0)
    low, high = np.array([[0.01, 0.3, 0.2, 0.6, -1, -1], [0.1, 0.9, 0.9, 1.2, 1, 1]])
    derivatives = jax.jit(jax.jacfwd(lambda x: recorded(x)[0]))
    values, h = jax.jit(recorded), 1e-6
    for _ in range(4):
        x = jnp.asarray(rng.uniform(low, high))
        found = derivatives(x)
        for i, e in enumerate(h * jnp.eye(6)):
            (above, more), (below, fewer) = values(x + e), values(x - e)
            assert (more == fewer).all() and more.sum() > 0
            for slope, a, b in zip(*map(jax.tree.leaves, (found, above, below)), strict=True):
                wanted = (a - b) / (2 * h)
                scale = 1 + float(jnp.abs(wanted).max())
                np.testing.assert_allclose(slope[..., i], wanted, atol=2e-6 * scale)
