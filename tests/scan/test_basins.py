"""Basins against motions known from elsewhere, and against the starts' own symmetry."""

import numpy as np
import pytest
import vi_jax as vi

# Several motions live side by side here; see `experiments/studies/all_orbits.py`.
SCENE = vi.Scene.ideal(frequency_ratio=3.2, restitution=0.9, gap=1.05, damping_ratio=0.01)
REGION = {"start.Y": (-3.5, 1.05), "start.V": (-4.0, 4.0)}


@pytest.fixture(scope="module")
def found():
    return vi.basins(SCENE, REGION, resolution=(24, 20), settle=1500)


@pytest.mark.slow
def test_motions_are_orbits(found):
    assert len(found.attractors) >= 2
    for attractor in found.attractors:
        start = SCENE.start(**{name: x[0] for name, x in attractor.sections.items()})
        orbit = vi.find_orbit(SCENE, start, cycles=attractor.period)
        assert bool(orbit.stable) and int(orbit.cycles) == attractor.period
        assert len(attractor.sections["Y"]) == attractor.period
        assert float(orbit.state.Y) == pytest.approx(attractor.sections["Y"][0], abs=1e-4)


def test_starts_belong_where_they_end(found):
    rng = np.random.default_rng(0)
    for i, j in zip(rng.integers(24, size=6), rng.integers(20, size=6), strict=True):
        lane = found.data.isel({"start.Y": i, "start.V": j})
        label = int(lane.label)
        start = SCENE.start(Y=float(lane["start.Y"]), V=float(lane["start.V"]))
        run = vi.simulate(SCENE, start, 1, settle=3000, method=vi.ExactFlight())
        end = np.array([float(run.sections.Y[-1]), float(run.sections.V[-1])])
        distance = [
            np.abs(np.stack([a.sections["Y"], a.sections["V"]]) - end[:, None]).max(0).min()
            for a in found.attractors
        ]
        if label >= 0:
            assert int(np.argmin(distance)) == label and min(distance) < 1e-3


@pytest.mark.slow
def test_fractions_add_up_and_random_starts_agree(found):
    total = sum(a.fraction for a in found.attractors) + sum(found.irregular.values())
    assert total == pytest.approx(1.0)
    starts = [a.starts for a in found.attractors]
    assert starts == sorted(starts, reverse=True)
    random = vi.basins(SCENE, REGION, samples=600, seed=1, settle=1500)
    assert random.data.label.dims == ("sample",)
    for a, b in zip(found.attractors[:2], random.attractors[:2], strict=True):
        assert a.period == b.period
        assert abs(a.fraction - b.fraction) < 4 * (a.error**2 + b.error**2) ** 0.5
    assert "±" in str(random)


def test_starts_beyond_a_stop_are_failed():
    found = vi.basins(SCENE, {"start.Y": (0.05, 2.05)}, resolution=4, settle=200)
    assert np.asarray(found.data.label)[-2:].tolist() == [-3, -3]


def test_bad_regions():
    with pytest.raises(ValueError, match="ranges"):
        vi.basins(SCENE, {"start.Y": (1.0, -1.0)})
    with pytest.raises(ValueError, match="parts of the start"):
        vi.basins(SCENE, {"drive.frequency_ratio": (0.5, 1.0)})
    with pytest.raises(ValueError, match="one number or 2"):
        vi.basins(SCENE, REGION, resolution=(3, 3, 3))
