"""A driven body with dry friction: its branches, and its motions by SciPy from event to event."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import vi_jax as vi

from event_by_event import followed

SINCE = 0.3  # phase of the drive on the section


class Rough(vi.AbstractMachine):
    """x'' = cos φ + second cos(2φ + 1) - x - damping x' - friction, φ = s + 0.3, s = omega t."""

    omega: Any = 0.75
    level: Any = 0.3
    second: Any = 0.0
    damping: Any = 0.0
    cycle = 2 * np.pi

    def pull(self, s, x):
        drive = jnp.cos(s + SINCE) + self.second * jnp.cos(2 * (s + SINCE) + 1)
        return drive - x.Y - self.damping * x.V

    @property
    def contacts(self):
        return vi.DryFriction(self.level, on="V", mass=self.omega, name="floor")

    def field(self, s, x):
        return vi.OscillatorState(x.V / self.omega, self.pull(s, x) / self.omega)

    def step_limit(self, s, x):
        return 0.4 * np.pi * jnp.minimum(1.0, self.omega)


def branch_of(parameter, bounds, *, max_step=0.1, **numbers):
    machine = Rough(**numbers)
    start = vi.OscillatorState(jnp.asarray(0.1), jnp.asarray(0.0))
    orbit = vi.find_orbit(machine, vi.simulate(machine, start, 1, settle=200).last)
    return vi.continue_orbit(
        orbit, parameter=parameter, bounds=bounds, max_step=max_step, progress=False
    )


def on_both_sides(point, parameter, bounds, distance=0.01):
    """Return the special point nearest to `point` on the branch of the other side's motion."""
    other = point.switch(distance=distance)
    branch = vi.continue_orbit(other, parameter=parameter, bounds=bounds, step=1e-3)
    return min(branch.special, key=lambda x: abs(x.parameter - point.parameter))


def settled(omega, level, second, damping, cycles=10):
    """Return phase, position, mode before and after each event of the last cycle, by SciPy."""
    mode, events, end = 0, [], 2 * np.pi * cycles

    def drive(s):
        return np.cos(s + SINCE) + second * np.cos(2 * (s + SINCE) + 1)

    def field(s, x):
        force = drive(s) - x[0] - damping * x[1]
        held = 0.0 if mode == 0 else 1.0
        return [x[1] / omega, held * (force - mode * level) / omega]

    def changes(s, x):
        return abs(drive(s) - x[0]) - level if mode == 0 else -mode * x[1]

    def changed(s, x):
        nonlocal mode
        force, before = drive(s) - x[0], mode
        mode = 0 if before and abs(force) <= level else (1 if force > 0 else -1)
        events.append((s + SINCE, x[0], before, mode))
        return x[0], 0.0

    followed(field, (0.1, 0.0), end, [(changes, changed)], rtol=1e-12, atol=1e-13, max_step=0.3)
    return [e for e in events if e[0] > end + SINCE - 2 * np.pi]
