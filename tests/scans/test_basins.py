"""Basins of attraction, compared with orbits, single runs and SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from belts import Belt

# Several motions coexist here; see `experiments/studies/basins_map.py`.
SCENE = vi.Scene.ideal(frequency_ratio=3.2, restitution=0.9, gap=1.05, damping_ratio=0.01)
REGION = {"start.Y": (-3.5, 1.05), "start.V": (-4.0, 4.0)}


@pytest.fixture(scope="module")
def found():
    return vi.basins(SCENE, REGION, resolution=(24, 20), settle=1500)


@pytest.mark.slow
def test_motions_are_orbits(found):
    assert len(found.attractors) >= 2
    for attractor in found.attractors[:2]:
        start = SCENE.start(**{name: x[0] for name, x in attractor.sections.items()})
        orbit = vi.find_orbit(SCENE, start, cycles=attractor.period)
        assert bool(orbit.stable) and int(orbit.cycles) == attractor.period
        assert len(attractor.sections["Y"]) == attractor.period
        assert float(orbit.state.Y) == pytest.approx(attractor.sections["Y"][0], abs=1e-4)


def test_labels_agree_with_the_ends_of_runs(found):
    rng = np.random.default_rng(0)
    labels = np.asarray(found.data.label)
    assert min(a.starts for a in found.attractors[:2]) > 20
    lanes = [rng.choice(np.argwhere(labels == label), 3) for label in (0, 1)]
    for i, j in np.concatenate(lanes):
        lane = found.data.isel({"start.Y": i, "start.V": j})
        start = SCENE.start(Y=float(lane["start.Y"]), V=float(lane["start.V"]))
        run = vi.simulate(SCENE, start, 1, settle=3000, method=vi.ExactFlight())
        end = np.array([float(run.sections.Y[-1]), float(run.sections.V[-1])])
        distance = [
            np.abs(np.stack([a.sections["Y"], a.sections["V"]]) - end[:, None]).max(0).min()
            for a in found.attractors
        ]
        assert int(np.argmin(distance)) == labels[i, j] and min(distance) < 1e-3


def test_regimes_have_one_code(found):
    """Periods of scans and sweeps and labels of basins use the same codes."""
    free = vi.Scene.ideal(frequency_ratio=0.77, gap=None)  # undamped: not periodic
    swept = vi.sweep(free, "drive.frequency_ratio", [0.77], start=free.start(Y=0.3), settle=5)
    assert int(swept.period[0]) == vi.REGIMES.unsettled
    assert str(swept).endswith("no period, or unsettled from 0.77 ω")
    flags = [found.data[x].attrs["flag_values"] for x in ("period", "label")]
    assert flags[0] == flags[1] == sorted(vi.REGIMES) and max(vi.REGIMES) < 0
    beyond = vi.basins(SCENE, {"start.Y": (0.05, 2.05)}, resolution=4, settle=200)
    for x in (beyond.data.label, beyond.data.period):
        assert np.asarray(x)[-2:].tolist() == [vi.REGIMES.failed] * 2


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


def test_basins_as_data(found):
    motions = found.to_xarray(along="motion").to_dataframe()
    assert motions.motion_fraction.tolist() == [a.fraction for a in found.attractors]
    share, starts = motions.motion_fraction, found.data.label.size
    binomial = np.sqrt(share * (1 - share) / starts)
    np.testing.assert_allclose([a.error for a in found.attractors], binomial, rtol=1e-12)
    orbits = found.to_xarray(along="cycle")
    for i, a in enumerate(found.attractors):
        np.testing.assert_array_equal(orbits.motion_Y[i, : a.period], a.sections["Y"])
    assert len(found.to_xarray(along="start.V").to_dataframe()) == found.data.label.size


def test_invalid_regions_raise():
    with pytest.raises(ValueError, match="ranges"):
        vi.basins(SCENE, {"start.Y": (1.0, -1.0)})
    with pytest.raises(ValueError, match="numbers of the start"):
        vi.basins(SCENE, {"drive.frequency_ratio": (0.5, 1.0)})
    with pytest.raises(ValueError, match="one number or 2"):
        vi.basins(SCENE, REGION, resolution=(3, 3, 3))


@pytest.mark.slow
def test_the_share_of_steady_sliding_agrees_with_its_area():
    """The unstable cycle of sliding encloses 0.30712 of the area of starts, by SciPy's ∫ V² dt
    along it. No start fails, although all that slide come to rest."""
    region = {"start.Y": (-2.0, 2.0), "start.V": (0.0, 2.0)}
    found = vi.basins(Belt(1.5), region, resolution=24, settle=200, progress=False)
    assert not any(found.irregular.values())
    (share,) = (x.fraction for x in found.attractors if abs(x.sections["Y"][0] - 0.5249) < 1e-3)
    # The boundary cuts about 55 of 24² cells, with an error of 0.3 cells each; allow 3 sigma.
    assert share == pytest.approx(0.30712, abs=3 * 0.3 * 55**0.5 / 24**2)


class Pipe(vi.AbstractMachine):
    """A level with a controller that reads it late. Units: m, s."""

    cycle = 60.0
    delays = property(lambda self: dict(pipe=22.0))

    def field(self, t, z, past):
        return dict(h=0.003 * jnp.cos(2 * jnp.pi * t / 60) - 0.04 * past.pipe.h)


def test_printed_basins_of_a_chain_do_not_list_its_history():
    chain = vi.delay_chain(Pipe(), nodes=4, start=vi.State(h=0.0))
    region = {"start.h": (-0.1, 0.1)}
    found = vi.basins(chain, region, resolution=2, start=chain.start(), settle=20, progress=False)
    assert "h = -0.0127" in str(found) and "history" not in str(found)
