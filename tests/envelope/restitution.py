"""Restitution, from none to all."""

import jax.numpy as jnp
import vi_jax as vi

from .case import Found, case, within
from .scenes import deviations, energy, free_machine, worst


@case(
    "k = 0",
    "after an impact the body has no speed left: matrix exponentials, held while cos φ > d",
    within(1e-10, 1e-7, 1e-8),
)
def plastic() -> Found:
    """Perfectly plastic impacts, with and without rest."""
    return worst(
        deviations(0.9, 0.0, [(1, 2.0, 0.0)], 0.0, 0.0, 20),
        deviations(0.9, 0.05, [(1, 0.3, 0.0)], 0.0, 0.0, 20),
        deviations(0.5, 0.05, [(1, -0.5, 0.0)], -1.0, 0.0, 20),
    )


@case(
    "k = 1, ξ = 0, τ0 = 0, 10⁵ impacts",
    "the energy of body, spring and shaft is kept (relative)",
    {"FixedStep(24)": 1e-8, "Adaptive(1e-13)": 1e-8},
    long=True,
)
def elastic() -> Found:
    """Energy over 10⁵ impacts."""
    scene, found = free_machine(), {}
    start = scene.start(Y=-1.0, V=0.3, W=0.9)
    methods = {
        "FixedStep(24)": vi.FixedStep(steps_per_cycle=24),
        "Adaptive(1e-13)": vi.Adaptive(rtol=1e-13),
    }
    for name, method in methods.items():
        run = vi.simulate(scene, start, 100, settle=75_000, method=method)
        before, after = energy(scene, start), energy(scene, run.last)
        rate = float(jnp.mean(run.impacts))
        if not rate * 75_000 > 1e5:
            raise RuntimeError(f"only {rate} impacts a cycle")
        found[name] = float(abs(after - before) / before)
    return found


@case("k = 0.999, ζ = 0.99, ξ = 0.001", "matrix exponentials", within(1e-9, 1e-6, 1e-7))
def nearly_elastic() -> Found:
    """Nearly elastic near resonance: nothing fades."""
    return deviations(0.99, 0.001, [(1, 2.0, 0.999)], 0.0, 0.0, 20)
