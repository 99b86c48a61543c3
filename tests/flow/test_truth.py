"""Impacts, chatter, rest and release, compared with an independent code (`tests/truth.py`)."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

import truth

CYCLES = 4
METHODS = {
    "exact": (vi.ExactFlight(), 4_000, 1e-9),
    "fixed": (vi.FixedStep(), 256, 1e-6),
    "adaptive": (vi.Adaptive(rtol=1e-12), 256, 1e-8),
}


def draw(lanes, seed):
    """Return random ζ, ξ, k, d, Y, V and section angles. Some stops are deep, some gaps near ±1,
    and many lanes start at rest on the stop."""
    rng = np.random.default_rng(seed)
    uniform = rng.uniform

    def some(share):
        return rng.random(lanes) < share

    zeta = uniform(0.2, 2, lanes)
    zeta = np.where(np.abs(zeta - 1) < 0.05, zeta + 0.1, zeta)  # away from resonance in `truth`
    gap = uniform(-1.2, 1.2, lanes)
    gap = np.where(some(0.2), np.sign(gap) * (1 - 10 ** uniform(-5, -0.5, lanes)), gap)
    xi = np.where(some(0.2), 0.0, uniform(0, 0.3, lanes))
    k = np.where(some(0.25), 0.0, uniform(0, 0.8, lanes))
    Y = gap - np.where(some(0.3), 0.0, uniform(0, 2, lanes))
    V = np.where(some(0.3), 0.0, uniform(-1, 1, lanes))
    section = np.where(some(0.3), 0.0, uniform(-np.pi, np.pi, lanes))
    return zeta, xi, k, gap, Y, V, section


@cache
def program(name):
    """Return the compiled program that simulates all lanes with a method."""

    def lane(x):
        zeta, xi, k, gap, Y, V, section = x
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=gap, damping_ratio=xi)
        scene = scene.at_section(section)
        run = vi.simulate(scene, scene.start(Y=Y, V=V), CYCLES, method=METHODS[name][0])
        states = jnp.stack([run.sections.Y, run.sections.V], axis=1)
        return states, run.y_min, run.y_max, run.rests, run.successful

    return vi.jit(lambda x: jax.lax.map(lane, x, batch_size=256))


def draw_short(lanes, seed):
    """Return lanes at rest 1e-15 to 1e-8 before the stop, where the force is or becomes small."""
    rng = np.random.default_rng(seed)
    zeta, xi, k, gap, *_ = draw(lanes, seed)
    gap = np.clip(gap, -0.999, 0.999)
    section = np.arccos(gap) * rng.choice([-1, 1], lanes)
    section[::3] += 10 ** rng.uniform(-12, -3, section[::3].size)
    off = 10 ** rng.uniform(-15, -8, lanes)
    return zeta, xi, k, gap, gap - off, np.zeros(lanes), section


def compare(name, lanes, seed, draw=draw):
    """Return each lane's deviation, the sensitivity of the reference, and both counts of rests."""
    x = draw(lanes, seed)
    states, low, high, rests, good = map(np.asarray, program(name)(tuple(map(jnp.asarray, x))))
    assert good.all()
    # In the second half, stops and starts are moved by 1e-9.
    moved = np.repeat([0.0, 1e-9], lanes)
    zeta, xi, k, gap, Y, V, section = (np.tile(numbers, 2) for numbers in x)
    stops = ((1, gap + moved, k),)
    both = truth.flown(zeta, xi, stops, Y + moved, V, CYCLES, section=section)
    expected, nudged = (
        truth.Truth(*(a[..., half] for a in both)) for half in (np.s_[:lanes], np.s_[lanes:])
    )
    apart = np.abs(np.moveaxis(expected.sections, -1, 0) - states).max(axis=(1, 2))
    apart = np.maximum(apart, np.abs(expected.y_min.T - low).max(axis=1))
    apart = np.maximum(apart, np.abs(expected.y_max.T - high).max(axis=1))
    growth = np.abs(nudged.sections - expected.sections).max(axis=(0, 1)) / 1e-9
    return apart, growth, expected.rests.T, rests


def check(name, lanes, seed):
    tolerance = METHODS[name][2]
    apart, growth, expected, rests = compare(name, lanes, seed)
    # A grazing within the method's error may be an impact or not.
    clear = growth < 1e3
    assert clear.mean() > 0.999
    assert apart[clear].max() < tolerance
    assert (rests == expected).all(axis=1)[clear].mean() > 0.999


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_random_lanes_from_deep_stops_to_beyond_reach(name):
    check(name, METHODS[name][1], 0)


