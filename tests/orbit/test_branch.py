"""Compare branches, their special points and boundaries with closed forms and found orbits."""

import dataclasses
import pickle
import re

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import vi_jax as vi
import xarray as xr

from closed_forms import fold_by_eq_21

ZETA = "drive.frequency_ratio"


def scene_at(zeta, restitution=0.5):
    return vi.Scene.ideal(frequency_ratio=zeta, restitution=restitution)


def branch_of(scene):
    closed = vi.closed_form_orbits(scene)
    orbit = vi.find_orbit(scene, scene.start(Y=closed.Y[0] - 1e-3, V=closed.V[0]), throw=True)
    return vi.continue_orbit(orbit, parameter=ZETA, bounds=(0.5, 1.9))


def first_of(branch, kind):
    return next(point for point in branch.special if point.kind == kind)


@pytest.fixture(scope="module")
def short():
    return branch_of(scene_at(0.9))


@pytest.fixture(scope="module")
def family():
    """Branches at restitution 0.8: the 2π motion; the doubled motion with two impacts, which folds
    1e-5 (in ζ) from its origin; the 4π motion with one impact beyond its grazing."""
    single = branch_of(scene_at(0.9, 0.8))
    options = {"parameter": ZETA, "bounds": (0.5, 1.9)}
    doubled = vi.continue_orbit(first_of(single, "period-doubling").switch(), **options)
    return single, doubled, vi.continue_orbit(first_of(doubled, "grazing").switch(), **options)


def check_closed_forms(branch, restitution):
    """Compare each point of a branch of motions with one impact."""

    @jax.jit
    @jax.vmap
    def closed_at(z):
        return vi.closed_form_orbits(scene_at(z, restitution), cycles=branch.cycles)

    closed = closed_at(jnp.asarray(branch.parameter))
    apart = np.abs(np.asarray(closed.impact_speed) - branch.impact_speed)
    which = np.nanargmin(np.where(np.isnan(apart), np.inf, apart), axis=1)
    rows = np.arange(len(which))
    far = (branch.impact_speed[:, 0] > 1e-3) & (np.abs(branch.multipliers - 1).min(1) > 1e-3)
    assert far.sum() > 15 and branch.admissible.all()
    for name in ("y_min", "clearance"):
        wanted = np.asarray(getattr(closed, name))[rows, which]
        np.testing.assert_allclose(getattr(branch, name)[far], wanted[far], atol=1e-9)
    multipliers = np.asarray(closed.multipliers)[rows, which]
    trace, least = multipliers.sum(-1).real, multipliers.real.min(-1)
    np.testing.assert_allclose(branch.multipliers.sum(1).real[far], trace[far], rtol=1e-8)
    for point in branch.special:
        if point.kind == "period-doubling":
            assert np.abs(np.asarray(point.orbit.multipliers) + 1).min() < 1e-8
            assert least[branch.parameter == point.parameter] == pytest.approx(-1, abs=1e-7)


def check_equation_21(branch, restitution, near):
    """Check the special points of the 2π motion, whose fold lies near the given ζ."""
    assert branch.ends == ("grazing", "grazing")
    born = min((p for p in branch.special if p.kind == "grazing"), key=lambda p: p.parameter)
    assert born.parameter == pytest.approx(1 / np.sqrt(2), abs=1e-9)
    assert abs(float(born.orbit.impact_speed[0])) < 1e-9
    fold = first_of(branch, "fold")
    wanted = fold_by_eq_21(restitution, 2.0, near - 0.1, near + 0.1)
    assert fold.parameter == pytest.approx(wanted, abs=1e-8)
    assert np.abs(np.asarray(fold.orbit.multipliers) - 1).min() < 1e-6


def test_the_2pi_branch_is_the_closed_form(short):
    kinds = ["fold", "grazing", "grazing", "period-doubling"]
    assert sorted(p.kind for p in short.special) == kinds
    check_closed_forms(short, 0.5)
    check_equation_21(short, 0.5, 1.5)


