"""Branches, what happens on them, and boundaries, beside closed forms and found orbits."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import vi_jax as vi
import xarray as xr
from scipy.optimize import brentq

from closed_forms import fold_by_eq_21

ZETA = "drive.frequency_ratio"


def short_orbit(scene):
    closed = vi.closed_form_orbits(scene)
    return vi.find_orbit(scene, scene.start(Y=closed.Y[0] - 1e-3, V=closed.V[0]), throw=True)


def branch_of(restitution):
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=restitution)
    return vi.continue_orbit(short_orbit(scene), parameter=ZETA, bounds=(0.5, 1.9))


@pytest.fixture(scope="module", params=[0.5, pytest.param(0.8, marks=pytest.mark.slow)])
def restitution(request):
    return request.param


@pytest.fixture(scope="module")
def short(restitution):
    return branch_of(restitution)


@pytest.fixture(scope="module")
def long(short):
    """The doubled motion with two impacts, and the one-impact 4π motion beyond its grazing."""
    doubling = next(p for p in short.special if p.kind == "period-doubling")
    doubled = vi.continue_orbit(doubling.switch(), parameter=ZETA, bounds=(0.5, 1.9))
    grazing = next(p for p in doubled.special if p.kind == "grazing")
    return doubled, vi.continue_orbit(grazing.switch(), parameter=ZETA, bounds=(0.5, 1.9))


@pytest.mark.slow
def test_special_points_of_the_undamped_2pi_branch(short, restitution):
    kinds = {point.kind: point for point in short.special}
    assert short.ends == ("grazing", "grazing")
    born = min((p for p in short.special if p.kind == "grazing"), key=lambda p: p.parameter)
    assert born.parameter == pytest.approx(1 / np.sqrt(2), abs=1e-9)
    assert abs(float(born.orbit.impact_speed[0])) < 1e-9
    doubling = kinds["period-doubling"]
    assert doubling.parameter == pytest.approx({0.5: 0.94, 0.8: 0.995}[restitution], abs=0.005)
    assert np.abs(np.asarray(doubling.orbit.multipliers) + 1).min() < 1e-8
    fold = fold_by_eq_21(restitution, 2.0, *{0.5: (1.4, 1.6), 0.8: (1.6, 1.8)}[restitution])
    assert kinds["fold"].parameter == pytest.approx(fold, abs=1e-8)
    assert np.abs(np.asarray(kinds["fold"].orbit.multipliers) - 1).min() < 1e-6
    # The period doubling as the closed form has it.
    closed = jax.jit(lambda z: vi.closed_form_orbits(scene_at(z, restitution)).multipliers[0])
    at = brentq(lambda z: float(closed(z).real.min()) + 1, 0.9, 1.05, xtol=1e-12)
    assert doubling.parameter == pytest.approx(at, abs=1e-8)


def scene_at(zeta, restitution):
    return vi.Scene.ideal(frequency_ratio=zeta, restitution=restitution)


def test_points_of_the_branches_are_closed_forms(short, long, restitution):
    for branch in (short, long[1]):
        closed = jax.jit(
            jax.vmap(
                lambda z, n=branch.cycles: vi.closed_form_orbits(scene_at(z, restitution), cycles=n)
            )
        )(jnp.asarray(branch.parameter))
        apart = np.abs(np.asarray(closed.impact_speed) - branch.impact_speed)
        which = np.nanargmin(np.where(np.isnan(apart), np.inf, apart), axis=1)
        rows = np.arange(len(which))
        far = (branch.impact_speed[:, 0] > 1e-3) & (np.abs(branch.multipliers - 1).min(1) > 1e-3)
        assert far.sum() > 15
        for name in ("y_min", "clearance"):
            wanted = np.asarray(getattr(closed, name))[rows, which]
            np.testing.assert_allclose(getattr(branch, name)[far], wanted[far], atol=1e-9)
        trace = np.asarray(closed.multipliers).sum(-1)[rows, which].real
        np.testing.assert_allclose(branch.multipliers.sum(1).real[far], trace[far], rtol=1e-8)
        assert branch.admissible.all()


def test_switched_branches(short, long, restitution):
    doubled, single = long
    assert doubled.cycles == 2 and doubled.impact_speed.shape[1] == 2
    assert doubled.ends[1] == "period-doubling" or doubled.ends[0] == "period-doubling"
    doubling = next(p for p in short.special if p.kind == "period-doubling")
    springs = next(p for p in doubled.special if p.kind == "period-doubling")
    assert springs.parameter == pytest.approx(doubling.parameter, abs=1e-8)
    # Where it loses an impact the one-impact 4π motion begins, with the same parameter.
    lost = next(p for p in doubled.special if p.kind == "grazing")
    assert single.cycles == 2 and single.impact_speed.shape[1] == 1
    touches = [p for p in single.special if p.kind == "grazing"]
    assert min(abs(p.parameter - lost.parameter) for p in touches) < 1e-8
    assert all(abs(float(p.orbit.clearance)) < 1e-9 for p in touches)
    for point in touches:  # the place is told within the period, and there the body is at the stop
        told = re.search(r"touches a stop at crank angle φ = ([0-9.]+) of 4π", str(point))
        assert told is not None and 0 <= float(told[1]) < 4 * np.pi
        run = point.orbit.trajectory(samples=4096)
        there = np.interp(float(told[1]) / (2 * np.pi), run.samples.cycles, run.samples.state.Y)
        assert float(there) == pytest.approx(2.0, abs=1e-4)
    slowest = int(np.argmin(np.abs(lost.orbit.impact_speed)))
    told = re.search(r"the impact at crank angle φ = ([0-9.]+) of 4π is lost", str(lost))
    assert told is not None
    assert float(told[1]) == pytest.approx(float(lost.orbit.impact_phase[slowest]), abs=1e-4)
    for point in single.special:
        if point.kind == "period-doubling":
            assert np.abs(np.asarray(point.orbit.multipliers) + 1).min() < 1e-8


def test_sweeps_lie_on_stable_points(short, long, restitution):
    zetas = np.array([0.87, 0.9, 0.92, 0.95, 1.0, 1.1, 1.2])
    up = vi.sweep(scene_at(0.9, restitution), ZETA, zetas, settle=2000, cycles=16)
    assert bool(up.successful.all())
    for zeta, y_min, period in zip(zetas, up.y_min, up.period, strict=True):
        branch = {1: short, 2: long[1]}[int(period)]
        inside = [p for p in branch.special if abs(p.parameter - zeta) < 1e-2]
        if inside:
            continue  # near a bifurcation the transient outlasts any sweep
        (orbit,) = (orbit for orbit in branch.at(zeta) if orbit.stable)
        assert float(orbit.machine.drive.frequency_ratio) == pytest.approx(zeta, abs=1e-12)
        assert float(orbit.y_min) == pytest.approx(float(y_min), abs=1e-6)


@pytest.mark.slow
def test_boundaries_in_a_second_parameter():
    branch = branch_of(0.5)
    doubling = next(p for p in branch.special if p.kind == "period-doubling")
    curve = vi.boundary(
        doubling, parameter="oscillator.damping_ratio", bounds=((0.5, 1.2), (0.0, 0.1))
    )
    multipliers = jax.jit(
        jax.vmap(
            lambda z, xi: vi.closed_form_orbits(
                vi.Scene.ideal(frequency_ratio=z, damping_ratio=xi)
            ).multipliers[0]
        )
    )(*jnp.asarray(curve.parameters.T))
    np.testing.assert_allclose(np.asarray(multipliers).real.min(1), -1, atol=1e-8)
    # At ζ = 0.9 it is met at c = 0.2711 N·s/m.
    table = vi.Parameters(restitution=0.5, gap=0.08)
    order = np.argsort(curve.parameters[:, 0])
    xi = np.interp(0.9, *curve.parameters[order].T)
    ratio = float(table.scene(drive="ideal").damping_ratio / table.damping)
    assert xi / ratio == pytest.approx(0.2711, abs=2e-3)
    fold = next(p for p in branch.special if p.kind == "fold")
    folds = vi.boundary(fold, parameter="stops.0.restitution", bounds=((1.2, 1.9), (0.1, 0.9)))
    for zeta, k in folds.parameters[::10]:
        assert zeta == pytest.approx(fold_by_eq_21(k, 2.0, zeta - 1e-3, zeta + 1e-3), abs=1e-8)


def test_the_motions_at_its_bounds_and_ends(short, restitution):
    low, high = bounds = (0.88, 0.92)
    branch = vi.continue_orbit(
        short_orbit(scene_at(0.9, restitution)), parameter=ZETA, bounds=bounds
    )
    assert branch.ends == ("bounds", "bounds")
    for value in (low, 0.9, high):
        (orbit,) = branch.at(value)
        assert float(orbit.machine.drive.frequency_ratio) == pytest.approx(value, abs=1e-13)
        closed = vi.closed_form_orbits(scene_at(value, restitution))
        assert float(orbit.impact_speed[0]) == pytest.approx(
            float(closed.impact_speed[0]), abs=1e-9
        )
    assert branch.at(high + 1e-9) == []
    # On the fold two motions are one; where the second one's impact is lost, there is the first.
    (fold,) = (point.parameter for point in short.special if point.kind == "fold")
    assert len(short.at(fold)) == 1
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
    table = short.to_xarray(along="point").to_dataframe()
    assert table.y_min.tolist() == short.y_min.tolist()
    # Where stability changes, at points of the branch, it is neither.
    sure = table[table.stability != "neutral"]
    assert len(sure) >= len(table) - len(short.special)
    np.testing.assert_array_equal(sure.stability == "stable", sure.stable)
    np.testing.assert_array_equal(table[ZETA], table.parameter)  # a file tells what it is
    kinds = short.to_xarray(along="special").to_dataframe()
    np.testing.assert_array_equal(kinds[f"special_{ZETA}"], kinds.special_parameter)
    assert kinds.special_kind.tolist() == [point.kind for point in short.special]
    # Each special point is one of the branch's.
    np.testing.assert_array_equal(
        short.parameter[kinds.special_point], kinds.special_parameter.to_numpy()
    )
    np.testing.assert_array_equal(short.y_min[kinds.special_point], kinds.special_y_min.to_numpy())


def test_a_branch_in_files(short, tmp_path):
    """NetCDF keeps all of it; a table all digits of the numbers at its points."""
    few = dataclasses.replace(short, special=[])
    for branch in (short, few):
        data, path = branch.to_xarray(), tmp_path / f"{len(branch.special)}.nc"
        data.to_netcdf(path, engine="h5netcdf")
        with xr.open_dataset(path, engine="h5netcdf") as file:
            assert file.load().identical(data)
    table = short.to_xarray(along="point").to_dataframe()
    table.to_csv(tmp_path / "branch.csv")
    again = pd.read_csv(tmp_path / "branch.csv", index_col="point")
    pd.testing.assert_frame_equal(table, again, check_dtype=False, check_exact=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"parameter": "drive.frequency"}, "near names: drive.frequency_ratio"),
        ({"bounds": (1.0, 1.2)}, "`bounds` must hold the orbit's drive.frequency_ratio = 0.9"),
        (
            {"bounds": (-1.0, 1.2)},
            "`bounds` must leave the machine valid, but at .* = -1: Argument",
        ),
        ({"step": 0.0}, "`step` must be finite and in"),
    ],
)
def test_says_what_is_wrong(arguments, message):
    orbit = short_orbit(scene_at(0.9, 0.5))
    with pytest.raises(ValueError, match=message):
        vi.continue_orbit(orbit, **{"parameter": ZETA, "bounds": (0.5, 1.9), **arguments})


@pytest.mark.parametrize("name", ["step", "max_step"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_steps_that_would_never_end_are_refused(short, name, value):
    point, settings = short.special[0], {"parameter": "stops.0.gap", name: value}
    with pytest.raises(ValueError, match=f"Argument `{name}` must be finite and in"):
        vi.continue_orbit(point.orbit, bounds=(1.0, 3.0), **settings)
    with pytest.raises(ValueError, match=f"Argument `{name}` must be finite and in"):
        vi.boundary(point, bounds=((0.5, 1.9), (1.0, 3.0)), **settings)


def test_bounds_and_distances_that_are_none(short):
    point = short.special[0]
    for bounds in [(1.9, 0.5), (0.5, np.nan), (0.9, 0.9), (0.5, np.inf)]:
        with pytest.raises(ValueError, match="Argument `bounds` must be two finite numbers"):
            vi.continue_orbit(point.orbit, parameter=ZETA, bounds=bounds)
        with pytest.raises(ValueError, match="Argument `bounds` must be two finite numbers"):
            vi.boundary(point, parameter="stops.0.gap", bounds=((0.5, 1.9), bounds))
    for distance in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="Argument `distance` must be finite"):
            point.switch(distance=distance)


@pytest.mark.slow
def test_branches_do_not_depend_on_where_they_begin(short, long, restitution):
    # At ζ = 1.2 the impact lies on the other side of the section than at 0.9.
    scene = vi.Scene.ideal(frequency_ratio=1.2, restitution=restitution)
    other = vi.continue_orbit(short_orbit(scene), parameter=ZETA, bounds=(0.5, 1.9))
    same = {(p.kind, round(p.parameter, 8)) for p in short.special}
    assert {(p.kind, round(p.parameter, 8)) for p in other.special} == same
    doubling = next(p for p in other.special if p.kind == "period-doubling")
    switched = doubling.switch()
    assert (np.asarray(switched.impact_phase) < 4 * np.pi).all()
    doubled = vi.continue_orbit(switched, parameter=ZETA, bounds=(0.5, 1.9))
    assert doubled.admissible.all()
    for mine, its in zip(
        sorted(p.parameter for p in doubled.special),
        sorted(p.parameter for p in long[0].special),
        strict=True,
    ):
        assert mine == pytest.approx(its, abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("max_step", [0.015, 0.2])
def test_special_points_do_not_depend_on_the_step(long, restitution, max_step):
    """With k = 0.8 the doubled branch turns back 1e-5 (in ζ) from where it springs."""
    doubled = long[0]
    again = vi.continue_orbit(
        doubled.orbit(1), parameter=ZETA, bounds=(0.5, 1.9), max_step=max_step
    )
    kinds = {"grazing", "fold", "period-doubling"}
    assert {p.kind for p in again.special} == kinds and len(again.special) == 3
    for mine in again.special:
        (its,) = (p for p in doubled.special if p.kind == mine.kind)
        assert mine.parameter == pytest.approx(its.parameter, abs=1e-8)


def test_a_doubled_branch_springs_where_the_other_doubles(short, long):
    doubling = next(p for p in short.special if p.kind == "period-doubling")
    springs = next(p for p in long[0].special if "springs" in p.detail)
    assert springs.parameter == pytest.approx(doubling.parameter, abs=1e-11)
    assert float(springs.orbit.residual) < 1e-12


@pytest.mark.slow
def test_a_boundary_ends_on_its_bounds(short, tmp_path):
    # Its second parameter has a scale far below 1.
    doubling = next(p for p in short.special if p.kind == "period-doubling")
    xi = "oscillator.damping_ratio"
    curve = vi.boundary(doubling, parameter=xi, bounds=((0.5, 1.9), (0.0, 0.004)))
    data = curve.to_xarray()
    np.testing.assert_array_equal(data[xi], curve.parameters[:, 1])
    assert data[ZETA].attrs["units"] == "ω" and data.attrs["kind"] == curve.kind
    data.to_netcdf(tmp_path / "curve.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "curve.nc", engine="h5netcdf") as file:
        assert file.load().identical(data)
    assert len(curve.to_xarray(along="point").to_dataframe()) == len(curve.parameters)
    assert "bounds" in curve.ends
    ends = curve.parameters[[0, -1], 1]
    assert min(abs(ends)) < 1e-9 and max(ends) == pytest.approx(0.004, abs=1e-9)
