"""vi_jax: one compiled program for all lanes."""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

from .task import Run, Task

jax.config.update("jax_enable_x64", True)


def method(name: str, number: float) -> vi.AbstractMethod:
    """Return the method by its name in the tables."""
    if name == "ExactFlight":
        return vi.ExactFlight()
    if name == "FixedStep":
        return vi.FixedStep(steps_per_cycle=int(number))
    if name == "Taylor" and number > 1:
        return vi.Taylor(int(number), 8)
    if name == "Taylor":
        order = 12 if number >= 1e-9 else 16 if number >= 1e-12 else 20
        return vi.Taylor(order, 5, rtol=number)
    return vi.Adaptive(rtol=number)


def final(task: Task, how: vi.AbstractMethod, theta: jax.Array, Y0: jax.Array) -> jax.Array:
    """Return the final (Y, V) of one lane; `theta` holds κ, ξ, τ0, ε, d, k."""
    kappa, xi, tau0, eps, gap, k = theta
    drive = vi.Motor(tau0, kappa, eps, task.mu) if task.motor else vi.IdealDrive(kappa)
    stops = (vi.RigidStop(gap, k),)
    scene = vi.Scene(damping_ratio=xi, drive=drive, stops=stops)
    start = scene.start(Y=Y0, W=kappa) if task.motor else scene.start(Y=Y0)
    # With d = 2 no force holds the body on the stop, but a traced gap does not show this.
    run = vi.simulate(scene, start, task.cycles, method=how, record="sections", rests=False)
    return jnp.stack([run.sections.Y[-1], run.sections.V[-1]])


def build(
    task: Task, kappas: np.ndarray, *, name: str, number: float = 0.0, jacobian: bool = False
) -> tuple[Run, float]:
    """Build the lanes in one process.

    The numbers are arguments of the program: a new restitution needs no compilation.
    """
    key = (task.drive, task.cycles, kappas.size, name, number, jacobian)
    numbers = jnp.array([task.xi, task.tau0, task.eps, task.gap, task.k, task.Y0])
    if key not in _compiled:
        _compiled[key] = _compile(task, kappas.size, method(name, number), jacobian)
    compiled, seconds = _compiled[key]
    lanes = jnp.asarray(kappas)
    return lambda: np.asarray(jax.block_until_ready(compiled(lanes, numbers))), seconds


_compiled: dict[tuple, tuple[Any, float]] = {}


def _compile(task: Task, size: int, how: vi.AbstractMethod, jacobian: bool):
    def lane(kappa, numbers):
        return final(task, how, jnp.concatenate([kappa[None], numbers[:-1]]), numbers[-1])

    def six(kappas, numbers):
        theta = jnp.broadcast_to(numbers[:-1, None], (5, kappas.size))
        theta = jnp.concatenate([kappas[None], theta])
        many = jax.vmap(lambda x: final(task, how, x, numbers[-1]), in_axes=1)

        def along(direction):
            tangent = jnp.broadcast_to(direction[:, None], theta.shape)
            return jax.jvp(many, (theta,), (tangent,))[1]

        return jax.vmap(along, out_axes=-1)(jnp.eye(6))

    def mapped(kappas, numbers):
        if jacobian:
            return six(kappas, numbers)
        return jax.vmap(lambda x: lane(x, numbers))(kappas)

    begin = time.perf_counter()
    compiled = jax.jit(mapped).lower(jnp.zeros(size), jnp.zeros(6)).compile()
    return compiled, time.perf_counter() - begin
