"""User-defined averages of a machine in scans, sweeps and exponents."""

import numpy as np
import pytest
import vi_jax as vi

from shaken_oscillator import Shaken

FREQUENCIES = np.array([0.76, 0.77, 0.78])
OBSERVED = {"settle": 60, "cycles": 8}


@pytest.fixture(scope="module")
def runs():
    """Simulate each frequency separately."""
    found = []
    for frequency in FREQUENCIES:
        machine = Shaken(frequency=frequency)
        found.append(vi.simulate(machine, machine.start(), 8, settle=60))
    return found


def test_a_scan_measures_an_average_by_its_name(runs):
    wanted = [run.averages["taken"].mean() for run in runs]
    for machine in (Shaken(), lambda frequency: Shaken(frequency=frequency)):
        data = vi.scan(
            machine, {"frequency": FREQUENCIES}, measure=("taken", "power"), start=Shaken().start(),
            progress=False, **OBSERVED,
        )  # fmt: skip
        np.testing.assert_allclose(data.taken, wanted, rtol=1e-9)
        assert data.taken.attrs["units"] == "W" and "power" in data
    with pytest.raises(ValueError, match="near names: taken"):
        vi.scan(Shaken(), {"frequency": FREQUENCIES}, measure="takes")


def test_a_sweep_has_averages(runs):
    swept = vi.sweep(Shaken(), "frequency", FREQUENCIES[:1], **OBSERVED)
    np.testing.assert_allclose(swept.averages["taken"][0], runs[0].averages["taken"].mean())
    assert swept.to_xarray().taken.attrs["units"] == "W"
    ax = vi.plot_sweep(swept, y="taken")
    assert ax.get_ylabel() == "mean taken (W)"
    with pytest.raises(ValueError, match="'lost', 'taken'"):
        vi.plot_sweep(swept, y="given")


@pytest.mark.slow
def test_exponents_have_averages(runs):
    machine = Shaken(frequency=FREQUENCIES[0])
    found = vi.lyapunov(machine, runs[0].last, 8, settle=0, number=1)
    np.testing.assert_allclose(found.averages["taken"], runs[0].averages["taken"][-1], rtol=1e-6)
    assert "mean taken: " in repr(found) and found.to_xarray().taken.attrs["units"] == "W"
