"""Codimension-two points of oscillators with a stop, compared with closed forms and shooting."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.orbit import codimension_two as module
from vi_jax.orbit.touch import NoLocalMapError

from grazings import grazing_of

pytestmark = pytest.mark.slow


def only(curve, kind):
    (point,) = (point for point in curve.special if point.kind == kind)
    return point


# ω* = 2√(1 - ζ²) at ζ = 0.05, and the coefficients of both curves there (from 40 digits).
MEETS, FOLD, DOUBLING = 1.99749843554, -33.9869, 2.443565


def grazing_force(omega):
    """Return F at which x'' + 0.1x' + x = F cos ωt just reaches x = 1."""
    return np.hypot(1 - omega**2, 0.1 * omega)


def coefficient_at(omega, curve, reach):
    """Return c of F = F_graze (1 + c (ω - ω*)²), fitted to points of a curve near ω*."""
    near = np.abs(curve.parameters[:, 1] - omega)
    near = curve.parameters[(near > 1e-3) & (near < reach)]
    away = near[:, 1] - omega
    assert len(away) > 6
    share = (near[:, 0] / grazing_force(near[:, 1]) - 1) / away**2
    return np.polynomial.Polynomial.fit(away, share, 5)(0.0)


@pytest.mark.parametrize(
    ("kind", "frequency", "coefficient"),
    [
        pytest.param("fold", 1.95, FOLD, marks=pytest.mark.exhaustive),
        ("period-doubling", 2.04, DOUBLING),
    ],
)
def test_a_fold_and_a_doubling_graze_where_a_grazing_is_resonant(kind, frequency, coefficient):
    """For x'' + 0.1x' + x = F cos ωt with k = 0.8, the motion with one impact per cycle folds on
    one side of ω* and doubles on the other, at F = F_graze (1 + c (ω - ω*)²)."""
    machine = vi.machines.Duffing(
        amplitude=0.9 * grazing_force(frequency), frequency=frequency, damping=0.1, gap=1.0,
        restitution=0.8, two_sided=False,
    )  # fmt: skip
    point = grazing_of(machine, "amplitude", (0.5, 5.0))
    branch = vi.continue_orbit(point.switch(), parameter="amplitude", bounds=(0.5, 5.0))
    (special,) = (point for point in branch.special if point.kind == kind)
    bounds = ((0.5, 5.0), (1.8, 2.2))
    curve = vi.boundary(special, parameter="frequency", bounds=bounds, max_step=0.01)
    assert "grazing" in curve.ends
    end = only(curve, "grazing")
    np.testing.assert_allclose(end.parameters, [grazing_force(MEETS), MEETS], atol=1e-8)
    assert "is lost" in end.detail and end.impact == 0
    assert coefficient_at(MEETS, curve, 3e-2) == pytest.approx(coefficient, rel=1e-4)
    other = vi.boundary(end.switch(), parameter="frequency", bounds=bounds)
    assert other.kind == "grazing"
    force, omega = other.parameters.T
    np.testing.assert_allclose(force, grazing_force(omega), rtol=1e-11)
    meets = only(other, "resonant-grazing")
    np.testing.assert_allclose(meets.parameters, [grazing_force(MEETS), MEETS], atol=1e-10)
    assert meets.detail.endswith("with one impact in 1 period")


