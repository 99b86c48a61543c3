"""Compare the closed form with the paper's numbers and with independent flights."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar
from vi_jax.orbit.closed_form import closed_form_orbits, one_impact_orbits

from closed_forms import FIELDS, ideal, solve


def flight(zeta, xi, phase, Y, V, tau):
    """Return (Y, V) a time tau after the crank angle `phase`: free plus steady response."""
    steady = np.exp(1j * phase) / (1 - zeta**2 + 2j * xi * zeta)
    y, v = Y - steady.real, V - (1j * zeta * steady).real
    omega = np.sqrt(1 - xi**2 + 0j)
    C, S = np.cos(omega * tau), np.sin(omega * tau) / omega
    fade, later = np.exp(-xi * tau), steady * np.exp(1j * zeta * tau)
    return (
        (fade * ((C + xi * S) * y + S * v)).real + later.real,
        (fade * ((C - xi * S) * v - S * y)).real + (1j * zeta * later).real,
    )


def samples(seed, count=400):
    """Draw ζ, ξ, k, d at random, half of them undamped and some overdamped."""
    draw = np.random.default_rng(seed)
    zeta, k, d = (
        draw.uniform(0.4, 2.5, count), draw.uniform(0.05, 1, count), draw.uniform(0, 3, count),
    )  # fmt: skip
    xi = np.where(draw.random(count) < 0.5, 0.0, 10 ** draw.uniform(-3, 0.3, count))
    apart = np.abs(1 - zeta**2 + 2j * xi * zeta) > 0.02  # `flight` loses digits near resonance
    return zeta[apart], xi[apart], k[apart], d[apart]


solve_many = jax.jit(
    lambda zeta, xi, k, d, n: jax.vmap(partial(one_impact_orbits, n=n))(zeta, xi, k, d),
    static_argnums=4,
)


# Printed in the paper: the first five of `FIELDS`, and the multipliers.
TABLE = {
    1: ((1.92303, -0.876442, 6.19998, 1.57475, -1.883583), [-0.214402, -1.166036]),
    2: ((1.609674, -1.943612, 12.37807, 3.54674, -3.254293), [-0.298755 + 0.400931j] * 2),
}


@pytest.mark.parametrize("n", TABLE)
def test_agrees_with_the_table_of_the_undamped_motions(n):
    orbits, (wanted, multipliers) = solve(0.9, 0.0, 0.5, 2.0, n), TABLE[n]
    found = [float(getattr(orbits, name)[0]) for name in FIELDS[:5]]
    np.testing.assert_allclose(found, wanted, atol=6e-6)
    assert orbits.admissible.tolist() == [True, False]
    assert orbits.exists.tolist() == [True, False]
    assert np.isnan(orbits.Y[1]) and np.isnan(orbits.multipliers[1]).all()
    assert orbits.y_max[0] == 2.0
    np.testing.assert_allclose(orbits.multipliers[0].real, np.real(multipliers), atol=6e-7)
    np.testing.assert_allclose(np.abs(orbits.multipliers[0].imag), np.imag(multipliers), atol=6e-7)


@pytest.mark.parametrize("n", [1, 2])
def test_meets_the_boundary_conditions_and_passes_the_section(n):
    zeta, xi, k, d = (x[:, None] for x in samples(0))
    orbits = solve_many(*(x[:, 0] for x in (zeta, xi, k, d)), n)
    exists = np.asarray(orbits.exists)
    assert exists.sum() > 100
    phase, v = np.asarray(orbits.impact_phase), np.asarray(orbits.impact_speed)
    scale = (1 + np.abs(v) + d) / np.abs(1 - zeta**2 + 2j * xi * zeta)
    Y, V = flight(zeta, xi, phase, d, -k * v, 2 * np.pi * n / zeta)
    assert np.nanmax(np.abs(Y - d) / scale) < 1e-12
    assert np.nanmax(np.abs(V - v) / scale) < 1e-12
    assert (v[exists] > 0).all()
    assert (phase[exists] > 2 * np.pi * (n - 1)).all() and (phase[exists] <= 2 * np.pi * n).all()
    Y, V = flight(zeta, xi, phase, d, -k * v, (2 * np.pi * n - phase) / zeta)
    assert np.nanmax(np.abs(Y - orbits.Y) / scale) < 1e-12
    assert np.nanmax(np.abs(V - orbits.V) / scale) < 1e-12


def test_its_states_are_starts():
    """A batch of two motions; the search of the unstable one converges at once."""
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, damping_ratio=0.0)
    found = vi.closed_form_orbits(scene)
    first = jax.tree.map(lambda x: x[0], found.state)
    orbit = vi.find_orbit(scene, first, throw=True)
    np.testing.assert_allclose(orbit.state.Y, found.Y[0], atol=1e-12)
    log = orbit.trajectory(cycles=2, event_log=4).event_log
    assert log.phase.shape == (2, 4) and int((log.number >= 0).sum()) == 2


def test_admissible_motions_come_first_then_faster_ones():
    orbits = solve_many(*samples(0), 1)
    admissible, exists = np.asarray(orbits.admissible), np.asarray(orbits.exists)
    assert (exists.sum(1) == 2).sum() > 5  # some have two motions
    assert not (admissible & ~exists).any()
    for flag in (admissible, exists):
        assert not (~flag[:, 0] & flag[:, 1]).any()
    alike = exists.all(1) & (admissible[:, 0] == admissible[:, 1])
    speed = np.asarray(orbits.impact_speed)[alike]
    assert (speed[:, 0] >= speed[:, 1]).all()


@pytest.mark.parametrize(("zeta", "xi"), [(1.0, 0.0), (0.8, 1.0)])
def test_meets_the_boundary_conditions_by_runge_kutta(zeta, xi):
    """The cases are resonance and critical damping."""
    k, d = 0.5, (2.0 if xi < 1 else 0.1)
    orbits = solve(zeta, xi, k, d, 1)
    phase, v = float(orbits.impact_phase[0]), float(orbits.impact_speed[0])
    field = lambda t, x: (x[1], np.cos(phase + zeta * t) - x[0] - 2 * xi * x[1])
    period = 2 * np.pi / zeta
    run = solve_ivp(field, (0, period), (d, -k * v), method="DOP853", rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(run.y[:, -1], (d, v), atol=2e-11)


@pytest.mark.slow
def test_every_motion_and_its_extremes():
    zeta, xi, k, d = samples(1)
    n = 2
    orbits = solve_many(zeta, xi, k, d, n)
    phases = np.linspace(0, 2 * np.pi, 20001)
    for i in range(zeta.size):
        fly = partial(flight, zeta[i], xi[i])
        period = 2 * np.pi * n / zeta[i]
        Y0, V0 = fly(phases, d[i], 0.0, period)
        dY, dV = np.subtract(fly(0.0, d[i], 1.0, period), fly(0.0, d[i], 0.0, period))
        v = (Y0 - d[i]) / (k[i] * dY)  # closes the position at every phase, but not the speed
        wrong = V0 - k[i] * v * dV - v
        crossings = np.diff(np.sign(wrong)) != 0
        assert (crossings & (v[1:] > 0)).sum() == orbits.exists[i].sum()
    for i, j in np.argwhere(np.asarray(orbits.exists))[:120]:
        period = 2 * np.pi * n / zeta[i]
        phase, v = float(orbits.impact_phase[i, j]), float(orbits.impact_speed[i, j])
        at = lambda t: flight(zeta[i], xi[i], phase, d[i], -k[i] * v, t)[0]  # noqa: B023
        t = np.linspace(0, period, 20001)
        Y = at(t)

        def best(sign, where, at=at, t=t):
            bounds, options = (t[where - 1], t[where + 1]), {"xatol": 1e-10}
            turn = lambda s: sign * at(s)
            found = minimize_scalar(turn, bounds=bounds, method="bounded", options=options)
            return sign * found.fun

        scale = 1e-10 * (1 + np.abs(Y).max())
        assert abs(best(1, Y.argmin()) - orbits.y_min[i, j]) < scale
        peaks = 1 + np.flatnonzero((Y[1:-1] > Y[:-2]) & (Y[1:-1] > Y[2:]))
        if peaks.size == 0:
            assert orbits.clearance[i, j] == np.inf and orbits.y_max[i, j] == d[i]
            continue
        highest = best(-1, peaks[Y[peaks].argmax()])
        assert abs(d[i] - highest - orbits.clearance[i, j]) < scale
        assert abs(max(highest, d[i]) - orbits.y_max[i, j]) < scale
        assert bool(orbits.admissible[i, j]) == bool(highest <= d[i])


@pytest.mark.slow
def test_multipliers_have_the_determinant_and_are_those_of_the_cycle_map():
    zeta, xi, k, d = samples(3)
    for n in (1, 2):
        orbits = solve_many(zeta, xi, k, d, n)
        wanted = (k**2 * np.exp(-4 * np.pi * n * xi / zeta))[:, None]
        product = np.asarray(jnp.prod(orbits.multipliers, axis=-1))
        size = np.abs(np.asarray(orbits.multipliers)).max(-1) ** 2
        assert np.nanmax(np.abs(product - wanted) / (1 + size)) < 1e-12

    # Differences of the map from just before an impact to just before the next one.
    zeta, xi, k, d, n = 0.9, 0.02, 0.5, 1.5, 1
    orbits = solve(zeta, xi, k, d, n)
    phase, v = float(orbits.impact_phase[0]), float(orbits.impact_speed[0])

    def next_impact(phase, v):
        t = 2 * np.pi * n / zeta
        for _ in range(20):
            Y, V = flight(zeta, xi, phase, d, -k * v, t)
            t -= (Y - d) / V
        return np.array([phase + zeta * t, flight(zeta, xi, phase, d, -k * v, t)[1]])

    h = 1e-5
    columns = [next_impact(phase + h, v) - next_impact(phase - h, v),
               next_impact(phase, v + h) - next_impact(phase, v - h)]  # fmt: skip
    wanted = np.sort_complex(np.linalg.eigvals(np.stack(columns, axis=1) / (2 * h)))
    found = np.sort_complex(np.asarray(orbits.multipliers[0]))
    np.testing.assert_allclose(found, wanted, atol=1e-8)


def test_resonance_is_the_limit_from_both_sides():
    # At resonance cos φ0 = 1 and v = nπ/(1 + k), for every gap.
    for n in (1, 2):
        at = solve(1.0, 0.0, 0.5, 2.0, n)
        np.testing.assert_allclose(at.impact_speed[0], np.pi * n / 1.5, rtol=1e-12)
        for zeta in (1 - 1e-8, 1 + 1e-8):
            near = solve(zeta, 0.0, 0.5, 2.0, n)
            np.testing.assert_allclose(near.impact_speed[0], at.impact_speed[0], rtol=1e-6)
            np.testing.assert_allclose(near.y_min[0], at.y_min[0], rtol=1e-6)


@partial(jax.jit, static_argnums=4)
@partial(jax.vmap, in_axes=(0, 0, 0, None, None))
def simulated(zeta, k, d, section, n):
    """Return the motions, and the impacts and the closure error of a period of the first."""
    scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=d).at_section(section)
    orbits = closed_form_orbits(scene, cycles=n)
    start = vi.OscillatorState(jnp.nan_to_num(orbits.Y[0]), jnp.nan_to_num(orbits.V[0]))
    run = vi.simulate(scene, start, n, method=vi.ExactFlight())
    apart = jnp.maximum(jnp.abs(run.last.Y - orbits.Y[0]), jnp.abs(run.last.V - orbits.V[0]))
    return orbits, run.impacts.sum(), apart


@pytest.mark.slow
def test_an_impact_on_the_section_is_met_once():
    """At ζ = 1 without damping all impacts are at φ = 0."""
    draw = np.random.default_rng(6)
    d, k = draw.uniform(0.3, 2.5, 200), draw.uniform(0.1, 1, 200)
    at_zero, impacts, apart = simulated(np.ones(200), k, d, 0.0, 1)
    there = np.asarray(at_zero.admissible[:, 0])
    assert there.sum() > 150
    np.testing.assert_allclose(at_zero.impact_phase[there, 0], 2 * np.pi, rtol=0)
    np.testing.assert_array_equal(at_zero.Y[there, 0], d[there])
    np.testing.assert_allclose(at_zero.V[there, 0], -k[there] * np.pi / (1 + k[there]), rtol=1e-10)
    assert (np.asarray(impacts)[there] == 1).all() and np.asarray(apart)[there].max() < 1e-11
    other, impacts, apart = simulated(np.ones(200), k, d, 1.0, 1)
    assert (np.asarray(impacts)[there] == 1).all() and np.asarray(apart)[there].max() < 1e-11
    np.testing.assert_allclose(other.impact_phase[there, 0], 2 * np.pi, rtol=1e-12)


def test_states_are_on_the_section_of_the_scene():
    scene = ideal(damping_ratio=0.02)
    for section in (1.0, -2.0):
        orbits = closed_form_orbits(scene.at_section(section), cycles=2)
        here = closed_form_orbits(scene, cycles=2)
        phase, v = float(here.impact_phase[0]), float(here.impact_speed[0])
        since = (section - phase) % (2 * np.pi)
        state = flight(0.9, 0.02, phase, 2.0, -0.5 * v, since / 0.9)
        np.testing.assert_allclose((orbits.Y[0], orbits.V[0]), state, atol=1e-12)
        assert float(orbits.impact_phase[0]) == pytest.approx(section + 4 * np.pi - since)
        assert section + 2 * np.pi < float(orbits.impact_phase[0]) <= section + 4 * np.pi


def test_nothing_exists_where_the_free_motion_is_periodic():
    for zeta, n in ((1 / 2, 1), (1 / 3, 1), (2 / 3, 2), (2.0, 2), (0.4, 2)):
        orbits = solve(zeta, 0.0, 0.5, 2.0, n)
        assert not orbits.exists.any() and not orbits.admissible.any()
        assert all(np.isnan(getattr(orbits, name)).all() for name in FIELDS)


def numbers_of(at):
    """Return the values of the first motion, then the sum over the motions that exist. The absent
    second motion must not affect the derivatives."""
    orbits = one_impact_orbits(*at, 1)
    first = jnp.stack([getattr(orbits, name)[0] for name in FIELDS])
    first = jnp.where(jnp.isinf(first), 0.0, first)
    fields = jnp.stack([getattr(orbits, name) for name in FIELDS[:6]])
    there = jnp.where(orbits.exists, fields, 0.0).sum()
    return jnp.concatenate([first, jnp.stack([orbits.multipliers[0, 0].real, there])])


@pytest.mark.slow
def test_derivatives():
    """The cases are damped, undamped, resonance, critical damping, and three without a motion."""
    at = jnp.array([
        (0.9, 0.03, 0.5, 1.5), (0.9, 0.0, 0.5, 2.0), (1.0, 0.0, 0.4, 1.5), (0.8, 1.0, 0.5, 0.1),
    ])  # fmt: skip
    absent = jnp.array([(0.5, 0.0, 0.5, 2.0), (0.9, 0.0, 0.5, 9.0), (0.9, 0.1, 0.0, 2.0)])
    h = 1e-5  # ξ - h may be negative, where the formulas still hold
    ahead, behind = (at[:, None] + sign * h * jnp.eye(4) for sign in (1, -1))
    rows = jnp.concatenate([at, absent, ahead.reshape(-1, 4), behind.reshape(-1, 4)])
    slopes = lambda at: (numbers_of(at), jax.jacfwd(numbers_of)(at), jax.jacrev(numbers_of)(at))
    values, forward, reverse = jax.jit(jax.vmap(slopes))(rows)
    assert jnp.isfinite(forward[4:7, -1]).all() and jnp.isfinite(reverse[4:7, -1]).all()
    np.testing.assert_allclose(forward[:4], reverse[:4], rtol=1e-9, atol=1e-10)
    difference = (values[7:23] - values[23:]).reshape(4, 4, -1) / (2 * h)
    for i, case in enumerate(at):
        # At resonance the impact is on the section, where the state jumps, and the multiplier is
        # double, so that it has no derivative.
        kept = slice(3, 5) if case[0] == 1 else slice(None)
        np.testing.assert_allclose(forward[i][kept], difference[i].T[kept], rtol=2e-6, atol=2e-7)
