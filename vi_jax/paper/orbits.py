"""The periodic motions behind the figures, found by gradient and by Newton's method."""

from typing import NamedTuple

import optax

from ..orbit import Gradient, Orbit, closed_form_orbits, find_orbit
from ..scene import Parameters, Scene

# How wrong the fit's guess is, and how well it must do: no transient is to be seen afterwards.
_WRONG, _FITTED = 0.05, 1e-10


class TableRow(NamedTuple):
    """One motion of the orbit table."""

    scene: str
    orbit: Orbit


def fit_long(scene: Scene) -> Orbit:
    """The 4π motion, fitted by optax' Adam from a state 5 % off the closed form.

    This is what the paper asks for with Figure 4: initial conditions accurate enough to skip the
    transient.
    """
    closed = closed_form_orbits(scene, cycles=2)
    guess = scene.start(Y=(1 + _WRONG) * closed.Y[0], V=(1 - _WRONG) * closed.V[0])
    steps = 2000
    descent = Gradient(
        optax.adam(optax.cosine_decay_schedule(0.02, steps)), tolerance=_FITTED, max_steps=steps
    )
    return find_orbit(scene, guess, cycles=2, method=descent, throw=True)


def orbit_table(*, quick: bool = False) -> list[TableRow]:
    """The 2π and 4π motions at ζ = 0.9 (κ = 0.9 for the motor), d = 2; `quick` leaves out motors.

    Found by Newton's method from closed forms, stable and unstable ones alike.
    """
    table = Parameters(gap=0.08)
    ratio = table.scene(drive="ideal").damping_ratio
    rows = []
    for k, damping, name in (
        (0.5, 0.0, "k = 0.5, undamped"),
        (0.5, ratio, "k = 0.5, Table 1's damping"),
        (0.8, ratio, "k = 0.8, Table 1's damping"),
    ):
        scene = Scene.ideal(frequency_ratio=0.9, restitution=k, damping_ratio=damping)
        for cycles in (1, 2):
            closed = closed_form_orbits(scene, cycles=cycles)
            if not bool(closed.admissible[0]):
                continue
            guess = scene.start(Y=closed.Y[0], V=closed.V[0])
            rows.append(TableRow(f"ideal, {name}", find_orbit(scene, guess, cycles=cycles)))
            if quick or k != 0.8:
                continue
            for torque in (2.0, 10.0, 100.0):
                motor = Parameters(torque=torque, kappa=0.9, restitution=k, gap=0.08).scene()
                start = motor.start(Y=closed.Y[0], V=closed.V[0])
                orbit = find_orbit(motor, start, cycles=cycles)
                rows.append(TableRow(f"motor T0 = {torque:g} N·m, {name}", orbit))
    return rows
