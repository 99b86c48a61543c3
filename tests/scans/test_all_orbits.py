"""All periodic motions in a region of starts, beside closed forms and a search by brute force."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
import xarray as xr

from belts import Belt, level
from truth import flown

ZETA, K, GAP, XI = 1.6, 0.8, 1.5, 0.02
LOW, HIGH = np.array([-3.5, -4.0]), np.array([GAP, 4.0])
REGION = {"start.Y": (LOW[0], HIGH[0]), "start.V": (LOW[1], HIGH[1])}


@pytest.fixture(scope="module")
def scene():
    return vi.Scene.ideal(frequency_ratio=ZETA, restitution=K, gap=GAP, damping_ratio=XI)


@pytest.fixture(scope="module")
def found(scene):
    return vi.all_orbits(scene, 1, region=REGION, starts=128)


def path_of(orbit):
    return np.stack([np.asarray(orbit.sections.Y), np.asarray(orbit.sections.V)], axis=-1)


def test_motions_of_one_cycle_are_the_closed_forms(found, scene):
    """One without impact, and the two with one that Eq. 14 to 21 give."""
    closed = vi.closed_form_orbits(scene)
    assert bool(closed.admissible.all()) and len(found.orbits) == 3
    hits = [orbit for orbit in found.orbits if int(orbit.impacts)]
    order = np.argsort(closed.y_min)
    for orbit, i in zip(hits, order, strict=True):
        np.testing.assert_allclose(orbit.state.Y, closed.Y[i], atol=1e-9)
        np.testing.assert_allclose(orbit.state.V, closed.V[i], atol=1e-9)
        its = np.sort_complex(np.asarray(closed.multipliers[i]))
        ours = np.sort_complex(np.asarray(orbit.multipliers))
        np.testing.assert_allclose(ours, its, atol=1e-8)
    (free,) = (orbit for orbit in found.orbits if not int(orbit.impacts))
    amplitude = 1 / np.hypot(1 - ZETA**2, 2 * XI * ZETA)
    np.testing.assert_allclose([-free.y_min, free.y_max], amplitude, rtol=1e-9)
    decay = np.exp(-2 * np.pi * XI / ZETA)
    np.testing.assert_allclose(np.abs(free.multipliers), decay, rtol=1e-9)
    assert found.stable.sum() == 2


def test_says_what_was_searched(found, tmp_path):
    (searched,) = found.searched
    assert searched.starts == 128 and searched.simulated == 128
    assert searched.converged == found.found.sum() <= 128 and searched.motions == 3
    assert searched.once == (found.found == 1).sum()
    assert searched.unseen == searched.once / searched.converged
    assert (1 - searched.detectable) ** searched.converged == pytest.approx(0.05)
    assert "3 periodic motions of at most 2π, 2 of them stable" in str(found)
    assert f"{searched.converged} of 128 searches converged, on 3" in str(found)
    data = found.to_xarray()
    data.to_netcdf(tmp_path / "all.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "all.nc", engine="h5netcdf") as file:
        assert file.load().identical(data)
    table = found.to_xarray(along="motion").to_dataframe()
    assert table.total_found.sum() == searched.converged and set(table.period) == {1}
    assert data.y_min.attrs["units"] == "a" and len(found.to_xarray(along="search").search) == 1


@pytest.mark.slow
def test_an_equilibrium_of_an_autonomous_machine_is_no_motion():
    """A body on a belt slides steadily where its spring holds friction, and there every period
    would do; about it there is the cycle that sticks and slips, and one that only slips."""
    belt, speed = Belt(), 1.5
    standing = vi.OscillatorState(level(jnp.asarray(speed)) + 1e-2, jnp.asarray(0.0))
    orbit = vi.find_orbit(belt, standing)
    assert orbit.result == vi.ORBIT_RESULTS.equilibrium and not bool(orbit.successful)
    near = vi.all_orbits(belt, 1, region={"start.Y": (-1.0, 3.0)}, starts=64, start=standing)
    (searched,) = near.searched
    assert len(near.orbits) == 2 and (near.found.sum() == searched.converged)
    assert searched.still > 32 and searched.still + searched.converged <= 64
    assert all(float(o.y_max) - float(o.y_min) > 2 for o in near.orbits)
    assert f"{searched.still} ended at an equilibrium" in str(near)


def test_interrupted_after_a_period(found, scene, monkeypatch):
    """What was searched before Ctrl-C is kept; before that there is nothing to keep."""
    from vi_jax.scans import _all_orbits

    plain = _all_orbits.find_orbit

    def pressed(machine, guess, cycles, **options):
        if cycles == 2:
            raise KeyboardInterrupt
        return plain(machine, guess, cycles, **options)

    monkeypatch.setattr(_all_orbits, "find_orbit", pressed)
    with pytest.raises(KeyboardInterrupt) as told:
        vi.all_orbits(scene, 3, region=REGION, starts=128)
    partial = told.value.partial  # pyright: ignore[reportAttributeAccessIssue]
    assert len(partial.searched) == 1 and str(partial) == str(found)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cycles": 0}, "`cycles` must be"),
        ({"starts": 0}, "`starts` must be"),
        ({"region": {"stops.0.gap": (1.0, 2.0)}}, "`region` must name parts of the start"),
        ({"region": {"start.Z": (1.0, 2.0)}}, "`region` must be a number .* start.Y"),
        ({"region": {"start.Y": (2.0, 1.0)}}, "`region` must give ranges"),
        ({"tolerance": -1.0}, "`tolerance` must be"),
    ],
)
def test_says_what_is_wrong(scene, arguments, message):
    with pytest.raises(ValueError, match=message):
        vi.all_orbits(scene, **{"region": REGION, **arguments})


def mapped(states, cycles):
    """Section states this many cycles on, by the closed-form flights of `flown`."""
    return flown(ZETA, XI, ((1, GAP, K),), states[:, 0], states[:, 1], cycles).sections[-1].T


def by_brute_force(cycles, grid=100):
    """Fixed points of the map over so many cycles: Newton's method by differences, from each point
    of a grid that returns closer than the points around it."""
    rows = [np.linspace(a, b, grid + 2)[1:-1] for a, b in zip(LOW, HIGH, strict=True)]
    x = np.stack(np.meshgrid(*rows, indexing="ij"), axis=-1)
    away = np.abs(mapped(x.reshape(-1, 2), cycles) - x.reshape(-1, 2)).max(axis=1)
    padded = np.pad(away.reshape(grid, grid), 1, constant_values=np.inf)
    around = [padded[i : i + grid, j : j + grid] for i in range(3) for j in range(3)]
    x = x[padded[1:-1, 1:-1] <= np.min(around, axis=0)]
    h = 1e-6
    for _ in range(12):
        beside = np.concatenate([x, x + np.array([h, 0]), x + np.array([0, h])])
        missing, *ahead = np.split(mapped(beside, cycles) - beside, 3)
        slope = np.stack([(y - missing) / h for y in ahead], axis=-1)
        with np.errstate(all="ignore"):
            x = x - np.linalg.solve(slope, missing[..., None])[..., 0]
        x = x[(np.isfinite(x) & (x > LOW - 3) & (x < [GAP, 7.0])).all(axis=1)]
    x = x[np.abs(mapped(x, cycles) - x).max(axis=1) < 1e-8]
    return np.unique(x.round(5), axis=0)


@pytest.mark.exhaustive
def test_nothing_else_is_found_by_brute_force(scene):
    found = vi.all_orbits(scene, 3, region=REGION, starts=256)
    assert sorted(found.periods) == [1, 1, 1, 3, 3]
    paths = [path_of(orbit) for orbit in found.orbits]
    for path in paths:  # each closes, as an independent simulation says, unstable ones too
        np.testing.assert_allclose(mapped(path, len(path)), path, atol=1e-7)
    for cycles in (1, 2, 3):
        known = np.concatenate([path for path in paths if cycles % len(path) == 0])
        others = by_brute_force(cycles)
        near = np.abs(known[:, None] - others).max(axis=2) < 1e-4
        assert len(others) >= 3 and near.any(axis=0).all(), others
    # The stable ones are what simulations settle on.
    starts = np.random.default_rng(0).uniform(LOW, HIGH, (32, 2))
    ends = mapped(starts, 120)
    stable = np.concatenate([p for p, good in zip(paths, found.stable, strict=True) if good])
    near = np.abs(stable[:, None] - ends).max(axis=2) < 0.02
    assert near.any(axis=0).all() and near.any(axis=1).all()