@pytest.mark.slow
def test_branches_of_4pi(family):
    single, doubled, long = family
    check_equation_21(single, 0.8, 1.7)
    for branch in (single, long):
        check_closed_forms(branch, 0.8)
    assert doubled.cycles == 2 and doubled.impact_speed.shape[1] == 2
    assert "period-doubling" in doubled.ends
    springs = next(p for p in doubled.special if "begins at" in p.detail)
    at = first_of(single, "period-doubling").parameter
    for words in ("right stop at crank angle φ = ", " rad, V⁻"):
        assert words in str(springs.orbit)
    assert springs.kind == "period-doubling" and springs.parameter == pytest.approx(at, abs=1e-11)
    assert float(springs.orbit.residual) < 1e-12
    # The 4π motion with one impact begins where the doubled motion loses an impact.
    lost = first_of(doubled, "grazing")
    assert long.cycles == 2 and long.impact_speed.shape[1] == 1
    touches = [p for p in long.special if p.kind == "grazing"]
    assert min(abs(p.parameter - lost.parameter) for p in touches) < 1e-8
    assert all(abs(float(p.orbit.clearance)) < 1e-9 for p in touches)
    for point in touches:  # the message gives a phase in the period, with the body at the stop
        matched = re.search(r"touches a stop at crank angle φ = ([0-9.]+) of 4π", str(point))
        assert matched is not None and 0 <= float(matched[1]) < 4 * np.pi
        assert str(point).startswith(f"grazing at {point.parameter:.10g} ω: ")
        run = point.orbit.trajectory(samples=4096)
        there = np.interp(float(matched[1]) / (2 * np.pi), run.samples.cycles, run.samples.state.Y)
        assert float(there) == pytest.approx(2.0, abs=1e-4)
    slowest = int(np.argmin(np.abs(lost.orbit.impact_speed)))
    matched = re.search(r"the impact at crank angle φ = ([0-9.]+) of 4π is lost", str(lost))
    assert matched is not None
    assert float(matched[1]) == pytest.approx(float(lost.orbit.impact_phase[slowest]), abs=1e-4)


@pytest.mark.slow
def test_branches_do_not_depend_on_where_they_begin(short):
    """At ζ = 0.9 and at ζ = 1.2 the impact lies on different sides of the section."""
    other = branch_of(scene_at(1.2))
    same = {(p.kind, round(p.parameter, 8)) for p in short.special}
    assert {(p.kind, round(p.parameter, 8)) for p in other.special} == same
    switched = first_of(other, "period-doubling").switch()
    assert (np.asarray(switched.impact_phase) < 4 * np.pi).all()


