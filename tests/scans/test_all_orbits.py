"""All periodic motions in a region of starts, compared with closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
import xarray as xr

from belts import Belt, level
from truth import flown

ZETA, K, GAP, XI = 1.6, 0.8, 1.5, 0.02
REGION = {"start.Y": (-3.5, GAP), "start.V": (-4.0, 4.0)}


@pytest.fixture(scope="module")
def scene():
    return vi.Scene.ideal(frequency_ratio=ZETA, restitution=K, gap=GAP, damping_ratio=XI)


@pytest.fixture(scope="module")
def found(scene):
    return vi.all_orbits(scene, 1, region=REGION, starts=128)


def test_motions_of_one_cycle_agree_with_closed_forms(found, scene):
    """One motion has no impact; Eqs. 14 to 21 give the two others."""
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


def test_the_report_of_the_search(found, tmp_path):
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
def test_an_equilibrium_is_not_counted_as_an_orbit():
    """A body on a belt slides steadily at an equilibrium, which has any period. Around it are two
    cycles: stick-slip, and pure slip."""
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
    """Results of complete periods are kept after Ctrl-C."""
    from vi_jax.scans import _all_orbits

    plain = _all_orbits.find_orbit

    def pressed(machine, guess, cycles, **options):
        if cycles == 2:
            raise KeyboardInterrupt
        return plain(machine, guess, cycles, **options)

    monkeypatch.setattr(_all_orbits, "find_orbit", pressed)
    with pytest.raises(KeyboardInterrupt) as caught:
        vi.all_orbits(scene, 3, region=REGION, starts=128)
    partial = caught.value.partial  # pyright: ignore[reportAttributeAccessIssue]
    assert len(partial.searched) == 1 and str(partial) == str(found)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cycles": 0}, "`cycles` must be"),
        ({"starts": 0}, "`starts` must be"),
        ({"region": {"stops.0.gap": (1.0, 2.0)}}, "`region` must name numbers of the start"),
        ({"region": {"start.Z": (1.0, 2.0)}}, "`region` must be a number .* start.Y"),
        ({"region": {"start.Y": (2.0, 1.0)}}, "`region` must give ranges"),
        ({"tolerance": -1.0}, "`tolerance` must be"),
    ],
)
def test_invalid_arguments_raise(scene, arguments, message):
    with pytest.raises(ValueError, match=message):
        vi.all_orbits(scene, **{"region": REGION, **arguments})


@pytest.mark.slow
def test_motions_of_three_cycles_are_periodic(scene):
    """Compare with the closed-form flights of `flown`."""
    found = vi.all_orbits(scene, 3, region=REGION, starts=256)
    assert sorted(found.periods) == [1, 1, 1, 3, 3]
    for orbit in found.orbits:
        Y, V = np.asarray(orbit.sections.Y), np.asarray(orbit.sections.V)
        ends = flown(ZETA, XI, ((1, GAP, K),), Y, V, len(Y)).sections[-1]
        np.testing.assert_allclose(ends, [Y, V], atol=1e-7)
