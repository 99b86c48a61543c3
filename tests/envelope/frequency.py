"""Damping and frequency ratio."""

from math import cos, pi, sin

import vi_jax as vi

from .case import ALL, Found, case, within
from .independent import root
from .scenes import deviations, ideal, worst


@case("ξ = 0, 1, 10", "matrix exponentials, with a stop", within(1e-11, 1e-7, 1e-8))
def damping() -> Found:
    """Undamped, critically and strongly overdamped."""
    return worst(
        *(deviations(0.9, xi, [(1, 1.2, 0.5)], 0.0, v, 10)
          for xi, v in ((0.0, 1.0), (1.0, 10.0), (10.0, 60.0)))
    )  # fmt: skip


@case("ζ = 1, ξ = 0", "Y = ½τ sin τ from rest up to the first impact", within(1e-12, 1e-8, 1e-9))
def resonance() -> Found:
    """The secular case."""
    scene, found = ideal(1.0, 0.0, [(1, 2.0, 0.5)]), {}
    tau = root(lambda t: 0.5 * t * sin(t) - 2.0, 6.5, 7.5, xtol=1e-15)
    speed = 0.5 * (sin(tau) + tau * cos(tau))
    for name, method in ALL.items():
        run = vi.simulate(scene, scene.start(), 2, method=method, impact_log=2)
        assert run.impact_log is not None
        phase = 2 * pi + float(run.impact_log.phase[1, 0])
        found[name] = max(abs(phase - tau), abs(float(run.impact_log.speed[1, 0]) - speed))
    return found


@case("ζ = 10⁻³ and 10⁻²", "matrix exponentials, one cycle", within(1e-9, 1e-6, 1e-8))
def slow_drive() -> Found:
    """A thousand free periods in a drive cycle."""
    return worst(*(deviations(z, 0.01, [(1, 2.0, 0.8)], 0.0, 4.0, 1) for z in (1e-3, 1e-2)))


@case("ζ = 10² and 10³", "matrix exponentials, a few free periods", within(1e-9, 1e-8, 1e-8))
def fast_drive() -> Found:
    """A thousand drive cycles in a free period."""
    return worst(
        deviations(1e2, 0.01, [(1, 0.5, 0.8)], 0.0, 2.0, 300),
        deviations(1e3, 0.01, [(1, 0.5, 0.8)], 0.0, 2.0, 2000),
    )