@pytest.mark.slow
def test_start_at_rest_just_before_the_stop():
    apart, growth, expected, rests = compare("exact", 1_000, 0, draw_short)
    clear = growth < 1e3
    assert clear.mean() > 0.99
    assert apart[clear].max() < 1e-9
    assert (rests == expected).all(axis=1)[clear].mean() > 0.999


@pytest.mark.parametrize("method", [vi.ExactFlight(), vi.FixedStep(), vi.Adaptive(rtol=1e-13)])
def test_deep_stop_releases_the_body_for_a_moment(method):
    """The force changes sign twice within a step. At ζ = 1, ξ = 0 only SciPy is a reference."""
    scene = vi.Scene.ideal(frequency_ratio=1.0, restitution=0.5, gap=-0.9)
    run = vi.simulate(scene, scene.start(Y=-0.9), 3, method=method, impact_log=4)
    expected = truth.integrated(1.0, 0.0, ((1, -0.9, 0.5),), (-0.9, 0.0), 3)
    assert run.rests.tolist() == expected.rests.tolist() == [1, 1, 1]
    np.testing.assert_allclose(run.y_min, expected.y_min, atol=1e-8)
    np.testing.assert_allclose(run.impact_speed, 0.198, atol=5e-4)
    assert abs(float(run.y_min[0]) + 0.93867) < 5e-6


def test_short_pressing_near_the_reach_of_the_crank():
    zeta, xi, gap, section = 0.855403, 0.164115, 0.996002, 0.688663
    scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=0.0, gap=gap, damping_ratio=xi)
    scene = scene.at_section(section)
    run = vi.simulate(scene, scene.start(Y=0.995299, V=1e-5), 4, method=vi.ExactFlight())
    assert run.impacts.tolist() == [2, 2, 2, 2] and run.rests.tolist() == [1, 1, 1, 1]
    expected = truth.flown(zeta, xi, ((1, gap, 0.0),), 0.995299, 1e-5, 4, section=section)
    np.testing.assert_allclose(run.sections.Y, expected.sections[:, 0, 0], atol=1e-10)
    assert abs(float(run.last.Y) - 0.98524372) < 1e-8


GAPS, RESTITUTIONS = (-1.2, -0.9, -0.3, 0.7, 0.98, 1.5), (0.0, 0.6, 1.0)
MOTOR = {"tau0": 0.6567, "kappa": 0.9, "eps": 0.05, "mu": 0.02}
ROOM = 0.8


def machine(drive, clock, stops):
    turning = vi.IdealDrive(0.9)
    if drive == "motor":
        turning = vi.Motor(MOTOR["tau0"], MOTOR["kappa"], MOTOR["eps"], MOTOR["mu"])
    walls = [vi.RigidStop(gap, k, "right" if sign > 0 else "left") for sign, gap, k in stops]
    return vi.Scene(
        damping_ratio=0.05, drive=turning, stops=walls, clock_name=clock
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drive", "clock", "sides"),
    [("ideal", "time", 2), ("motor", "phase", 1), ("motor", "time", 2)],
)  # fmt: skip
def test_matches_scipy_over_gaps_restitutions_stops_and_clocks(drive, clock, sides):
    """Every gap with every restitution, from rest on the stop and from a moving start."""
    cycles = 2
    cases = [(d, k, off) for d in GAPS for k in RESTITUTIONS for off in (0.0, 0.5)]

    def walls(d, k):
        return ((1, d, k), (-1, ROOM - d, 0.5))[:sides]

    def lane(d, k, off):
        scene = machine(drive, clock, walls(d, k))
        more = {"W": 0.9} if drive == "motor" else {}
        start = scene.start(Y=d - off, V=2 * off, **more)
        method = vi.ExactFlight() if drive == "ideal" else vi.Adaptive(rtol=1e-12)
        run = vi.simulate(scene, start, cycles, method=method)
        found = [run.sections.Y, run.sections.V, *([run.sections.W] if more else [])]
        return jnp.stack(found, axis=1), run.y_min, run.y_max, run.rests, run.successful

    found = vi.jit(jax.vmap(lane))(*map(jnp.asarray, np.array(cases).T))
    for (d, k, off), states, low, high, rests, good in zip(cases, *found, strict=True):
        start = (d - off, 2 * off, 0.9)[: states.shape[1]]
        turning = MOTOR if drive == "motor" else 0.9
        expected = truth.integrated(turning, 0.05, walls(d, k), start, cycles)
        where = f"d = {d}, k = {k}, start {start}"
        assert bool(good), where
        np.testing.assert_allclose(states, expected.sections, atol=1e-7, err_msg=where)
        np.testing.assert_allclose(low, expected.y_min, atol=1e-7, err_msg=where)
        np.testing.assert_allclose(high, expected.y_max, atol=1e-7, err_msg=where)
        assert rests.tolist() == expected.rests.tolist(), where
