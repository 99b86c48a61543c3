"""The studies' headline numbers, computed with the library as it is, by cheaper ways.

Each function gives numbers by the names under which the study of that name keeps them, with the
difference that is allowed.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from headlines.jaxprs import primitives
from scipy.optimize import brentq

Expected = dict[str, tuple[float, float]]
XI = float(vi.Parameters().scene(drive="ideal").damping_ratio)
# Roots by brentq beside located special points, both to rounding of a multiplier or a clearance.
ROOT = 1e-8


@partial(jax.jit, static_argnames="cycles")
def closed(zeta: Any, k: Any, xi: Any, gap: Any, *, cycles: int) -> vi.ClosedFormOrbits:
    """Motions with one impact in so many cycles."""
    scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=gap, damping_ratio=xi)
    return vi.closed_form_orbits(scene, cycles=cycles)


def doubling(k: float, xi: float, cycles: int, low: float, high: float) -> float:
    """ζ at which a multiplier is -1."""

    def test(zeta):
        found = closed(zeta, k, xi, 2.0, cycles=cycles)
        return float(np.real(np.prod(np.asarray(found.multipliers[0]) + 1)))

    return float(brentq(test, low, high, xtol=1e-13))


def touch(k: float, xi: float, low: float, high: float) -> float:
    """ζ at which the 4π motion touches the stop between its impacts."""

    def clearance(zeta):
        return float(closed(zeta, k, xi, 2.0, cycles=2).clearance[0])

    return float(brentq(clearance, low, high, xtol=1e-13))


def fold(k: float, xi: float, low: float, high: float) -> float:
    """ζ beyond which there is no 2π motion with an impact."""
    while high - low > 1e-10:
        middle = 0.5 * (low + high)
        there = bool(closed(middle, k, xi, 2.0, cycles=1).exists.any())
        low, high = (middle, high) if there else (low, middle)
    return low


def births(xi: float) -> tuple[float, float]:
    """ζ at which the steady vibration without impacts reaches the stop at d = 2."""
    half = np.sqrt((1 - 2 * xi**2) ** 2 - 0.75)
    return float(np.sqrt(1 - 2 * xi**2 - half)), float(np.sqrt(1 - 2 * xi**2 + half))


def fig2_frequency_response() -> Expected:
    numbers = {}
    places = {
        (0.8, 0.0): (0.99377, 1.73167), (0.8, XI): (0.96554, 1.58722),
        (0.5, 0.0): (0.93990, 1.52349), (0.5, XI): (0.82456, 1.44326),
    }  # fmt: skip
    for (k, xi), (near_doubling, near_fold) in places.items():
        name = f"k = {k:g}, {'damped' if xi else 'undamped'}"
        first, second = births(xi)
        doubles = doubling(k, xi, 1, near_doubling - 2e-3, near_doubling + 2e-3)
        numbers[f"{name}: BB'"], numbers[f"{name}: CC'"] = first, doubles
        motion = f"{name}, 2π, 1 impact"
        numbers[f"{motion}: grazing {first:.3f}"] = first
        numbers[f"{motion}: grazing {second:.3f}"] = second
        numbers[f"{motion}: period-doubling {doubles:.3f}"] = doubles
        folds = fold(k, xi, near_fold - 1e-2, near_fold + 1e-2)
        numbers[f"{motion}: fold {folds:.3f}"] = folds
        numbers[f"{name}, 4π, 2 impacts: period-doubling {doubles:.3f}"] = doubles
    long = {
        (0.8, 0.0): (0.8343, 0.99383),
        (0.8, XI): (0.8334, 0.9691),
        (0.5, 0.0): (0.8503, 0.9412),
    }
    for (k, xi), ends in long.items():
        name = f"k = {k:g}, {'damped' if xi else 'undamped'}, 4π"
        for end in ends:
            touches = touch(
                k, xi, end - 1e-3 * (end < 0.99) - 1e-4, end + 1e-3 * (end < 0.99) + 1e-4
            )
            for count in ("1 impact", "2 impacts"):
                numbers[f"{name}, {count}: grazing {touches:.3f}"] = touches
    for low, high in ((0.95, 0.96), (0.99, 0.9935)):
        at = doubling(0.8, 0.0, 2, low, high)
        numbers[f"k = 0.8, undamped, 4π, 1 impact: period-doubling {at:.3f}"] = at
    return {name: (value, ROOT) for name, value in numbers.items()}


def bifurcation_diagram() -> Expected:
    numbers = {
        "4π motion doubles": doubling(0.8, 0.0, 2, 0.95, 0.96),
        "4π motion doubles, upper end": doubling(0.8, 0.0, 2, 0.99, 0.9935),
        "2π motion doubles": doubling(0.8, 0.0, 1, 0.99, 0.999),
        "4π motion touches the stop": touch(0.8, 0.0, 0.9937, 0.9939),
    }
    return {name: (value, ROOT) for name, value in numbers.items()}


def boundaries() -> Expected:
    per_c = XI / float(vi.Parameters().damping)

    def test(c):
        found = closed(0.9, 0.5, c * per_c, 2.0, cycles=1)
        return float(np.real(np.prod(np.asarray(found.multipliers[0]) + 1)))

    def clear(c):
        return float(closed(0.9, 0.5, c * per_c, 2.0, cycles=2).clearance[0])

    numbers = {
        "birth, undamped, ζ": births(0.0)[0],
        "doubling at k = 0.5, undamped, ζ": doubling(0.5, 0.0, 1, 0.93, 0.95),
        "doubling at k = 0.8, undamped, ζ": doubling(0.8, 0.0, 1, 0.99, 0.999),
        "4π motion at k = 0.5, undamped, from ζ": touch(0.5, 0.0, 0.849, 0.852),
        "4π motion at k = 0.5, undamped, to ζ": touch(0.5, 0.0, 0.9405, 0.942),
        "fold at k = 0.5, undamped, ζ": fold(0.5, 0.0, 1.51, 1.53),
        "fold at k = 0.8, undamped, ζ": fold(0.8, 0.0, 1.72, 1.74),
        "doubling at ζ = 0.9, k = 0.5, c": float(brentq(test, 0.26, 0.28, xtol=1e-13)),
        "4π motion at ζ = 0.9, k = 0.5, up to c": float(brentq(clear, 0.28, 0.30, xtol=1e-13)),
        "birth at Table 1's c, k = 0.5, ζ": births(XI)[0],
        "doubling at Table 1's c, k = 0.5, ζ": doubling(0.5, XI, 1, 0.82, 0.83),
        "fold at Table 1's c, k = 0.5, ζ": fold(0.5, XI, 1.44, 1.45),
    }
    # Splines through the curves' points, good to 1e-5.
    return {name: (value, 1e-5) for name, value in numbers.items()}


def motor_frequency_response() -> Expected:
    numbers: Expected = {}
    # On the study's grid of ζ, 1e-4 apart at the fold.
    numbers["ideal drive: 2π motion folds, ζ"] = (fold(0.5, XI, 1.44, 1.45), 1.1e-4)
    table = vi.Parameters()
    coupling = float(table.body_mass * table.crank_radius**2 / table.inertia)
    per_nm = 1 / float(table.inertia * table.natural_frequency**2)
    fine = np.linspace(0.9, 3.0, 210_001)
    idle = -coupling * np.imag(0.5 / (1 - fine**2 + 2j * XI * fine))
    clear = np.abs(1 - fine**2 + 2j * XI * fine) > 0.5
    for torque, gap in (
        (100, 2), (10, 2), (2, 2), (0.2, 2), (0.1, 2), (0.05, 2), (2, 20), (0.5, 20)
    ):  # fmt: skip
        kappa = fine + idle / (per_nm * torque)
        name = f"T0 = {torque:g} N·m, gap {gap:g}a"
        down = kappa[(fine > 1) & (clear | (gap == 20))].min()
        numbers[f"{name}, close-down: forecast, κ"] = (float(down), 1.1e-3)  # its grid of ζ
        if gap == 20:
            numbers[f"{name}, run-up: forecast, κ"] = (float(kappa[fine < 1.05].max()), 1.1e-3)
    return numbers


def all_orbits() -> Expected:
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
    return {name: (float(value), 2e-3) for name, value in numbers.items()}


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


def fit_4pi_orbit() -> Expected:
    numbers = {}
    for k, xi, name in (
        (0.5, 0.0, "k = 0.5, undamped"), (0.8, XI, "k = 0.8, Table 1"),
        (0.95, 0.0, "k = 0.95, undamped"),
    ):  # fmt: skip
        scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=k, gap=2.0, damping_ratio=xi)
        run = vi.simulate(scene, scene.start(), 1000, method=vi.ExactFlight(), record="sections")
        sections = np.stack([run.sections.Y, run.sections.V], axis=1)
        late = np.flatnonzero(~(np.abs(sections[2:] - sections[:-2]).max(axis=1) < 1e-6))
        # A cycle more or less where rounding decides when 1e-6 is passed.
        numbers[f"{name}, ideal: cycles of the transient"] = (float(late[-1]) + 1, 1)
    return numbers


def identify() -> Expected:
    """From the Jacobian at the truth: the errors' correlation, and the noise."""
    truth = jnp.array([0.5, XI, 1.2, 0.0, 0.0])

    def positions(x):
        scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=x[0], gap=x[2], damping_ratio=x[1])
        run = vi.simulate(
            scene, scene.start(Y=x[3], V=x[4]), 10, method=vi.ExactFlight(), samples=32
        )
        assert run.samples is not None
        return run.samples.state.Y[1:]

    clean, jacobian = jax.jit(lambda x: (positions(x), jax.jacfwd(positions)(x)))(truth)
    covariance = np.linalg.inv(np.asarray(jacobian.T @ jacobian))
    size = np.sqrt(np.diag(covariance))
    return {
        "noise": (float(jnp.std(clean)) * 10**-1.5, 1e-9),
        "k and ξ: correlation": (float(covariance[0, 1] / size[0] / size[1]), 1e-6),
    }


