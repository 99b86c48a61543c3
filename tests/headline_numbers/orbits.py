"""Of the studies of single motions: orbits, basins, transients and designs."""

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

from .closed_forms import XI, Expected, closed


def basins_map() -> Expected:
    first, second = "ζ = 3.2, k = 0.9, d = 1.05, ξ = 0.002", "ζ = 1.1, k = 0.85, d = 2, ξ = 0.005"
    third = "ζ = 1.4, k = 0.8, d = 2, Table 1's ξ = 0.0448"

    def stable(zeta, k, xi, gap, cycles):
        return float(
            np.nanmin(np.abs(closed(zeta, k, xi, gap, cycles=cycles).multipliers).max(axis=1))
        )

    numbers = {
        f"{first}: multiplier of the 4π motion, 1 impacts": stable(3.2, 0.9, 0.002, 1.05, 2),
        f"{first}: multiplier of the 2π motion, 0 impacts": np.exp(-2 * np.pi * 0.002 / 3.2),
        f"{first}: multiplier of the 6π motion, 1 impacts": stable(3.2, 0.9, 0.002, 1.05, 3),
        f"{second}: multiplier of the 2π motion, 1 impacts": stable(1.1, 0.85, 0.005, 2.0, 1),
        f"{third}: multiplier of the 2π motion, 1 impacts": stable(1.4, 0.8, XI, 2.0, 1),
        f"{third}: multiplier of the 2π motion, 0 impacts": np.exp(-2 * np.pi * XI / 1.4),
    }
    # From Lyapunov exponents over 600 cycles, which the first cycles' turning leaves inexact.
    return _all_orbits() | {name: (float(value), 2e-3) for name, value in numbers.items()}


def _all_orbits() -> Expected:
    zeta, k, gap, xi = 3.2, 0.9, 1.05, 0.002
    numbers = {"largest multiplier of A": float(np.exp(-2 * np.pi * xi / zeta))}
    for names, cycles in (("BC", 2), ("DE", 3)):
        found = closed(zeta, k, xi, gap, cycles=cycles)
        sizes = np.sort(np.abs(np.asarray(found.multipliers)).max(axis=1))
        numbers |= {
            f"largest multiplier of {name}": float(size)
            for name, size in zip(names, sizes, strict=True)
        }
    return {name: (value, 1e-7) for name, value in numbers.items()}


def design_percussion(kept: dict[str, float]) -> Expected:
    table = vi.Parameters(restitution=0.5)
    numbers: Expected = {}
    for name in ("start", "A", "B", "C"):
        zeta, gap, c = (kept[f"{name}: {x}"] for x in ("ζ", "Δ, mm", "c, N·s/m"))
        xi = c * XI / float(table.damping)
        found = closed(zeta, 0.5, xi, gap / 40.0, cycles=1)
        speed = float(table.metres_per_second(found.impact_speed[0]))
        energy = 0.5 * float(table.body_mass) * 0.75 * speed**2
        power = energy * zeta * float(table.natural_frequency) / (2 * np.pi)
        modulus = float(np.abs(found.multipliers[0]).max())
        numbers[f"{name}: power, W"] = (power, 1e-7)
        numbers[f"{name}: largest modulus"] = (modulus, 1e-6)
    return numbers


def escape_from_2pi() -> Expected:
    found = closed(0.9, 0.5, 0.0, 2.0, cycles=1)
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0)
    start = scene.start(Y=float(found.Y[0]) - 1e-7, V=float(found.V[0]))
    run = vi.simulate(scene, start, 120, method=vi.ExactFlight(), record="sections")
    apart = np.abs(np.stack([run.sections.Y - found.Y[0], run.sections.V - found.V[0]])).max(axis=0)
    left = int(np.flatnonzero(apart > 0.05)[0])
    return {
        "multiplier of the 2π motion": (float(np.real(found.multipliers[0]).min()), 1e-9),
        "cycles near the 2π motion, displaced by 1e-7": (left, 0),
    }


def grazing_forecast(kept: dict[str, float]) -> Expected:
    """Where the vibration without impacts just reaches the stop of the paper's machine."""
    names = [name.removesuffix(": d") for name in kept if name.endswith(": d")]
    numbers: Expected = {}
    for name in names:
        zeta, xi = kept[f"{name}: ζ"], kept[f"{name}: ξ"]
        numbers[f"{name}: d"] = (float(1 / abs(1 - zeta**2 + 2j * xi * zeta)), 1e-9)
    return numbers


def robustness() -> Expected:
    """The kick again; the blow by simulations of ever closer ones, of either sign."""
    scene = vi.Scene.ideal(frequency_ratio=0.968, restitution=0.8, gap=2.0, damping_ratio=XI)
    form = closed(0.968, 0.8, XI, 2.0, cycles=2)
    best = int(np.argmin(np.where(form.admissible, np.abs(form.multipliers).max(axis=1), np.inf)))
    orbit = vi.find_orbit(scene, scene.start(Y=form.Y[best], V=form.V[best]), 2, throw=True)
    options = {"settle": 1500, "candidates": 1, "directions": 32, "progress": False}
    kick = vi.minimal_kick(scene, orbit, **options)

    def impacts(blow):
        start = scene.start(Y=orbit.state.Y, V=orbit.state.V + blow)
        return jnp.sum(vi.simulate(scene, start, 2, settle=600).impacts)

    lanes, ends = vi.jit(jax.vmap(impacts)), []
    for side in (1, -1):
        low, high = 0.0, 0.2
        for _ in range(4):
            parts = np.linspace(low, high, 100)
            lost = np.asarray(lanes(side * parts)) != 1
            first = int(np.argmax(lost)) if lost.any() else len(lost) - 1
            low, high = parts[first - 1], parts[first]
        ends.append(high)
    return {
        "ζ = 0.968, 4π to 2π": (float(kick.norm), 1e-8),
        "ζ = 0.968, blow on the section": (min(ends), 1e-8),
    }
