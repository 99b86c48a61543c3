"""Pictures of orbits, branches, sweeps and boundaries."""

import dataclasses

import numpy as np
import pytest
import vi_jax as vi
from matplotlib.figure import Figure
from vi_jax.orbit import _sliding, _words
from vi_jax.plot.colors import MARKS, color_of

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


def test_legend_names_marks_and_begins_with_a_solid_line(branch):
    for turn in (slice(None), slice(None, None, -1)):  # begins stable, begins unstable
        turned = dataclasses.replace(branch, steps=branch.steps[turn])
        ax = vi.plot_branch(turned, ax=_axes(), label="2π")
        legend = ax.get_legend()
        named = [t.get_text() for t in legend.get_texts()]
        handles = dict(zip(named, legend.legend_handles, strict=True))
        kinds = {p.kind for p in branch.special}
        assert len(named) == len(set(named)) and set(named) == {"2π", "stable", "unstable", *kinds}
        assert named[:3] == ["2π", "stable", "unstable"]
        assert handles["2π"].get_linestyle() == "-"
        assert handles["2π"].get_color() == color_of(1)
        assert [handles[word].get_linestyle() for word in named[1:3]] == ["-", "--"]
        # Without a label the legend explains the colour, and has no entry twice.
        for _ in range(2):
            vi.plot_branch(branch, ax=ax)
            again = [t.get_text() for t in ax.get_legend().get_texts()]
            assert again == ["2π", "2π, 1 impact", *named[1:]]


def test_a_branch_with_constant_extremes_is_drawn_by_its_impacts(branch):
    """The maximum varies by rounding only, and must not be chosen: stops fix both extremes."""
    noisy = [{"y_min": -1.3, "y_max": 1.3 + i % 2 * 1e-15} for i in range(len(branch.steps))]
    steps = [
        step._replace(observed=step.observed._replace(**at))
        for step, at in zip(branch.steps, noisy, strict=True)
    ]
    drawn = vi.plot_branch(dataclasses.replace(branch, steps=steps), ax=_axes())
    assert drawn.get_ylabel() == "fastest_impact (a ω)"


def test_a_sweep_lies_above_branches_and_below_marks(branch):
    sweep = vi.sweep(branch.orbit(0).machine, NAME, np.linspace(0.95, 1.0, 4), settle=10, cycles=8)
    ax = _axes()
    assert vi.plot_sweep(sweep, ax=ax) is ax and vi.plot_branch(branch, ax=ax) is ax
    assert len(ax.lines[0].get_xdata()) == 4
    assert vi.plot_multipliers(branch.orbit(0), ax=(own := _axes())) is own
    plain = vi.plot_branch(branch, ax=_axes(), y="y_max", special=False)
    assert not [line for line in plain.lines if line.get_label() in MARKS]
    dots, *others = ax.lines
    marks = [line for line in others if line.get_label() in MARKS]
    lines = [line for line in others if line not in marks]
    assert marks and max(x.zorder for x in lines) < dots.zorder < min(x.zorder for x in marks)


def test_every_kind_of_special_point_has_a_different_mark():
    assert len({mark for mark, _ in MARKS.values()}) == len(MARKS)
    assert set(_sliding.SLIDING) <= set(MARKS)
    assert set(MARKS) - set(_sliding.SLIDING) == {
        getattr(_words, name)
        for name in (
            "FOLD", "DOUBLING", "TORUS", "GRAZING", "CROSSING", "SYMMETRY", "HOPF", "REST",
            "EXTREMUM", "WATCHED", "TURN", "CUSP", "DEGENERATE",
            "DEGENERATE_SYMMETRY", "FLIP", "RESONANCE_1",
            "RESONANCE_2", "RESONANCE_3", "RESONANCE_4", "RESONANT",
        )
    }  # fmt: skip


def test_an_extreme_that_a_stop_fixes_is_not_drawn(branch):
    """The minimal height of a ball on a table is constant, so the maximum is drawn."""
    ball = vi.machines.BouncingBall(acceleration=1.2, restitution=0.6)
    swept = vi.sweep(
        ball, "acceleration", np.linspace(1.1, 1.2, 3), start=ball.start(height=6.8, speed=-0.7),
        settle=100, cycles=4,
    )  # fmt: skip
    drawn = vi.plot_sweep(swept)
    assert np.ptp(drawn.lines[0].get_ydata()) > 0.01
    assert drawn.get_ylabel() == "max height (g/ω²)"
    assert "cycle" in str(swept) and "π" not in str(swept)
    assert vi.plot_branch(branch).lines[0].get_ydata()[0] in branch.y_min
    with pytest.raises(ValueError, match=r"`y` must be one of .*'y_min'"):
        vi.plot_sweep(swept, y="Ymin")
    with pytest.raises(ValueError, match=r"`y` must be one of .*'y_min'"):
        vi.plot_branch(branch, y="Ymin")
    with pytest.raises(TypeError, match="branch"):
        vi.plot_branch(swept)
