"""Symmetric machines: points where motions lose their symmetry, and the branches from there."""

import dataclasses

import jax
import numpy as np
import pytest
import vi_jax as vi
from scipy.optimize import brentq

M = vi.machines


def between(left=1.2, restitution=0.9):
    """The paper's scene between two stops."""
    ideal = vi.Scene.ideal(frequency_ratio=1.5, damping_ratio=0.03, gap=1.2, restitution=0.9)
    return dataclasses.replace(
        ideal, stops=(*ideal.stops, vi.RigidStop(left, restitution, "left"))
    )  # fmt: skip


def settled(machine, start=None, cycles=1):
    start = machine.start() if start is None else start
    return vi.find_orbit(
        machine, vi.simulate(machine, start, 1, settle=500).last, cycles, throw=True
    )


def kinds(branch):
    return [point.kind for point in branch.special]


def test_a_scene_is_its_own_image_between_equal_stops():
    scene = between()
    image = scene.mirrored(scene.start(Y=0.3, V=-0.1))
    assert (float(image.Y), float(image.V)) == (-0.3, 0.1)
    assert between(left=1.3).mirrored(scene.start()) is None
    assert between(restitution=0.8).mirrored(scene.start()) is None
    crank = dataclasses.replace(scene, crank=vi.SliderCrank(0.2))
    assert crank.mirrored(scene.start()) is None
    free = dataclasses.replace(scene, stops=())
    assert free.mirrored(scene.start()) is not None
    soft = vi.SoftStop(1.0, 20.0, restitution=0.5)
    both = (soft, dataclasses.replace(soft, side="left"))
    assert dataclasses.replace(free, soft_stops=both).mirrored(scene.start()) is not None
    assert dataclasses.replace(free, soft_stops=both[:1]).mirrored(scene.start()) is None


@pytest.fixture(scope="module")
def whole():
    scene = between()
    return vi.continue_orbit(
        settled(scene), parameter="drive.frequency_ratio", bounds=(0.3, 2.5)
    )  # fmt: skip


@pytest.mark.slow
def test_a_scene_between_equal_stops_loses_its_symmetry(whole):
    assert kinds(whole) == ["grazing", "symmetry-breaking", "symmetry-breaking"]
    point = whole.special[1]
    broken = vi.continue_orbit(
        point.switch(), parameter="drive.frequency_ratio", bounds=(0.3, 2.5)
    )  # fmt: skip
    (spring,) = (p for p in broken.special if p.kind == "symmetry-breaking")
    assert min(abs(spring.parameter - p.parameter) for p in whole.special[1:]) < 1e-8
    assert "symmetry-breaking" in broken.ends and "fold" not in kinds(broken)[-1:]


@pytest.mark.slow
def test_a_curve_of_symmetry_breaking_of_a_scene(whole):
    """Each motion has a multiplier 1. Simulations of both ends are symmetric."""
    curve = vi.boundary(
        whole.special[1], parameter="damping_ratio", bounds=((0.3, 2.5), (0.0, 0.1))
    )  # fmt: skip
    assert len(np.unique(curve.parameters, axis=0)) == len(curve.parameters) > 8
    assert (curve.parameters[[0, -1], 1] == 0).all()
    assert abs(curve.multipliers - 1).min(axis=1).max() < 1e-8
    for i in (0, -1):
        orbit = curve.orbit(i)
        run = vi.simulate(orbit.machine, orbit.state, 1, samples=2, method="reference")
        half = jax.tree.map(lambda x: float(x[1]), run.samples.state)
        assert half.Y == pytest.approx(-float(orbit.state.Y), abs=1e-9)
        assert half.V == pytest.approx(-float(orbit.state.V), abs=1e-9)
    with pytest.raises(ValueError, match="symmetry"):
        vi.boundary(
            whole.special[1], parameter="stops.0.gap", bounds=((0.3, 2.5), (1.0, 1.3))
        )  # fmt: skip