def test_resonant_grazings_of_a_linear_oscillator(monkeypatch):
    """eₙ ∝ sin(2πn ω_d/ω) vanishes at ω = 2n ω_d/m, with the damped frequency ω_d. A motion of n
    cycles begins there if all earlier entries are positive."""
    damped = np.sqrt(1 - 0.05**2)
    machine = vi.machines.Duffing(
        amplitude=0.01, frequency=1.9, damping=0.1, gap=1.0, restitution=0.8, two_sided=False
    )
    point = grazing_of(machine, "amplitude", (0.005, 5.0))
    curve = vi.boundary(point, parameter="frequency", bounds=((0.001, 5.0), (0.6, 2.2)))
    found = [point for point in curve.special if point.kind == "resonant-grazing"]
    wanted = []
    for n in (1, 2, 3):
        for m in range(1, 12):
            frequency = 2 * n * damped / m
            before = np.sin(2 * np.pi * np.arange(1, n) * damped / frequency)
            if 0.6 < frequency < 2.2 and (before > 1e-6).all():
                wanted.append((n, frequency))
    assert len(wanted) == len(found) == 5
    for point, w in zip(
        sorted(found, key=lambda x: x.parameters[1]), sorted(w for _, w in wanted), strict=True
    ):
        amplitude, frequency = point.parameters
        assert frequency == pytest.approx(w, abs=1e-12)
        # There the motion without impacts has the gap, 1, as its amplitude.
        swing = np.hypot(1 - frequency**2, 0.1 * frequency)
        assert amplitude == pytest.approx(swing, rel=1e-10)

    part = curve.steps[:100]
    within = [p for p in found if p.parameters[1] < part[-1].x[-2]]
    assert 1 < len(within) < len(found)

    def without_first(point):
        if np.array_equal(point.parameters, curve.parameters[0]):
            raise NoLocalMapError("Argument `point` must be a grazing at which the motion turns.")
        return graze_at(point)

    # One step without a local map does not hide the others.
    graze_at = module.graze_at
    monkeypatch.setattr(module, "graze_at", without_first)
    again = module.points_of(curve.problem, part, curve.ends)
    assert [point.parameters[1] for point in again] == [p.parameters[1] for p in within]

    # Nor does a test that is exactly zero at a step.
    resonance = module.LocalMap.resonance
    rounded = lambda *given: x if abs(x := resonance(*given)) > 1e-12 else 0.0
    monkeypatch.setattr(module, "graze_at", graze_at)
    monkeypatch.setattr(module.LocalMap, "resonance", rounded)
    exact = [step for _, step, _ in module._resonant_grazings(curve.problem, None, part)]
    steps = sorted([*part, *exact], key=lambda step: step.x[-2])
    again = module.points_of(curve.problem, steps, curve.ends)
    assert len([point for point in again if point.kind == "resonant-grazing"]) == len(within)


@pytest.mark.parametrize(
    ("to", "frequency", "force", "speed"),
    [
        pytest.param("fold", 0.799, 0.362836201981, 0.124087344853, marks=pytest.mark.exhaustive),
        ("period-doubling", 0.81, 0.347533397412, 0.065303943337),
    ],
)
def test_curves_that_leave_a_resonant_grazing(to, frequency, force, speed):
    """Compare the motion with one impact in two periods (Ghosh and Simpson, arXiv 2510.16218) with
    a shooting code in 40 digits."""
    machine = vi.machines.Duffing(
        amplitude=0.36, frequency=0.79, damping=0.04, gap=1.0, restitution=0.9, two_sided=False
    )
    bounds = ((0.78, 0.85), (0.25, 0.45))
    point = grazing_of(machine, "frequency", bounds[0])
    resonant = only(vi.boundary(point, parameter="amplitude", bounds=bounds), "resonant-grazing")
    wanted = 0.7998399840, 0.361673852989
    np.testing.assert_allclose(resonant.parameters, wanted, atol=1e-10)
    curve = vi.boundary(resonant.switch(to), parameter="amplitude", bounds=bounds)
    assert curve.kind == to and curve.cycles == 2
    (orbit,) = curve.at(frequency)
    assert float(orbit.machine.amplitude) == pytest.approx(force, abs=1e-11)
    assert float(orbit.impact_speed[0]) == pytest.approx(speed, abs=1e-10)
    ends = [at for at in curve.special if at.kind == "grazing" and "is lost" in at.detail]
    np.testing.assert_allclose(ends[0].parameters, wanted, atol=1e-9)
    with pytest.raises(ValueError, match="`to` must be one of 'fold', 'period-doubling'"):
        resonant.switch("grazing")