def posterior() -> Expected:
    """The record of the picture, drawn from the prior, and what it can tell by its Jacobian."""
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


def regime_maps() -> Expected:
    """Every fourth lane each way of the map with Table 1's damping."""
    data = vi.scan(
        lambda zeta, k: vi.Scene.ideal(
            frequency_ratio=zeta, restitution=k, gap=2.0, damping_ratio=XI
        ),
        {"zeta": np.linspace(0.5, 1.9, 256)[::4], "k": np.linspace(0.05, 0.95, 256)[::4]},
        measure="regime", settle=400, method=vi.ExactFlight(), progress=False,
    )  # fmt: skip
    period, impacts = data["period"].values, data["impacts"].values
    parts = {
        "without impacts, periodic, %": (impacts == 0) & (period > 0),
        "2π with impacts, %": (impacts > 0) & (period == 1),
        "4π with one impact, %": (impacts == 1) & (period == 2),
    }
    # Borders cross the coarse grid elsewhere, by about half its step: 1 % of a side.
    name = "(ζ, k), c = 0.5 N·s/m (Table 1)"
    return {f"{name}: {kind}": (100 * float(np.mean(x)), 1.0) for kind, x in parts.items()}


def fixed_steps_error(cycles: int) -> float:
    """Median error of 10 steps of Verner9, of 64 lanes of Table 1's machine, k = 0.8, d = 2."""

    def lane(method, zeta):
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=0.8, gap=2.0, damping_ratio=XI)
        run = vi.simulate(scene, scene.start(), cycles, method=method, record="sections")
        return jnp.stack([run.last.Y, run.last.V])

    exact, fixed = (
        vi.jit(jax.vmap(partial(lane, method)))(jnp.linspace(0.5, 1.9, 64))
        for method in (vi.ExactFlight(), vi.FixedStep())
    )
    return float(np.median(np.abs(exact - fixed).max(axis=1)))


