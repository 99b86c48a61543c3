"""Headline numbers of the benchmarks that do not depend on timing."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from tools.chains import linear_chain
from tools.networks import last_places, oscillator

from .closed_forms import XI, Expected


def fixed_steps_error(cycles: int) -> float:
    """Return the median error of Verner9, 10 steps, in 64 lanes of Table 1's machine (k = 0.8)."""

    def lane(method, zeta):
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=0.8, gap=2.0, damping_ratio=XI)
        run = vi.simulate(scene, scene.start(), cycles, method=method, record="sections")
        return jnp.stack([run.last.Y, run.last.V])

    exact, fixed = (
        vi.jit(jax.vmap(partial(lane, method)))(jnp.linspace(0.5, 1.9, 64))
        for method in (vi.ExactFlight(), vi.FixedStep())
    )
    return float(np.median(np.abs(exact - fixed).max(axis=1)))


# The studies have more lanes, so that the medians agree only within a third.


def speed_accuracy() -> Expected:
    error = fixed_steps_error(20)
    name = "FixedStep Verner9, 10 steps: median error of the state, 20 cycles, ideal drive"
    return {name: (error, error / 3)}


def peers() -> Expected:
    error = fixed_steps_error(200)
    name = "vi_jax FixedStep(Verner9, 10), ideal drive, k = 0.8: median error"
    return {name: (error, error / 3)}


def chains() -> Expected:
    """Compare the median only, since rounding grows in lanes with many impacts."""

    def lane(frequency):
        machine = linear_chain(frequency, 10)
        return vi.simulate(machine, machine.start(), 20, record="sections").last.displacement[-1]

    places = vi.jit(jax.vmap(lane))(jnp.linspace(0.2, 0.9, 256))
    middle = float(np.median(np.abs(places)))
    return {"linear, N = 10: median |x| of the last mass at the end": (middle, 0.01 * middle)}


def gradients() -> Expected:
    """Return the gradient's length as the forward derivative along its direction."""
    method = vi.FixedStep(diffrax.Dopri8(), 24)
    starts = jnp.linspace(-0.3, 0.3, 32)
    value, numbers = last_places(oscillator(43, "law"), starts, 50, method)
    slope = jax.grad(value)(numbers)
    along = slope / jnp.linalg.norm(slope)
    length = float(jax.jvp(value, [numbers], [along])[1])
    return {"law of 2,022 weights: length of the gradient": (length, 1e-6 * length)}
