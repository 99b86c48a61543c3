"""Pictures of orbits, branches, sweeps and boundaries."""

import numpy as np
import pytest
import vi_jax as vi
from matplotlib.figure import Figure

NAME = "drive.frequency_ratio"


@pytest.fixture(scope="module")
def branch():
    scene = vi.Scene.ideal(frequency_ratio=0.97, restitution=0.5)
    closed = vi.closed_form_orbits(scene)
    orbit = vi.find_orbit(scene, scene.start(Y=closed.Y[0], V=closed.V[0]))
    return vi.continue_orbit(orbit, parameter=NAME, bounds=(0.9, 1.0))


def test_branch_changes_its_line_where_it_changes_stability(branch):
    ax = vi.plot_branch(branch, label="2π")
    lines = {line.get_linestyle(): line for line in ax.lines if len(line.get_xdata()) > 1}
    assert set(lines) == {"-", "--"}
    doubling = next(p for p in branch.special if p.kind == "period-doubling")
    for line in lines.values():
        assert min(abs(np.asarray(line.get_xdata()) - doubling.parameter)) < 1e-9
    solid, dashed = (np.asarray(lines[ls].get_xdata()) for ls in ("-", "--"))
    assert solid.min() == pytest.approx(dashed.max(), abs=1e-9)
    assert ax.get_xlabel() == "frequency ratio ζ" and ax.get_ylabel() == "min Y (a)"
    assert [line.get_label() for line in ax.lines].count("2π") == 1


def test_given_axes_are_used(branch):
    ax = Figure().subplots()
    assert vi.plot_branch(branch, ax=ax, y="y_max", special=False) is ax
    assert vi.plot_multipliers(branch.orbit(0), ax=ax) is ax
    sweep = vi.sweep(branch.orbit(0).scene, NAME, np.linspace(0.95, 1.0, 4), settle=10, cycles=8)
    assert vi.plot_sweep(sweep, ax=ax) is ax
    assert len(ax.lines[-1].get_xdata()) == 4


@pytest.mark.slow
def test_boundary_is_drawn_in_its_plane(branch):
    doubling = next(p for p in branch.special if p.kind == "period-doubling")
    curve = vi.boundary(
        doubling, parameter="stops.0.restitution", bounds=((0.9, 1.0), (0.45, 0.55))
    )
    ax = vi.plot_boundary(curve)
    assert ax.get_xlabel() == "frequency ratio ζ" and ax.get_ylabel() == "restitution k"
    np.testing.assert_allclose(np.asarray(ax.lines[0].get_xydata()), curve.parameters)