# The lanes of the test are fewer than a study's, so that the median is the same within a third.


def speed_accuracy() -> Expected:
    error = fixed_steps_error(20)
    name = "FixedStep Verner9, 10 steps: median error of the state, 20 cycles, ideal drive"
    return {name: (error, error / 3)}


def peers() -> Expected:
    error = fixed_steps_error(200)
    name = "vi_jax FixedStep(Verner9, 10), ideal drive, k = 0.8: median error"
    return {name: (error, error / 3)}


def dc_motor() -> Expected:
    """From closed forms of the ideal drive on; the study comes from a long simulation."""
    guess = closed(0.896, 0.5, XI, 2.0, cycles=1)
    found = []
    for time in (None, 0.1):
        lag = None if time is None else time / float(vi.Parameters().natural_frequency)
        scene = vi.Parameters(torque=10.0, restitution=0.5, electrical_time=lag).scene()
        begin = scene.start(Y=guess.Y[0], V=guess.V[0], W=0.896)
        found.append(vi.find_orbit(scene, begin, method="reference", throw=True))
    line, lagging = found
    return {
        "T0 = 10 N·m, κ = 0.9, straight line: min Y": (float(line.y_min), 1e-7),
        "T0 = 10 N·m, κ = 0.9, τe = 0.1: min Y": (float(lagging.y_min), 1e-7),
        "T0 = 10 N·m, κ = 0.9, τe = 0.1: ζ": (float(lagging.frequency_ratio), 1e-7),
    }


