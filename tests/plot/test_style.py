"""A style holds within its block, reaches pictures and files, and leaves nothing behind."""

import re

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
    ("name", "columns", "width", "points"),
    [("journal", 1, 85 / 25.4, 8), ("journal", 2, 175 / 25.4, 8), ("slides", 1, 6, 16)],
)
def test_sizes_of_figure_words_and_lines(run, name, columns, width, points):
    with vi.plot_style(name, columns=columns):
        ax = vi.plot_history(run)
    assert ax.figure.get_size_inches()[0] == pytest.approx(width)
    assert ax.xaxis.label.get_size() == points
    plain = vi.plot_history(run)
    ratio = ax.lines[0].get_linewidth() / plain.lines[0].get_linewidth()
    assert ratio == pytest.approx({"journal": 1.0, "slides": 2.2}[name] / 1.5)
    plt.close(plain.figure)
    plt.close(ax.figure)


def test_nothing_is_left_behind(run):
    before = dict(plt.rcParams)
    with pytest.raises(KeyError), vi.plot_style():
        raise KeyError
    assert dict(plt.rcParams) == before
    ax = vi.plot_history(run)
    assert tuple(ax.figure.get_size_inches()) == (7, 3.5)
    plt.close(ax.figure)


def test_a_pdf_has_its_fonts_as_truetype(run, tmp_path):
    with vi.plot_style(), matplotlib.rc_context({"pdf.compression": 0}):
        ax = vi.plot_history(run)
        ax.figure.savefig(tmp_path / "figure.pdf")
    kinds = set(
        re.findall(
            rb"/Subtype /(Type3|CIDFontType2|Type42)", (tmp_path / "figure.pdf").read_bytes()
        )
    )
    assert kinds == {b"CIDFontType2"}  # how a PDF names an embedded TrueType font
    plt.close(ax.figure)


@pytest.mark.parametrize(("call", "said"), [(("poster",), "`name`"), ((), "`columns`")])
def test_other_words_are_refused(call, said):
    with pytest.raises(ValueError, match=said), vi.plot_style(*call, columns=3):
        pass
