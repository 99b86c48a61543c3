"""The unit of each component, the section and the order of events do not change orbits and
branches."""

import functools

import jax
import numpy as np
import pytest
import vi_jax as vi

from differences import some
from own_units import (
    MACHINES,
    Belted,
    Colliding,
    Cranked,
    Cushioned,
    Heater,
    Pair,
    Rubbed,
    Struck,
    Valve,
    machine_of,
    variants,
)


def orbits_of(machines):
    """Return each machine and its orbit."""
    found = []
    for machine in machines:
        settled = vi.simulate(machine, machine.start(), 1, settle=60).last
        found.append((machine, vi.find_orbit(machine, settled, throw=True)))
    return found


@functools.cache
def orbits(kind):
    return orbits_of(variants(kind))


def numbers_of(orbit):
    sizes, duration = np.sort(np.abs(orbit.multipliers)), orbit.duration / orbit.machine.time
    return np.array([*sizes, duration]), (int(orbit.impacts), int(orbit.rests))


def assert_same_orbits(found_orbits, tolerance):
    """Multipliers, period and impacts do not depend on section and order; nor does the state, in
    the first units, of a machine with the same section."""
    first = None
    for machine, orbit in found_orbits:
        found, counts = numbers_of(orbit)
        first = first or (found, counts, machine.row(orbit.state))
        case = str(machine)
        np.testing.assert_allclose(found, first[0], rtol=tolerance, atol=tolerance, err_msg=case)
        assert counts == first[1], case
        if machine.phase == 0:
            row = machine.row(orbit.state)
            np.testing.assert_allclose(row, first[2], rtol=tolerance, atol=tolerance, err_msg=case)


# One with friction and a stop, one with a switch, one of masses, one that a turn of an angle ends,
# and two without a drive. All others are exhaustive.
FEW = Rubbed, Pair, Heater, Belted, Valve, Cranked


@pytest.mark.parametrize("kind", some(MACHINES, *FEW))
def test_orbits(kind):
    assert_same_orbits(orbits(kind), 1e-8)


@pytest.mark.parametrize("kind", some([x for x in MACHINES if x.length], Rubbed, Heater))
def test_orbits_in_another_order(kind):
    flipped = orbits_of([machine_of(kind, is_flipped=True)])
    assert_same_orbits([orbits(kind)[0], *flipped], 1e-8)


@pytest.mark.parametrize("kind", some(MACHINES, Rubbed))
def test_orbits_in_single_precision(kind):
    with jax.enable_x64(False):
        assert_same_orbits(orbits_of(variants(kind)), 2e-3)


@functools.cache
def branches(kind):
    """Return the branch of each variant, and the variant in words."""
    # Where the special points of Cushioned are, and not around the closed branch of Heater.
    bounds = {Cushioned: (0.49, 0.9), Heater: (1.69, 1.9)}.get(kind, kind.bounds)
    options = {"parameter": "p", "bounds": bounds, "progress": False}
    return [(vi.continue_orbit(orbit, **options), str(machine)) for machine, orbit in orbits(kind)]


@pytest.mark.parametrize("kind", some(MACHINES, *FEW))
def test_branches(kind):
    first = None
    for branch, case in branches(kind):
        found = branch.ends, [(x.kind, round(x.parameter, 8)) for x in branch.special]
        first = first or found
        assert found == first, case


@pytest.mark.parametrize("kind", some([Struck, Pair, Colliding, Cranked, Cushioned], Pair, Cranked))
def test_local_maps(kind):
    first = None
    for branch, case in branches(kind):
        point = next(x for x in branch.special if x.kind == "grazing")
        graze = vi.grazing(point, check=False)
        entries = graze.entries / np.abs(graze.entries).max()
        found = graze.touched.split()[0], str(graze.outcome), graze.forecast.period.tolist()
        first = first or (found, entries)
        assert found == first[0], case
        # The kick of a soft stop is extrapolated; its error was 1.1e-6 in one unit.
        atol = 4e-6 if kind is Cushioned else 1e-6
        np.testing.assert_allclose(entries, first[1], rtol=0, atol=atol)
