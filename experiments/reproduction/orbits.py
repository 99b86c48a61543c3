"""The periodic motions of the figures, found by gradient descent and by Newton's method."""

from typing import NamedTuple

import optax
from vi_jax.machine import Scene
from vi_jax.orbit import Gradient, Orbit, closed_form_orbits, find_orbit

# Relative error of the fit's guess, and tolerance of the fit, at which no transient is visible.
_WRONG, _FITTED = 0.05, 1e-10


class TableRow(NamedTuple):
    """One motion of the orbit table."""

    scene: str
    orbit: Orbit
    kappa: float | None = None
    """κ of a motor, tuned so that the mean ζ is 0.90."""


def mean_ratio(orbit: Orbit) -> float:
    """Return the mean ζ of a driven motion."""
    assert orbit.frequency_ratio is not None
    return float(orbit.frequency_ratio)


def fit_long(scene: Scene) -> Orbit:
    """Fit the 4π motion by optax' Adam from a state 5 % off the closed form.

    The paper's Figure 4 needs such initial conditions, which are accurate enough to skip the
    transient.
    """
    closed = closed_form_orbits(scene, cycles=2)
    guess = scene.start(Y=(1 + _WRONG) * closed.Y[0], V=(1 - _WRONG) * closed.V[0])
    steps = 2000
    descent = Gradient(
        optax.adam(optax.cosine_decay_schedule(0.02, steps)), tolerance=_FITTED, max_steps=steps
    )
    return find_orbit(scene, guess, cycles=2, root_finder=descent, throw=True)


def orbit_table(scenes: dict[str, Scene]) -> list[TableRow]:
    """Find the 2π and 4π motions of named ideal scenes, stable or not, by Newton's method from
    their closed forms."""
    rows = []
    for name, scene in scenes.items():
        for cycles in (1, 2):
            closed = closed_form_orbits(scene, cycles=cycles)
            if bool(closed.admissible[0]):
                guess = scene.start(Y=closed.Y[0], V=closed.V[0])
                rows.append(TableRow(f"ideal, {name}", find_orbit(scene, guess, cycles=cycles)))
    return rows
