"""The unit of each component and the section do not change sweeps and basins."""

import jax
import numpy as np
import pytest
import vi_jax as vi

from own_units import (
    MACHINES,
    Belted,
    Cranked,
    Cushioned,
    Heater,
    Pair,
    Rubbed,
    Valve,
    variants,
)

pytestmark = pytest.mark.slow

# Ranges of two components of the start, in the first units, at rest of the others.
REGIONS = {
    Heater: {"T": (290, 300)},
    Valve: {"x": (-2, 0.7), "u": (-1, 1)},
}


def assert_same_sweeps(kind):
    values, first = np.linspace(*kind.bounds, 6), None
    for machine in variants(kind):
        run = vi.sweep(machine, "p", values, start=machine.start(), settle=200, progress=False)
        # Near an equilibrium turns are rounding, and without them a cycle does not end.
        moves = run.y_max - run.y_min > 1e-4 * np.abs(run.y_max)
        found = [np.where(moves, x, 0) for x in (run.period, run.impacts)]
        found[1] = np.where(found[0] > 0, found[1], 0)
        first = found if first is None else first
        case = str(machine)
        for x, y in zip(found, first, strict=True):
            np.testing.assert_array_equal(x, y, err_msg=case)


# Each machine in one precision, each kind of contact, event and cycle in both.
DOUBLE = Rubbed, Cushioned, Belted, Pair, Cranked


@pytest.mark.parametrize("kind", MACHINES)
def test_sweeps(kind):
    with jax.enable_x64(kind in DOUBLE):
        assert_same_sweeps(kind)


@pytest.mark.parametrize("kind", REGIONS)
def test_basins(kind):
    with jax.enable_x64(kind is Valve):
        assert_same_basins(kind)


def assert_same_basins(kind):
    first = None
    for machine in variants(kind):
        scale = {n: machine.scales[i] for i, n in enumerate(kind.names)}
        region = {
            f"start.{n}": (low * scale[n], high * scale[n])
            for n, (low, high) in REGIONS[kind].items()
        }
        options = {"resolution": 10, "start": machine.start(), "settle": 100, "progress": False}
        basins = vi.basins(machine, region, **options)
        found = [(x.period, x.impacts, x.starts) for x in basins.attractors]
        grid = np.asarray(basins.data.label) if machine.phase == 0 else None
        first = (found, grid) if first is None else first
        case = str(machine)
        if machine.phase == 0:
            assert found == first[0], case
            np.testing.assert_array_equal(grid, first[1], err_msg=case)
        assert [x[:2] for x in found] == [x[:2] for x in first[0]], case
