"""Of the benchmarks: errors and sizes of programs, which no clock changes."""

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
    """Median error of 10 steps of Verner9, of 64 lanes of Table 1's machine, k = 0.8, d = 2."""

    def lane(method, zeta):
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=0.8, gap=2.0, damping_ratio=XI)
        run = vi.simulate(scene, scene.start(), cycles, method=method, record="sections")
        return jnp.stack([run.last.Y, run.last.V])

    exact, fixed = (
        vi.jit(jax.vmap(partial(lane, method)))(jnp.linspace(0.5, 1.9, 64))
        for method in (vi.ExactFlight(), vi.FixedStep())
    )
    return float(np.median(np.abs(exact - fixed).max(axis=1)))


# The lanes of the test are fewer than a study's, so that the median is the same within a third.


def speed_accuracy() -> Expected:
    error = fixed_steps_error(20)
    name = "FixedStep Verner9, 10 steps: median error of the state, 20 cycles, ideal drive"
    return {name: (error, error / 3)}


def peers() -> Expected:
    error = fixed_steps_error(200)
    name = "vi_jax FixedStep(Verner9, 10), ideal drive, k = 0.8: median error"
    return {name: (error, error / 3)}


def chains() -> Expected:
    """Where the last of ten masses is; lanes that impact often differ by what rounding became."""

    def lane(frequency):
        machine = linear_chain(frequency, 10)
        return vi.simulate(machine, machine.start(), 20, record="sections").last.displacement[-1]

    places = vi.jit(jax.vmap(lane))(jnp.linspace(0.2, 0.9, 256))
    middle = float(np.median(np.abs(places)))
    return {"linear, N = 10: median |x| of the last mass at the end": (middle, 0.01 * middle)}


def gradients() -> Expected:
    """By columns: the derivative along the gradient's own direction is its length."""
    method = vi.FixedStep(diffrax.Dopri8(), 24)
    starts = jnp.linspace(-0.3, 0.3, 32)
    value, numbers = last_places(oscillator(43, "law"), starts, 50, method)
    slope = jax.grad(value)(numbers)
    along = slope / jnp.linalg.norm(slope)
    length = float(jax.jvp(value, [numbers], [along])[1])
    return {"law of 2,022 weights: length of the gradient": (length, 1e-6 * length)}