@pytest.fixture(scope="module")
def lost():
    """Return the point at which the ball in a box loses its symmetry."""
    pair = M.ImpactPair(half_gap=1.35, restitution=0.5)
    branch = vi.continue_orbit(settled(pair), parameter="half_gap", bounds=(1.25, 1.5))
    (point,) = branch.special
    return point


@pytest.mark.slow
@pytest.mark.parametrize(("max_step", "distance"), [(0.1, 0.005), (0.4, 0.03)])
def test_a_branch_of_asymmetric_motions_ends_only_at_its_origin(lost, max_step, distance):
    """With these steps a branch may be cut, or special points missed or listed twice."""
    broken = vi.continue_orbit(
        lost.switch(distance=distance), parameter="half_gap", bounds=(1.05, 6.0),
        max_step=max_step,
    )  # fmt: skip
    assert kinds(broken) == ["symmetry-breaking"]
    assert broken.ends == ("bounds", "symmetry-breaking")
    assert broken.parameter.min() == pytest.approx(1.05)
    # Phases of the impacts of the stable motion at 1.055, by an independent map from wall to wall.
    (low,) = (orbit for orbit in broken.at(1.055) if bool(orbit.stable))
    phases = np.sort(np.asarray(low.impact_phase))
    apart = min(np.abs(phases - np.sort(x)).max() for x in ([5.7715, 1.5624], [2.6299, 4.7040]))
    assert apart < 2e-4


def gap_of(e):
    """Return the half gap at which a ball of restitution e loses its symmetry."""
    return (np.pi / 2 - 2 / np.pi) / np.hypot(2 / np.pi, (1 - e) / (1 + e))


def overshoot(e):
    """Return how far beyond the wall that it left the ball would come on its return. It flies with
    the speed w between the walls; sin s₀ = π w/2 - λ and cos s₀ = -σ w at the wall."""
    share, gap = (1 - e) / (1 + e), gap_of(e)
    w = np.roots([np.pi**2 / 4 + share**2, -np.pi * gap, gap**2 - 1]).max()
    begin = np.arctan2(np.pi * w / 2 - gap, -share * w)
    turn = (-np.arccos(-w) - begin) % (2 * np.pi)
    return np.sin(begin) - w * turn - np.sin(begin + turn)


@pytest.mark.slow
def test_grazings_end_where_the_motion_becomes_symmetric(lost):
    broken = vi.continue_orbit(lost.switch(distance=0.03), parameter="half_gap", bounds=(0.8, 6.0))
    bounds = ((0.5, 2.0), (0.0, 1.0))
    curve = vi.boundary(broken.special[0], parameter="restitution", bounds=bounds)
    assert curve.ends == ("symmetry-breaking", "bounds")
    assert curve.parameters[-1, 1] == 1.0  # no machine has a larger restitution
    end = curve.special[0]
    assert end.kind == "symmetry-breaking"
    e = brentq(overshoot, 0.05, 0.1, xtol=1e-14)
    np.testing.assert_allclose(end.parameters, [gap_of(e), e], atol=1e-9)
    other = vi.boundary(end.switch(), parameter="restitution", bounds=bounds)
    gaps, shares = other.parameters.T
    np.testing.assert_allclose(gaps, gap_of(shares), atol=1e-12)
    assert other.ends == ("grazing", "bounds")


SNAP = M.Duffing(
    amplitude=0.8, frequency=1.3, damping=0.1, stiffness=-1.0, cubic=1.0, gap=1.2, restitution=0.8
)


@pytest.mark.slow
def test_a_motion_without_impacts_loses_its_symmetry():
    """Near a branch point the equations may have no solution, or that of the other branch."""
    orbit = vi.find_orbit(SNAP, SNAP.start(Y=-0.305011053, V=0.0199429225), throw=True)
    options = {"parameter": "amplitude", "bounds": (0.05, 2.0)}
    for max_step in (0.05, 0.15):
        branch = vi.continue_orbit(orbit, **options, max_step=max_step)
        assert kinds(branch) == ["symmetry-breaking", "fold", "grazing"]
        assert branch.special[0].parameter == pytest.approx(1.752976613, abs=2e-8)
