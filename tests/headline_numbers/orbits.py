"""Headline numbers of the studies of orbits, basins, designs and records."""

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

from .closed_forms import XI, Expected, closed


def basins_map() -> Expected:
    zeta, k, gap, xi = 3.2, 0.9, 1.05, 0.002
    free = float(np.exp(-2 * np.pi * xi / zeta))
    # The study uses Lyapunov exponents over 600 cycles, inexact because of the first cycles.
    watched: Expected = {"multiplier of the 2π motion, 0 impacts": (free, 2e-3)}
    numbers = {"largest multiplier of A": free}
    for names, cycles in (("BC", 2), ("DE", 3)):
        found = closed(zeta, k, xi, gap, cycles=cycles)
        sizes = np.sort(np.abs(np.asarray(found.multipliers)).max(axis=1))
        watched[f"multiplier of the {2 * cycles}π motion, 1 impacts"] = float(sizes[0]), 2e-3
        numbers |= {
            f"largest multiplier of {name}": float(size)
            for name, size in zip(names, sizes, strict=True)
        }
    return watched | {name: (value, 1e-7) for name, value in numbers.items()}


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


def grazing_forecast(kept: dict[str, float]) -> Expected:
    """Return the gaps that the vibration without impacts just reaches."""
    names = [name.removesuffix(": d") for name in kept if name.endswith(": d")]
    numbers: Expected = {}
    for name in names:
        zeta, xi = kept[f"{name}: ζ"], kept[f"{name}: ξ"]
        numbers[f"{name}: d"] = (float(1 / abs(1 - zeta**2 + 2j * xi * zeta)), 1e-9)
    return numbers


def posterior() -> Expected:
    """Compute the plotted record, drawn from the prior, and its information from the Jacobian."""
    key, _, _ = jax.random.split(jax.random.key(1), 3)
    truth = jax.random.normal(key, (200, 3))

    def run_of(z):
        k = 0.3 + 0.6 * jax.scipy.stats.norm.cdf(z[0])
        gap, xi = 1.2 * jnp.exp(0.1 * z[1]), 0.05 * jnp.exp(0.4 * z[2])
        scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=k, gap=gap, damping_ratio=xi)
        return vi.simulate(scene, scene.start(), 4, method=vi.ExactFlight(), samples=16)

    def positions(z):
        samples = run_of(z).samples
        assert samples is not None
        return samples.state.Y[1:]

    impacts = vi.jit(jax.vmap(lambda z: run_of(z).impacts.sum()))(truth)
    first = int(np.argmax(np.asarray(impacts) >= 3))
    slope = np.asarray(vi.jit(jax.jacfwd(positions))(truth[first]))
    return {
        "record of the picture": (first, 0),
        "its impacts": (int(impacts[first]), 0),
        "its least position": (float(positions(truth[first]).min()), 1e-9),
        "its information on z": (float(np.linalg.slogdet(slope.T @ slope)[1]), 1e-8),
    }