class Two(vi.Mechanical):
    """Two masses on springs. The first one is driven and has a stop at 1."""

    q = ("x", "y")
    mass = (1.0, 0.5)
    amplitude: float = 0.5
    frequency: float = 1.05

    @property
    def cycle(self):
        return 2 * np.pi / self.frequency

    @property
    def contacts(self):
        return (vi.RigidStop(1.0, 0.8, on="x"),)

    def force(self, t, q, v):
        pull = 0.3 * (q.y - q.x) + 0.05 * (v.y - v.x)
        drive = self.amplitude * jnp.cos(self.frequency * t)
        return {"x": pull - q.x - 0.1 * v.x + drive, "y": -pull}


@pytest.mark.exhaustive
def test_folds_and_doublings_of_a_larger_machine_begin_at_different_points():
    """With four state components, they leave the curve of grazings at different points. A curve
    that starts with a slow impact ends at the same point."""
    bounds = ((0.001, 20.0), (0.93, 1.05))
    point = grazing_of(Two(), "amplitude", bounds[0])
    grazings = vi.boundary(point, parameter="frequency", bounds=bounds)
    resonant = [point for point in grazings.special if point.kind == "resonant-grazing"]
    found = sorted((point.parameters[1], point.detail) for point in resonant)
    assert [detail.replace("a curve of ", "") for _, detail in found] == [
        "folds begins of the motion with one impact in 2 periods",
        "period doublings begins of the motion with one impact in 1 period",
    ]
    for point in resonant:
        to = "fold" if "folds" in point.detail else "period-doubling"
        # So near the grazing the largest multiplier is some 7,000.
        curve = vi.boundary(point.switch(to, distance=1e-5), parameter="frequency", bounds=bounds)
        multiplier = 1 if to == "fold" else -1
        assert np.nanmax(np.abs(curve.multipliers - multiplier).min(axis=1)) < 1e-10
        off = [np.abs(at.parameters - point.parameters).max() for at in curve.special]
        assert curve.kind == to and min(off) < 1e-11
        also = "fold-flip" if to == "fold" else "degenerate-doubling"
        assert sorted(at.kind for at in curve.special) == sorted([also, "grazing"])
        if to == "period-doubling":
            with pytest.raises(ValueError, match="No fold of a motion with one impact"):
                point.switch("fold")


def test_a_fold_that_touches_the_stop():
    """The gap there is the greatest position of the motion without a stop."""
    machine = vi.machines.Duffing(
        amplitude=0.1, frequency=1.4, damping=0.1, cubic=0.1, gap=8.0, two_sided=False
    )
    orbit = vi.find_orbit(machine, machine.start(), throw=True)
    branch = vi.continue_orbit(orbit, parameter="amplitude", bounds=(0.05, 2.0))
    folds = [point for point in branch.special if point.kind == "fold"]
    assert len(folds) == 2
    bent = max(folds, key=lambda point: float(point.orbit.y_max))
    high, force = float(bent.orbit.y_max), bent.parameter
    curve = vi.boundary(bent, parameter="gap", bounds=((0.05, 2.0), (1.0, 10.0)))
    end = only(curve, "grazing")
    np.testing.assert_allclose(end.parameters, [force, high], atol=1e-9)
    assert end.impact is None and "touches a stop" in end.detail
    touches = vi.boundary(end.switch(), parameter="gap", bounds=((0.05, 2.0), (0.5, 6.0)))
    assert touches.kind == "grazing"
    folds = [point for point in touches.special if point.kind == "fold"]
    assert min(np.abs(point.parameters - end.parameters).max() for point in folds) < 1e-8
    back = vi.boundary(folds[0].switch(), parameter="gap", bounds=((0.05, 2.0), (0.5, 10.0)))
    assert back.kind == "fold"
