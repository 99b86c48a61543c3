"""Pictures of orbits, branches, sweeps and boundaries."""

import numpy as np
import pytest
import vi_jax as vi
from matplotlib.figure import Figure
from vi_jax.orbit import KINDS

pytestmark = pytest.mark.slow
NAME = "drive.frequency_ratio"


def _axes():
    return Figure().subplots()


@pytest.fixture(scope="module")
def branch():
    scene = vi.Scene.ideal(frequency_ratio=0.97, restitution=0.5)
    closed = vi.closed_form_orbits(scene)
    orbit = vi.find_orbit(scene, scene.start(Y=closed.Y[0], V=closed.V[0]))
    return vi.continue_orbit(orbit, parameter=NAME, bounds=(0.9, 1.0))


def test_branch_changes_its_line_style_with_stability(branch):
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


def test_a_sweep_lies_above_branches_and_below_marks(branch):
    sweep = vi.sweep(branch.orbit(0).machine, NAME, np.linspace(0.95, 1.0, 4), settle=10, cycles=8)
    ax = _axes()
    assert vi.plot_sweep(sweep, ax=ax) is ax and vi.plot_branch(branch, ax=ax) is ax
    assert len(ax.lines[0].get_xdata()) == 4
    assert vi.plot_multipliers(branch.orbit(0), ax=(own := _axes())) is own
    plain = vi.plot_branch(branch, ax=_axes(), y="y_max", special=False)
    assert not [line for line in plain.lines if line.get_label() in KINDS]
    dots, *others = ax.lines
    marks = [line for line in others if line.get_label() in KINDS]
    lines = [line for line in others if line not in marks]
    assert marks and max(x.zorder for x in lines) < dots.zorder < min(x.zorder for x in marks)