def known_machines() -> Expected:
    """Closed forms, and multipliers and clearances of motions found at them."""
    e, s = 0.5, 1 / 3
    fold = (1 + (np.pi / (2 * s)) ** 2) ** 0.5
    breaks = (np.pi / 2 - 2 / np.pi) / np.sqrt(4 / np.pi**2 + s * s)
    pair = vi.machines.ImpactPair(half_gap=breaks + 1e-3, restitution=e)
    orbit = vi.find_orbit(pair, vi.simulate(pair, pair.start(), 1, settle=2000).last, throw=True)
    branch = vi.continue_orbit(orbit, parameter="half_gap", bounds=(1.28, 1.32))
    return {
        "birth of one bounce, e = 0.5": (np.pi * s, 1e-9),
        "its period doubling, e = 0.5": (
            float(np.hypot(np.pi * s, 2 * (1 + e * e) / (1 + e) ** 2)), 1e-9,
        ),
        "fold of the pair, e = 0.5": (float(fold), 1e-9),
        "its loss of symmetry, e = 0.5": (branch.special[0].parameter, 1e-8),
        "grazing of the oscillator, ω = 1": (0.1, 1e-9),
    }  # fmt: skip


def relief_valve() -> Expected:
    """The Hopf bifurcation by eigenvalues, the others from motions beside them."""

    def growth(rate: float) -> float:
        lift = brentq(lambda y: rate - y * np.sqrt(y + 10), 1e-9, 50)
        root = np.sqrt(lift + 10)
        jacobian = [[0, 1, 0], [-1, -1.25, 1], [-20 * root, 0, -10 * lift / root]]
        return float(np.linalg.eigvals(np.array(jacobian)).real.max())

    def special(rate: float, bounds: tuple[float, float]) -> vi.SpecialPoint:
        valve = vi.machines.ReliefValve(flow_rate=rate)
        settled = vi.simulate(valve, valve.start(), 1, settle=400).last
        branch = vi.continue_orbit(
            vi.find_orbit(valve, settled), parameter="flow_rate", bounds=bounds
        )
        return branch.special[0]

    return {
        "Hopf, q": (float(brentq(growth, 8.0, 9.0)), 1e-6),
        "grazing, q": (special(7.8, (7.4, 7.9)).parameter, 1e-8),
        "first doubling, q": (special(1.6, (1.2, 1.7)).parameter, 1e-8),
        "second doubling, q": (special(5.8, (5.7, 6.2)).parameter, 1e-8),
    }


def woodpecker(kept: dict[str, float]) -> Expected:
    """Of cycles beside each other, whose differences give Newton's steps and multipliers."""

    def returned(friction: Any, begins: Any) -> Any:
        toy = vi.machines.Woodpecker(friction=friction)
        start = toy.start(speed=begins[0], bird_rate=begins[1])
        run = vi.simulate(toy, start, 1, settle=0, method=vi.Adaptive(rtol=1e-12))
        last = run.last
        return jnp.stack([last.speed, last.bird_rate, run.duration[0], last.drop])

    steps = np.array([2e-5, 5e-4])
    moves = np.concatenate([np.zeros((1, 2)), np.diag(steps), -np.diag(steps)])
    lanes = vi.jit(jax.vmap(jax.vmap(returned, (None, 0))))
    doubles = "period doubles, μ"
    beside = kept[doubles] + np.array([-1e-4, 1e-4])
    frictions = np.array([0.3, 0.6, 0.8, 1.0, *beside])
    guesses = [(-0.34, -7.46), (-0.0, -11.0), (-0.0, -11.0), (-0.0, -11.0)]
    x = np.array([*guesses, (-0.29, -7.46), (-0.29, -7.46)])
    ends, slopes = np.zeros(0), np.zeros(0)
    # Some cycles first, by which guesses come near.
    for turn in range(70):
        ends = np.asarray(lanes(jnp.asarray(frictions), jnp.asarray(x[:, None] + moves)))
        slopes = ((ends[:, 1:3, :2] - ends[:, 3:5, :2]) / (2 * steps[:, None])).transpose(0, 2, 1)
        newton = np.linalg.solve(np.eye(2) - slopes, (ends[:, 0, :2] - x)[..., None])[..., 0]
        x = ends[:, 0, :2] if turn < 60 else x + newton
    numbers: Expected = {}
    for i, value in enumerate(frictions[:4]):
        numbers[f"period at μ = {value:g}, ms"] = (1e3 * float(ends[i, 0, 2]), 1e-6)
        numbers[f"drop at μ = {value:g}, mm"] = (1e3 * float(ends[i, 0, 3]), 1e-6)
    multipliers = np.linalg.eigvals(slopes).real.min(axis=1)
    numbers["multiplier at μ = 0.3"] = (float(multipliers[0]), 1e-6)
    numbers[doubles] = (float(np.interp(1.0, -multipliers[4:], beside)), 2e-6)
    return numbers


