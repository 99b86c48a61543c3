"""Extreme parameters, compared with matrix exponentials from impact to impact; tolerances, single
precision and many cycles."""

import warnings
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from linear_truth import Contact, LinearTruth

# ζ, ξ, gap, restitution, Y and V at the start, cycles in double and in single precision.
CORNERS = {
    "undamped": (0.9, 0.0, 1.2, 0.5, 0.0, 1.0, 10, 3),
    "critically damped": (0.9, 1.0, 1.2, 0.5, 0.0, 10.0, 10, 3),
    "strongly damped": (0.9, 10.0, 1.2, 0.5, 0.0, 60.0, 10, 3),
    "a slow drive": (1e-2, 0.01, 2.0, 0.8, 0.0, 4.0, 1, 1),
    "a very slow drive": (2e-3, 0.01, 2.0, 0.8, 0.0, 4.0, 1, None),
    "a fast drive": (1e2, 0.01, 0.5, 0.8, 0.0, 2.0, 60, 60),
    "a very fast drive": (1e3, 0.01, 0.5, 0.8, 0.0, 2.0, 250, None),
    "nearly elastic, near resonance": (0.99, 0.001, 2.0, 0.999, 0.0, 0.0, 20, 5),
    "resonance": (1.0, 0.0, 2.0, 0.5, 0.0, 0.0, 2, 2),
    "no restitution": (0.9, 0.05, 2.0, 0.0, 0.0, 0.0, 10, 10),
    "no room": (0.3, 0.1, 0.0, 0.0, -1.0, 0.0, 5, 5),
    "pressed on": (0.5, 0.05, -0.5, 0.0, -1.0, 0.0, 20, 20),
    "let go of for a moment": (1.1, 0.05, -0.99, 0.0, -0.99, 0.0, 5, None),
    "a stop never met": (0.9, 0.01, 1e150, 0.5, 0.0, 0.0, 10, None),
    "denormal": (0.9, 5e-324, 2.0, 5e-324, 5e-324, -5e-324, 10, None),
    "on the stop, leaving": (0.9, 0.05, 2.0, 0.5, 2.0, -1.0, 3, 3),
    "on the stop, struck at once": (0.9, 0.05, 2.0, 0.5, 2.0, 1.0, 3, 3),
    "on the stop, pulled off": (0.9, 0.05, 2.0, 0.5, 2.0, 0.0, 3, 3),
    "held until cos φ = d": (0.9, 0.05, 0.5, 0.0, 0.5, 0.0, 3, 3),
}  # fmt: skip
# In these cases the section is at φ = π, where the crank pulls the body off the stop.
PULLED = {"no room", "pressed on", "let go of for a moment", "held until cos φ = d"}
ONE = np.ones((1, 1))


@cache
def truth(name, cycles):
    zeta, xi, gap, k, Y, V, *_ = CORNERS[name]
    contact = Contact(np.ones(1), gap, k)
    loads = np.zeros(1), np.full(1, -1.0 if name in PULLED else 1.0), np.zeros(1)
    flight = LinearTruth((ONE, 2 * xi * ONE, ONE), loads, zeta, [contact], most=10_000)
    x, v, resting = np.array([Y]), np.array([-k * V if gap == Y and V > 0 else V]), ()
    for _ in range(cycles):
        x, v, _, resting = flight.cycle(x, v, resting)
    return x[0], v[0]


def errors(method, cycles):
    """Return the error of each corner, relative to 1 + |state|, from one compiled program."""
    names = [name for name, corner in CORNERS.items() if corner[cycles] is not None]
    numbers = np.array([CORNERS[name][:6] for name in names]).T
    settle = np.array([CORNERS[name][cycles] - 1.0 for name in names])
    section = np.array([np.pi * (name in PULLED) for name in names])

    def last(zeta, xi, gap, k, Y, V, settle, section):
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=gap, damping_ratio=xi)
        scene = scene.at_section(section)
        run = vi.simulate(scene, scene.start(Y=Y, V=V), 1, settle=settle, method=method, rests=True)
        return run.last, run.successful

    state, good = vi.jit(jax.vmap(last))(*map(jnp.asarray, (*numbers, settle, section)))
    wanted = np.array([truth(name, CORNERS[name][cycles]) for name in names]).T
    found = np.stack([state.Y, state.V])
    off = np.abs(found - wanted) / (1 + np.abs(wanted))
    assert bool(good.all()), [name for name, x in zip(names, good, strict=True) if not x]
    return dict(zip(names, off.max(axis=0).tolist(), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "close"),
    [(vi.ExactFlight(), 1e-10), (vi.FixedStep(), 1e-7), (vi.Adaptive(rtol=1e-11), 1e-9)],
    ids=["exact", "fixed", "adaptive"],
)
def test_corners(method, close):
    found = errors(method, 6)
    assert max(found.values()) < close, found


@pytest.mark.slow
@pytest.mark.parametrize("method", [vi.ExactFlight(), vi.FixedStep(), vi.Adaptive(rtol=1e-5)])
def test_corners_in_single_precision(method):
    """Near resonance and for k → 1, nothing damps the errors, so they grow."""
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="vi_jax is running in single precision")
        found = errors(method, 7)
    assert max(found.values()) < 1e-4, found


def test_error_is_at_most_ten_tolerances():
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.05)
    exact = vi.simulate(scene, scene.start(), 20, method=vi.ExactFlight()).last
    rtol = 10.0 ** -np.arange(1, 16)
    found = jax.vmap(lambda r: vi.simulate(scene, scene.start(), 20, method=vi.Adaptive(rtol=r)))(
        jnp.asarray(rtol)
    )
    off = np.maximum(abs(found.last.Y - exact.Y), abs(found.last.V - exact.V))
    assert (off <= 10 * np.maximum(rtol, 1e-13)).all(), off


@pytest.mark.slow
@pytest.mark.parametrize("method", [vi.ExactFlight(), vi.FixedStep(), vi.Adaptive(rtol=1e-11)])
def test_narrow_gap_between_stops(method):
    """Two stops are 1e-6 apart, and the body rests twice in each cycle."""
    stops = vi.RigidStop(0.3, 0.5), vi.RigidStop(-0.3 + 1e-6, 0.5, "left")
    scene = vi.Scene(0.05, vi.IdealDrive(0.5), stops=stops)
    run = vi.simulate(scene, scene.start(Y=0.3 - 5e-7), 4, settle=4, method=method)
    assert bool(run.successful) and bool((run.rests == 2).all())
    assert float(jnp.maximum(run.y_max - 0.3, 0.3 - 1e-6 - run.y_min).max()) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "double", "close"),
    [
        (vi.ExactFlight(), True, 1e-9),
        (vi.FixedStep(steps_per_cycle=20), True, 1e-9),
        (vi.ExactFlight(), False, 1e-4),
    ],
)
def test_errors_do_not_grow_with_the_number_of_cycles(method, double, close):
    """Compare with the stable 4π orbit after 10³ and 10⁵ cycles."""
    with jax.enable_x64(double), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="vi_jax is running in single precision")
        scene = vi.Scene.ideal(frequency_ratio=0.9)
        closed = vi.closed_form_orbits(scene, cycles=2)
        start = scene.start(Y=closed.Y[0], V=closed.V[0])
        off = []
        for cycles in (10**3, 10**5):
            last = vi.simulate(scene, start, 2, settle=cycles, method=method).last
            off.append(max(abs(float(last.Y - start.Y)), abs(float(last.V - start.V))))
    assert off[1] <= min(close, 3 * off[0] + (1e-14 if double else 1e-6))
