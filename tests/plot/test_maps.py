"""Cells, motions and legends of maps agree with the data."""

import matplotlib

matplotlib.use("Agg")

import numpy as np
import pytest
import vi_jax as vi
import xarray as xr
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from vi_jax.plot.colors import color_of

PERIODS = np.array([[1, 2, 8], [9, 64, -2], [-1, -3, 1], [-4, -1, 2]])


IRREGULAR = {"chaotic": 0.1, "unsettled": 0.0, "failed": 0.1, "transient": 0.1}


def _axes():
    return Figure().subplots()


def _data(period=PERIODS, x=(0.5, 0.7, 0.9, 1.1), y=(0.1, 0.2, 0.3), result=None):
    result = np.zeros_like(period) if result is None else result
    dims = ("drive.frequency_ratio", "stops.0.restitution")
    return xr.Dataset(
        {"period": (dims, period.astype(np.int16)), "result": (dims, result.astype(np.int8))},
        coords={dims[0]: np.array(x), dims[1]: np.array(y)},
    )


def _cells(ax):
    """Return the colours of the cells by column and row, and the mesh."""
    (mesh,) = ax.collections
    mesh.update_scalarmappable()
    rows, columns = mesh.get_array().shape
    return mesh.get_facecolors().reshape(rows, columns, 4)[..., :3].transpose(1, 0, 2), mesh


def _legend(ax):
    legend = ax.get_legend()
    return {
        text.get_text(): to_rgb(patch.get_facecolor()[:3])
        for text, patch in zip(legend.get_texts(), legend.legend_handles, strict=True)
        if isinstance(patch, Patch)
    }


def test_regimes_have_the_colours_of_the_legend():
    ax = _axes()
    assert vi.plot_regimes(_data(), ax=ax) is ax
    names = {1: "2π", 2: "4π", 8: "16π", 9: "> 16π", 64: "> 16π"}
    names |= {regime: regime.meaning for regime in vi.REGIMES}
    cells, _ = _cells(ax)
    legend = _legend(ax)
    wanted = ["2π", "4π", "16π", "> 16π", "unsettled", "transiently chaotic", "chaotic", "failed"]
    assert list(legend) == wanted
    assert len(set(legend.values())) == len(legend)
    for place, period in np.ndenumerate(PERIODS):
        np.testing.assert_allclose(cells[place], legend[names[period]])
    assert ax.get_xlabel() == "frequency ratio ζ" and ax.get_ylabel() == "restitution k"


def test_regimes_lie_around_their_values():
    shuffled = _data(PERIODS[[2, 0, 3, 1]], x=(0.9, 0.5, 1.1, 0.7))
    (cells, mesh), (others, _) = (
        _cells(vi.plot_regimes(_data(), ax=_axes())),
        _cells(vi.plot_regimes(shuffled, ax=_axes())),
    )
    np.testing.assert_array_equal(cells, others)
    edges = mesh.get_coordinates()
    np.testing.assert_allclose(edges[0, :, 0], [0.4, 0.6, 0.8, 1.0, 1.2])
    np.testing.assert_allclose(edges[:, 0, 1], [0.05, 0.15, 0.25, 0.35])


def test_axes_by_name_single_rows_and_missing_cells():
    turned = vi.plot_regimes(_data(), ax=_axes(), x="stops.0.restitution", legend=False)
    assert turned.get_legend() is None
    straight, _ = _cells(vi.plot_regimes(_data(), ax=_axes()))
    np.testing.assert_array_equal(_cells(turned)[0], straight.transpose(1, 0, 2))
    assert turned.get_xlabel() == "restitution k"
    one = _data(PERIODS[:, :1], y=(0.4,), result=np.array([[0], [0], [-1], [0]]))
    wanted = ["2π", "> 16π", "transiently chaotic", "not computed"]
    assert list(_legend(vi.plot_regimes(one, ax=_axes()))) == wanted


def test_outcomes_have_colours():
    """Outcomes are drawn with and without periods in the data."""
    data = _data(PERIODS[:2], x=(0.5, 0.7), result=np.zeros((2, 3)))
    ends = np.array([[-1, 0, 1], [-1, -1, 0]])
    meanings = {"flag_values": [-1, 0, 1], "flag_meanings": "none fell_left fell_right"}
    data["outcome"] = (data["period"].dims, ends.astype(np.int8), meanings)
    beside, alone = data, data.drop_vars("period")
    for data, others in ((beside, 2), (alone, 1)):
        ax = vi.plot_regimes(data, ax=_axes())
        cells, legend = _cells(ax)[0], _legend(ax)
        assert len(legend) == others + 2 == len(set(legend.values()))
        for number, name in enumerate(("fell_left", "fell_right")):
            assert {tuple(c) for c in cells[ends == number]} == {legend[name]}


def _basins(label, dims, **coords):
    motions = [
        vi.Attractor(0, 1, 1.0, {"Y": np.array([0.2]), "V": np.array([1.0])}, 4, 0.5, 0.1),
        vi.Attractor(1, 2, 3.0, dict.fromkeys("YV", np.array([0.0, 9.0])), 2, 0.2, 0.1),
    ]
    label = np.asarray(label, np.int8)
    data = xr.Dataset({"label": (dims, label), "result": (dims, 0 * label)}, coords=coords)
    return vi.Basins(data, motions, {**IRREGULAR}, vi.Scene.ideal(frequency_ratio=0.9))


