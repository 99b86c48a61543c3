"""Averages and quantities that a machine defines, along orbits and branches."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from shaken_oscillator import Shaken


def missing(power, orbit):
    """Return the power taken minus the losses in damping and impacts, zero for an orbit."""
    dissipated = 0.5 * (1 - 0.6**2) * jnp.nansum(orbit.impact_speed**2) / orbit.duration
    return power["taken"] - power["lost"] - dissipated


@pytest.fixture(scope="module")
def orbit():
    machine = Shaken()
    settled = vi.simulate(machine, machine.start(), 1, settle=100)
    return vi.find_orbit(machine, settled.last)


@pytest.fixture(scope="module")
def branch(orbit):
    return vi.continue_orbit(orbit, parameter="frequency", bounds=(0.75, 0.85))


@pytest.mark.slow
def test_power_balance_of_an_orbit(orbit):
    assert bool(orbit.successful)
    np.testing.assert_allclose(missing(orbit.averages, orbit), 0.0, atol=1e-8)
    assert f"mean taken: {float(orbit.averages['taken']):.9g} W" in repr(orbit)
    data = orbit.to_xarray()
    assert data.taken.attrs["units"] == "W" and data.section_energy.dims == ("section",)
    energy = 0.5 * (orbit.sections.V**2 + orbit.sections.Y**2)
    np.testing.assert_allclose(orbit.quantities["energy"], energy)


@pytest.mark.slow
def test_quantities_along_a_branch(branch, orbit):
    assert len(branch.parameter) > 3
    here = branch.at(0.8)[0]
    np.testing.assert_allclose(here.averages["taken"], orbit.averages["taken"], atol=1e-8)
    orbits = [branch.orbit(i) for i in range(len(branch.parameter))]
    np.testing.assert_allclose([missing(at.averages, at) for at in orbits], 0.0, atol=1e-9)
    np.testing.assert_allclose(branch.column("section_Y"), [x.state.Y for x in orbits], atol=1e-14)
    np.testing.assert_allclose(branch.column("duration"), 2 * np.pi / branch.parameter)
    assert (branch.column("impacts") == branch.impact_speed.shape[1]).all()
    data = branch.to_xarray(along="point")
    assert data.taken.attrs["units"] == "W" and data.section_energy.attrs["units"] == "J"
    assert set(data) >= {"duration", "impacts", "lost", "section_V", "section_push"}