@pytest.mark.slow
def test_boundaries_in_a_second_parameter(short, tmp_path):
    doubling, xi = first_of(short, "period-doubling"), "damping_ratio"
    curve = vi.boundary(doubling, parameter=xi, bounds=((0.5, 1.2), (0.0, 0.1)))
    scenes = lambda z, xi: vi.Scene.ideal(frequency_ratio=z, damping_ratio=xi)
    closed = jax.jit(jax.vmap(lambda *x: vi.closed_form_orbits(scenes(*x)).multipliers[0]))
    multipliers = np.asarray(closed(*jnp.asarray(curve.parameters.T)))
    np.testing.assert_allclose(multipliers.real.min(1), -1, atol=1e-8)
    # The curve passes ζ = 0.9 at c = 0.2711 N·s/m.
    table = vi.Parameters(restitution=0.5, gap=0.08)
    order = np.argsort(curve.parameters[:, 0])
    ratio = float(table.scene(drive="ideal").damping_ratio / table.damping)
    met = np.interp(0.9, *curve.parameters[order].T) / ratio
    assert met == pytest.approx(0.2711, abs=2e-3)
    bounds = ((1.2, 1.9), (0.1, 0.9))
    folds = vi.boundary(first_of(short, "fold"), parameter="stops.0.restitution", bounds=bounds)
    for zeta, k in folds.parameters[::10]:
        assert zeta == pytest.approx(fold_by_eq_21(k, 2.0, zeta - 1e-3, zeta + 1e-3), abs=1e-8)
    ax = vi.plot_boundary(folds)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("frequency ratio ζ", "restitution k")
    # The curve also ends on bounds far below 1.
    curve = vi.boundary(doubling, parameter=xi, bounds=((0.5, 1.9), (0.0, 0.004)))
    ends = curve.parameters[[0, -1], 1]
    assert "bounds" in curve.ends
    assert min(abs(ends)) < 1e-9 and max(ends) == pytest.approx(0.004, abs=1e-9)
    data = curve.to_xarray()
    np.testing.assert_array_equal(data[xi], curve.parameters[:, 1])
    assert data[ZETA].attrs["units"] == "ω" and data.attrs["kind"] == curve.kind
    data.to_netcdf(tmp_path / "curve.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "curve.nc", engine="h5netcdf") as file:
        assert file.load().identical(data)
    assert len(curve.to_xarray(along="point").to_dataframe()) == len(curve.parameters)


def test_at_finds_the_motions_at_bounds_and_ends(short):
    low, high = bounds = (0.88, 0.92)
    (start,) = short.at(0.9)
    branch = vi.continue_orbit(start, parameter=ZETA, bounds=bounds)
    assert branch.ends == ("bounds", "bounds")
    for value in (low, 0.9, high):
        (orbit,) = branch.at(value)
        assert float(orbit.machine.drive.frequency_ratio) == pytest.approx(value, abs=1e-13)
        closed = vi.closed_form_orbits(scene_at(value))
        speed = float(closed.impact_speed[0])
        assert float(orbit.impact_speed[0]) == pytest.approx(speed, abs=1e-9)
    assert branch.at(high + 1e-9) == []
    # At the fold both motions coincide. The first one exists where the second loses its impact.
    assert len(short.at(first_of(short, "fold").parameter)) == 1
    first, lost = short.at(short.parameter[-1])
    assert float(lost.impact_speed[0]) == pytest.approx(0, abs=1e-9)
    assert float(first.impact_speed[0]) > 0.1


def test_a_branch_as_data(short):
    data = short.to_xarray()
    assert data.sizes == {
        "point": len(short.parameter), "impact": 1, "state": 2, "special": len(short.special),
    }  # fmt: skip
    assert data.y_min.attrs["units"] == "a" and data.attrs["parameter"] == ZETA
    assert data.attrs["ends"] == list(short.ends)
    assert "period-doubling at" in str(short)
    restitution = float(short.orbit(0).machine.stops[0].restitution)
    lost = 0.5 * (1 - restitution**2) * (short.impact_speed**2).sum(axis=1) / short.cycles
    np.testing.assert_allclose(short.impact_energy, lost, rtol=1e-11, atol=1e-13)  # 0 at a graze
    table = short.to_xarray(along="point").to_dataframe()
    assert table.y_min.tolist() == short.y_min.tolist()
    # At the special points where stability changes it is neutral.
    assert 0 < (table.stability == "neutral").sum() <= len(short.special)
    np.testing.assert_array_equal(table.stability == "stable", table.stable)
    np.testing.assert_array_equal(table[ZETA], table.parameter)  # a column of this name
    kinds = short.to_xarray(along="special").to_dataframe()
    np.testing.assert_array_equal(kinds[f"special_{ZETA}"], kinds.special_parameter)
    assert kinds.special_kind.tolist() == [point.kind for point in short.special]
    # Each special point is also a point of the branch.
    np.testing.assert_array_equal(
        short.parameter[kinds.special_point], kinds.special_parameter.to_numpy()
    )
    np.testing.assert_array_equal(short.y_min[kinds.special_point], kinds.special_y_min.to_numpy())


def test_a_branch_in_files(short, tmp_path):
    """NetCDF stores the whole branch, CSV its points with all digits."""
    few = dataclasses.replace(short, special=[])
    for branch in (short, few):
        data, path = branch.to_xarray(), tmp_path / f"{len(branch.special)}.nc"
        data.to_netcdf(path, engine="h5netcdf")
        with xr.open_dataset(path, engine="h5netcdf") as file:
            assert file.load().identical(data)
    table = short.to_xarray(along="point").to_dataframe()
    table.to_csv(tmp_path / "branch.csv")
    again = pd.read_csv(tmp_path / "branch.csv", index_col="point", float_precision="round_trip")
    pd.testing.assert_frame_equal(table, again, check_dtype=False, check_exact=True)


def test_a_restored_branch_can_be_switched(short):
    """Special points refer to their row by index, in a pickled or a reversed copy too."""
    again = pickle.loads(pickle.dumps(short))
    turned = dataclasses.replace(again, steps=again.steps[::-1], ends=again.ends[::-1])
    np.testing.assert_array_equal(turned.multipliers[::-1], short.multipliers)
    for point in again.special:
        assert again.parameter[point.index] == point.parameter
    orbit, same = (first_of(branch, "period-doubling").switch() for branch in (short, again))
    np.testing.assert_array_equal(orbit.impact_speed, same.impact_speed)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"parameter": "drive.frequency"}, "near names: drive.frequency_ratio"),
        ({"bounds": (1.0, 1.2)}, "`bounds` must hold the orbit's drive.frequency_ratio = 0.9"),
        ({"bounds": (-1.0, 1.2)}, "`bounds` must leave the machine valid, but at .* = -1:"),
    ],
)
def test_invalid_arguments_raise(short, arguments, message):
    (orbit,) = short.at(0.9)
    with pytest.raises(ValueError, match=message):
        vi.continue_orbit(orbit, **{"parameter": ZETA, "bounds": (0.5, 1.9), **arguments})


def test_invalid_steps_bounds_and_distances_raise(short):
    point, gap, free = short.special[0], "stops.0.gap", (1.0, 3.0)

    def expect_error(bounds, message, **settings):
        with pytest.raises(ValueError, match=message):
            vi.continue_orbit(point.orbit, parameter=gap, bounds=bounds, **settings)
        with pytest.raises(ValueError, match=message):
            vi.boundary(point, parameter=gap, bounds=((0.5, 1.9), bounds), **settings)

    for name in ("step", "max_step"):  # the continuation would never end
        for value in (0.0, -1.0, np.nan, np.inf):
            expect_error(free, f"Argument `{name}` must be finite and in", **{name: value})
    for bounds in [(3.0, 1.0), (1.0, np.nan), (2.0, 2.0), (1.0, np.inf)]:
        expect_error(bounds, "Argument `bounds` must be two finite numbers")
    for distance in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="Argument `distance` must be finite"):
            point.switch(distance=distance)