def test_basins_on_a_grid():
    label = [[0, -4, 1], [1, -1, -3]]
    dims = ("start.Y", "start.V")
    found = _basins(label, dims, **{"start.Y": [-1.0, 1.0], "start.V": [-1.0, 0.0, 1.0]})
    ax = _axes()
    assert vi.plot_basins(found, ax=ax) is ax
    legend = _legend(ax)
    names = ["2π, 1 impact: 50.0 %", "4π, 3 impacts: 20.0 %", "chaotic: 10.0 %", "failed: 10.0 %"]
    names.append("transiently chaotic: 10.0 %")
    assert list(legend) == names
    cells, _ = _cells(ax)
    of = {0: names[0], 1: names[1], -1: names[2], -3: names[3], -4: names[4]}
    for place, value in np.ndenumerate(np.array(label)):
        np.testing.assert_allclose(cells[place], legend[of[value]])
    first, second = ax.lines
    assert first.get_xydata().tolist() == [[0.2, 1.0]]
    assert second.get_xydata().tolist() == [[0.0, 0.0], [9.0, 9.0]]
    # The point outside the region does not change the limits.
    assert ax.get_xlim() == (-2.0, 2.0) and ax.get_ylim() == (-1.5, 1.5)
    assert ax.get_xlabel().startswith("Y") and ax.get_ylabel().startswith("V")


def test_basins_have_a_legend_and_different_colours_for_equal_periods():
    dims, starts = ("start.Y", "start.V"), {"start.Y": [0.0, 1.0], "start.V": [0.0, 1.0]}
    found = _basins([[0, 1], [1, 0]], dims, **starts)
    ax = vi.plot_basins(found, ax=_axes())
    assert ax.get_legend().get_texts()[-1].get_text() == "sections of the motions"
    alike = [a._replace(period=1, impacts=1.0) for a in found.attractors]
    first, second, *_ = _legend(
        vi.plot_basins(found._replace(attractors=alike), ax=_axes())
    ).values()
    assert first == to_rgb(color_of(1, 1)) != second


@pytest.mark.slow
def test_maps_of_a_machine_use_its_units_and_names():
    ball = vi.machines.BouncingBall(restitution=0.5, acceleration=3.0)
    dims, starts = ("start.Y", "start.V"), {"start.Y": [0.0, 1.0], "start.V": [0.0, 1.0]}
    found = _basins([[0, 1], [1, 0]], dims, **starts)
    ax = vi.plot_basins(found, ax=_axes())
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Y at the start (a)", "V at the start (a ω)")
    names = {"Y": "height", "V": "speed"}
    renamed = [
        a._replace(sections={names[key]: x for key, x in a.sections.items()})
        for a in found.attractors
    ]
    data = found.data.rename({f"start.{key}": f"start.{name}" for key, name in names.items()})
    found = found._replace(machine=ball, attractors=renamed, data=data)
    ax = vi.plot_basins(found, ax=_axes())
    assert next(iter(_legend(ax))).startswith("1 cycle, 1 impact")
    assert "period 1 cycle" in str(found) and "π" not in str(found)
    assert ax.get_xlabel() == "height at the start (g/ω²)"
    named = _legend(vi.plot_regimes(_data(), machine=ball, ax=_axes()))
    assert "1 cycle" in named and "> 8 cycles" in named
    data = vi.scan(
        ball, {"start.height": [1.0, 2.0], "start.speed": [0.0, 1.0]}, measure="regime",
        settle=20, progress=False,
    )  # fmt: skip
    assert not any("π" in name for name in _legend(vi.plot_regimes(data, ax=_axes())))


def test_regimes_of_equal_period_differ_by_impacts():
    impacts = np.array([[0.0, 1.0, 4.0], [5.0, 9.0, 0.0], [0.4, 0.0, 1.0], [0.4, 0.4, 2.0]])
    data = _data().assign(impacts=(_data()["period"].dims, impacts))
    ax = vi.plot_regimes(data, ax=_axes())
    cells, legend = _cells(ax)[0], _legend(ax)
    assert list(legend)[:4] == ["2π", "2π, no impact", "4π, 1 impact", "4π, more impacts"]
    for place, name in (((0, 0), "2π, no impact"), ((2, 2), "2π"), ((0, 1), "4π, 1 impact"),
                        ((3, 2), "4π, more impacts"), ((2, 0), "chaotic")):  # fmt: skip
        np.testing.assert_allclose(cells[place], legend[name])
    assert legend["2π"] == to_rgb(color_of(1))


def test_basins_of_random_starts():
    coords = {"start.Y": ("sample", [0.0, 1.0, 2.0]), "start.V": ("sample", [0.5, 0.5, 0.0])}
    ax = vi.plot_basins(_basins([0, 1, -2], ("sample",), **coords), ax=_axes())
    (dots,) = ax.collections
    assert dots.get_offsets().tolist() == [[0.0, 0.5], [1.0, 0.5], [2.0, 0.0]]
    assert len({tuple(color) for color in dots.get_facecolors()}) == 3
