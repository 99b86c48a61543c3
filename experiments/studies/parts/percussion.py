"""The machine of `design_percussion.py`: power, stability, and the ascent to a better design."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import vi_jax as vi
from tools.study import QUICK

STEPS = 60 if QUICK else 300
MACHINE = vi.Parameters(restitution=0.5)  # Table 1 of the paper in SI units
NAMES = ("ζ", "Δ", "c")
LOW, HIGH = np.array([0.5, 0.0, 0.2]), np.array([1.9, 0.12, 1.0])  # -, m, N·s/m
START = np.array([0.9, 0.08, 0.5])  # the paper's machine
# Largest |multiplier| allowed, and largest gap as a part of the amplitude of the free motion.
DESIGNS = {"A": (0.8, np.inf), "B": (0.5, np.inf), "C": (0.8, 0.95)}


def parameters(design: Any) -> vi.Parameters:
    numbers = LOW + (HIGH - LOW) * design
    return eqx.tree_at(lambda p: (p.control, p.gap, p.damping), MACHINE, tuple(numbers))


def impact_power(machine: vi.Parameters, orbit: vi.Orbit) -> Any:
    """Energy lost in the impacts of one period over its duration, W."""
    speed = jnp.where(orbit.impact_stop >= 0, orbit.impact_speed, 0.0)
    square = jnp.sum(machine.metres_per_second(speed) ** 2)
    energy = 0.5 * machine.body_mass * (1 - machine.restitution**2) * square
    return energy / machine.seconds(orbit.duration)


class Force(NamedTuple):
    """The state of the augmented Lagrangian: numbers only, so that nothing recompiles."""

    limit: Any
    """Largest modulus allowed."""
    reach: Any
    """Largest gap allowed, as a part of the amplitude of the free motion."""
    price: Any
    """Multiplier of each of the three conditions, W."""
    weight: Any
    """Weight of the quadratic penalty, W."""


def lagrangian(design: Any, guess: Any, force: Force) -> tuple[Any, tuple]:
    machine = parameters(design)
    scene = machine.scene(drive="ideal")
    orbit = vi.find_orbit(scene, guess, cycles=1)
    power = impact_power(machine, orbit)
    trace = jnp.trace(orbit.monodromy) / force.limit
    det = jnp.linalg.det(orbit.monodromy) / force.limit**2
    free = jnp.hypot(1 - machine.control**2, 2 * scene.damping_ratio * machine.control)
    gap = scene.stops[0].gap * free / force.reach
    excess = jnp.stack([trace - det, -trace - det, gap]) - 1  # to be ≤ 0
    pushed = jnp.maximum(0.0, force.price + force.weight * excess)
    penalty = jnp.sum(pushed**2 - force.price**2) / (2 * force.weight)
    allowed = (orbit.result == vi.ORBIT_RESULTS.successful) & orbit.admissible
    modulus = jnp.max(jnp.abs(orbit.multipliers))
    return penalty - power, Outcome(power, modulus, excess, allowed, orbit)


class Outcome(NamedTuple):
    power: Any
    modulus: Any
    excess: Any
    allowed: Any
    """An orbit was found, and nowhere is its clearance negative."""
    orbit: vi.Orbit


evaluate = jax.jit(jax.value_and_grad(lagrangian, has_aux=True))

FIRST = jnp.asarray((START - LOW) / (HIGH - LOW))
"""The design at which the ascent begins: the paper's machine."""


def no_force(limit: float = 0.8, reach: float = np.inf) -> Force:
    """The force of the beginning, without prices."""
    return Force(*(jnp.array(x, float) for x in (limit, reach, np.zeros(3), 5.0)))


OPTIMISER = optax.adam(optax.cosine_decay_schedule(0.02, STEPS))
propose = jax.jit(OPTIMISER.update)


class Ascent(NamedTuple):
    design: Any
    end: Outcome
    power: list[float]
    modulus: list[float]
    rejected: int


def climb(origin: Any, limit: float, reach: float) -> Ascent:
    """Adam on the augmented Lagrangian, from `FIRST` with its motion at `origin`.

    A step to a design without an admissible orbit of one cycle (beyond a fold, or where the body
    would pass through the stop) is halved until there is one. Every 20 steps the prices of the
    conditions are brought up to date.
    """
    force = no_force(limit, reach)
    design, memory = FIRST, OPTIMISER.init(FIRST)
    (_, now), gradient = evaluate(design, origin, force)
    powers, moduli, rejected = [float(now.power)], [float(now.modulus)], 0
    for step in range(STEPS):
        if step % 20 == 19:
            price = jnp.maximum(0.0, force.price + force.weight * now.excess)
            force = force._replace(price=price)
        update, memory = propose(gradient, memory, design)
        for _ in range(12):
            trial = jnp.clip(design + update, 0.0, 1.0)
            (_, there), slope = evaluate(trial, now.orbit.state, force)
            if there.allowed and np.isfinite(slope).all():
                design, now, gradient = trial, there, slope
                break
            update, rejected = 0.5 * update, rejected + 1
        else:
            raise RuntimeError("No admissible orbit beside the last one.")
        powers.append(float(now.power))
        moduli.append(float(now.modulus))
    return Ascent(design, now, powers, moduli, rejected)
