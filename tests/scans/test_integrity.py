"""Integrity profiles: the integrity of motions over a parameter."""

import matplotlib
import numpy as np
import pytest
import vi_jax as vi

matplotlib.use("Agg")

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.8, gap=2.0, damping_ratio=0.05)
ZETA = "drive.frequency_ratio"
REGION = {"start.Y": (-6.0, 2.0), "start.V": (-6.0, 9.0)}
QUICK = {"resolution": (14, 12), "settle": 400, "longest": 8, "progress": False}


@pytest.fixture(scope="module")
def profile():
    return vi.integrity_profile(SCENE, ZETA, [1.5, 1.3, 1.4, 0.9], REGION, **QUICK)


@pytest.mark.slow
def test_motions_are_followed_along_the_values(profile):
    assert profile.values.tolist() == [0.9, 1.3, 1.4, 1.5]
    names = [profile.name_of(i) for i in range(3)]
    assert names == ["2π, 1 impact", "4π, 1 impact", "2π, 0 impacts"]
    hit, long, free = profile.share
    assert hit[0] == 0 and (np.diff(hit[1:]) < 0).all()  # ever fewer starts lead to impacts
    assert long.tolist() == [1.0, 0.0, 0.0, 0.0]
    assert free[0] == 0 and (np.diff(free[1:]) > 0).all()
    np.testing.assert_allclose(profile.share.sum(axis=0), 1.0)
    assert profile.label.tolist()[1] == [0, -1, -1, -1]
    assert np.isnan(profile.local[1, 1:]).all() and np.isfinite(profile.local[0, 1:]).all()
    for i, found in enumerate(profile.basins):
        for reach in found.integrity():
            motion = int(np.flatnonzero(profile.label[:, i] == reach.label)[0])
            assert profile.local[motion, i] == reach.local
            assert profile.factor[motion, i] == reach.factor
            assert profile.factor_at_edge[motion, i] == reach.factor_at_edge


def test_an_edge_at_a_stop_does_not_limit_a_ball(profile):
    """The region ends at the stop, Y = 2, close to the motion with one impact."""
    label = profile.basins[0].data["label"]
    assert label.attrs["at_stop"] == ["start.Y high"]
    there = profile.basins[2].attractors[0]
    assert there.impacts == 1 and 2.0 - there.sections["Y"][0] < profile.local[0, 2]
    assert not profile.local_at_edge[0, 2]


def test_other_numbers_do_not_recompile(profile, compilations):
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.75, gap=2.0, damping_ratio=0.04)
    region = {"start.Y": (-5.0, 2.0), "start.V": (-6.0, 5.0)}
    other = vi.integrity_profile(scene, ZETA, [0.92, 1.32, 1.42, 1.48], region, **QUICK)
    assert not compilations and other.share.shape[1] == 4


def test_a_profile_as_data_text_and_picture(profile):
    data = profile.to_xarray()
    assert data.share.dims == ("motion", ZETA) and data.local.shape == (3, 4)
    np.testing.assert_array_equal(data.factor.sel({ZETA: 1.4}), profile.factor[:, 2])
    assert len(profile.to_xarray(along="motion").to_dataframe()) == 3
    text = str(profile)
    assert text.startswith(f"Integrity over {ZETA}, 4 values from 0.9 to 1.5: 3 motions")
    assert "4π, 1 impact, 0.9 to 0.9: at most 100.0 % at 0.9" in text
    for y, word in (("share", "part of the starts"), ("local", "around"), ("factor", "ball")):
        ax = vi.plot_integrity(profile, y=y)
        lines = [x for x in ax.get_lines() if len(x.get_xdata()) == 4 and x.get_ls() == "-"]
        drawn = np.array([x.get_ydata() for x in lines])
        np.testing.assert_allclose(drawn, getattr(profile, y) * (100 if y == "share" else 1))
        assert word in ax.get_ylabel() and "ζ" in ax.get_xlabel()
        assert "2π, 1 impact" in [x.get_text() for x in ax.get_legend().get_texts()]
    with pytest.raises(ValueError, match="`y` must be one of"):
        vi.plot_integrity(profile, y="area")


def test_invalid_arguments_raise():
    def ask(values=(0.9, 1.0), region=REGION, **options):
        return vi.integrity_profile(SCENE, ZETA, values, region, **{**QUICK, **options})

    with pytest.raises(ValueError, match="one row of finite real numbers"):
        ask([np.nan])
    with pytest.raises(ValueError, match="`scales` must name"):
        ask(scales={"start.W": 1.0})
    with pytest.raises(ValueError, match="`resolution` must be at least 2"):
        ask(resolution=1)
    with pytest.raises(TypeError, match="`samples` must not be given"):
        ask(samples=100)
    with pytest.raises(ValueError, match="frequency"):
        vi.integrity_profile(SCENE, "drive.frequency", [0.9], REGION)
