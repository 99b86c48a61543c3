"""Checks of `design_percussion.py` that use neither the search nor the gradient."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from tools.study import QUICK

from .percussion import HIGH, LOW, MACHINE, Force, Outcome, no_force, parameters

STARTS = 32 if QUICK else 512
GAPS = np.linspace(LOW[1], HIGH[1], 5 if QUICK else 61)
ZETAS = jnp.linspace(LOW[0], HIGH[0], 281)
_SPREAD = jax.random.uniform(jax.random.key(0), (2, STARTS))


def loss(machine: vi.Parameters, speed: Any) -> Any:
    return 0.5 * machine.body_mass * (1 - machine.restitution**2) * speed**2


@jax.jit
def simulated(design: Any, Y: Any, V: Any) -> tuple[Any, Any, Any]:
    """State after 500 cycles, the power over the last 100 of them, and whether it got there."""
    machine = parameters(design)
    scene = machine.scene(drive="ideal")
    start = scene.start(Y=Y * (scene.stops[0].gap + 4.0) - 4.0, V=8.0 * V - 4.0)
    run = vi.simulate(scene, start, 500, method=vi.ExactFlight(), impact_log=4)
    assert run.impact_log is not None and run.duration is not None
    speed = machine.metres_per_second(jnp.nan_to_num(run.impact_log.speed[-100:]))
    last = jnp.stack([run.sections.Y[-1], run.sections.V[-1]])
    power = jnp.sum(loss(machine, speed)) / machine.seconds(jnp.sum(run.duration[-100:]))
    return last, power, run.successful


@jax.jit
def grid_power(force: Force, gap: Any, zetas: Any) -> Any:
    """Power of the best motion allowed at each frequency, at the least damping allowed."""

    def one(zeta):
        machine = eqx.tree_at(
            lambda p: (p.control, p.gap, p.damping), MACHINE, (zeta, gap, jnp.asarray(LOW[2]))
        )
        scene = machine.scene(drive="ideal")
        orbits = vi.closed_form_orbits(scene)
        power = loss(machine, machine.metres_per_second(orbits.impact_speed))
        power *= machine.radians_per_second(zeta) / (2 * jnp.pi)
        free = jnp.hypot(1 - zeta**2, 2 * scene.damping_ratio * zeta)
        good = orbits.admissible & (jnp.max(jnp.abs(orbits.multipliers), -1) <= force.limit)
        good = good & (scene.stops[0].gap * free <= force.reach)
        return jnp.max(jnp.where(good, power, -jnp.inf))

    return jax.vmap(one)(zetas)


lanes = jax.jit(jax.vmap(simulated, (None, 0, 0)))


class Starts(NamedTuple):
    """What becomes of starts of a design: from rest, and random ones."""

    from_rest: bool
    """Whether the start from rest comes to the orbit."""
    arrived: float
    """Part of the starts that do."""
    never_strike: float
    chatter: float
    """Part of the starts that end in chatter, which the simulator does not follow here."""
    power_error: float
    """Largest relative difference of the power from the promised one."""


def tried(design: Any, end: Outcome) -> Starts:
    """Simulate the random starts, the first of them replaced by rest."""
    gap = parameters(design).scene(drive="ideal").stops[0].gap
    Y, V = _SPREAD[0].at[0].set(4.0 / (4.0 + gap)), _SPREAD[1].at[0].set(0.5)  # Y = V = 0
    last, power, followed = (np.asarray(x) for x in lanes(design, Y, V))
    goal = np.array([end.orbit.state.Y, end.orbit.state.V])
    arrived = followed & (np.max(np.abs(last - goal), axis=1) < 1e-6)
    error = np.max(np.abs(power[arrived] / float(end.power) - 1), initial=0.0)
    return Starts(
        bool(arrived[0]), float(arrived.mean()), float(np.mean(followed & (power == 0))),
        float(np.mean(~followed)), float(error),
    )  # fmt: skip


def best_of_grid(limit: float, reach: float) -> float:
    """Power of the best motion of the closed form on the grid of gaps and frequencies."""
    force = no_force(limit, reach)
    return max(float(jnp.max(grid_power(force, jnp.asarray(gap), ZETAS))) for gap in GAPS)


def fold_of(design: Any) -> float:
    """Where the motion ends if the drive turns faster: the closed form finds it no more."""
    machine = parameters(design)
    faster = jnp.linspace(float(machine.control), LOW[0] + 1.0, ZETAS.size)
    power = grid_power(no_force(np.inf), jnp.asarray(machine.gap), faster)
    return float(jnp.max(jnp.where(jnp.isfinite(power), faster, 0.0)))