def sommerfeld() -> Expected:
    """Where the averaged κ = ζ + ε ξ ζ⁵/(τ0 D) turns; the motion's own folds lie beside it."""
    numbers: Expected = {}

    def kappa(z: float, strength: float) -> float:
        return z + 0.01 * 0.05 * z**5 / ((1 - z * z) ** 2 + (0.1 * z) ** 2) / strength

    def slope(z: float, strength: float) -> float:
        return (kappa(z + 1e-6, strength) - kappa(z - 1e-6, strength)) / 2e-6

    for strength in (0.1, 0.2):
        for way, low, high in (("run-up", 0.9, 1.03), ("close-down", 1.03, 1.4)):
            at = kappa(float(brentq(slope, low, high, args=(strength,))), strength)
            numbers[f"τ0 = {strength:g}, {way}: averaged fold, κ"] = at, 1e-8
            numbers[f"τ0 = {strength:g}, {way}: fold, κ"] = at, 1e-3
    return numbers


def scene_cost() -> Expected:
    """Operations in the program of a lane; other versions of JAX write some of it otherwise."""

    def run(method, ratio):
        scene = vi.Scene(
            oscillator=vi.Oscillator(0.0448), drive=vi.IdealDrive(ratio),
            stops=[vi.RigidStop(2.0, 0.8)],
        )  # fmt: skip
        found = vi.simulate(scene, scene.start(), 200, method=method, record="sections")
        return jax.tree.leaves(found)

    numbers = {}
    for name, method in (("one stop", vi.FixedStep()), ("exact flight", vi.ExactFlight())):
        size = primitives(jax.make_jaxpr(partial(run, method))(0.9).jaxpr).total()
        numbers[f"operations: ideal, {name}"] = (float(size), 0.05 * size)
    return numbers


def explorer() -> Expected:
    """The motion where the sliders begin: the 4π motion in closed form."""
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.01)
    found = vi.closed_form_orbits(scene, cycles=2)
    return {
        "lowest position where the sliders begin": (float(found.y_min[0]), 1e-9),
        "highest": (2.0, 1e-9),
    }


def soft_stop() -> Expected:
    """Where the 2π motion doubles its period before a linear stop, and a multiplier well above."""
    closed_form = closed(0.9, 0.5, 0.0, 2.0, cycles=1)
    stop = vi.SoftStop(2.0, 1.0, restitution=0.5)
    doubles = "K at the doubling, spring and dashpot"

    def least(stiffness):
        scene = vi.Scene(
            vi.Oscillator(0.0), vi.IdealDrive(0.9), soft_stops=(with_stiffness(stop, stiffness),)
        )
        orbit = vi.find_orbit(scene, guess[0], throw=True)
        guess[0] = orbit.state
        return float(np.min(np.real(np.asarray(orbit.multipliers))))

    guess = [vi.OscillatorState(closed_form.Y[0], closed_form.V[0])]
    found = {"multiplier of the 2π motion at K = 1000, spring and dashpot": (least(1000.0), 1e-6)}
    least(200.0)
    stiffness = float(brentq(lambda K: least(K) + 1, 60, 90, xtol=1e-9))
    return {doubles: (stiffness, 1e-6), **found}


def with_stiffness(stop: vi.SoftStop, stiffness: float) -> vi.SoftStop:
    return eqx.tree_at(lambda x: x.stiffness, stop, jnp.asarray(stiffness))
