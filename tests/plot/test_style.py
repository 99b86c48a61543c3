"""The styles set the sizes of figures and the fonts of files."""

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import pytest
import vi_jax as vi


@pytest.fixture(scope="module")
def run():
    scene = vi.Scene.ideal(frequency_ratio=0.9)
    return vi.simulate(scene, scene.start(), 2, samples=16)


@pytest.mark.parametrize(
    ("name", "width", "points", "line"), [("journal", 85 / 25.4, 8, 1.0), ("slides", 6, 16, 2.2)]
)
def test_sizes_of_figure_words_and_lines(run, name, width, points, line):
    with plt.style.context(f"vi_jax.plot.{name}"):
        ax = vi.plot_history(run)
    assert ax.figure.get_size_inches()[0] == pytest.approx(width, abs=1e-3)
    assert ax.xaxis.label.get_size() == points
    plain = vi.plot_history(run)
    assert tuple(plain.figure.get_size_inches()) == (7, 3.5)
    ratio = ax.lines[0].get_linewidth() / plain.lines[0].get_linewidth()
    assert ratio == pytest.approx(line / 1.5)
    plt.close(plain.figure)
    plt.close(ax.figure)
