"""No study's table or picture is stale: its headline numbers are what the library gives now."""

import inspect
import shutil
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
import vi_jax as vi
from headlines import FINGERPRINT, fingerprint, headlines, keep
from PIL import Image
from tools.pictures import save_picture, stamped
from vi_jax.paper.response import RATIO, _branches, _closed_forms, with_numbers

import headline_numbers
from differences import quick

FOLDER = Path(__file__).parents[2] / "experiments"

PATHS = {p.stem: p for kind in ("studies", "benchmarks") for p in FOLDER.glob(f"{kind}/*.py")}
COMPUTED = {
    name: function
    for name, function in inspect.getmembers(headline_numbers, inspect.isfunction)
    if name in PATHS
}
# The rows of `extremes` are tests of their own (`tests/flow/test_extremes.py`); `gpu` has only times.
STUDIES = sorted(set(PATHS) - {"extremes", "gpu"})


def page_of(study: str) -> str:
    return PATHS[study].with_suffix(".md").read_text(encoding="utf-8")


def stale(kept: dict[str, float], computed: headline_numbers.Expected) -> list[str]:
    """What of the computed numbers a page lacks, or has otherwise."""
    missing = [f"{name} is not kept" for name in computed if name not in kept]
    return missing + [
        f"{name}: kept {kept[name]}, computed {value} (± {slack:g})"
        for name, (value, slack) in computed.items()
        if name in kept and not abs(kept[name] - value) <= slack
    ]


def test_every_study_has_headline_numbers():
    assert sorted(COMPUTED) == STUDIES


# Their programs take longer to compile than the rest of this file.
LONGER = {
    "all_orbits", "basins_map", "chains", "dc_motor", "gradients", "identify", "known_machines",
    "learned_laws", "peers", "posterior", "regime_maps", "relief_valve", "robustness", "soft_stop",
    "woodpecker",
}  # fmt: skip


@pytest.mark.parametrize("study", quick(STUDIES, *set(STUDIES) - LONGER))
def test_headline_numbers(study):
    kept, function = headlines(page_of(study)), COMPUTED[study]
    computed = function(kept) if inspect.signature(function).parameters else function()
    assert computed and not stale(kept, computed)


@pytest.mark.parametrize("study", STUDIES)
def test_pictures_are_of_the_tables(study):
    assert stamped(FOLDER / "figures" / f"{study}.png", FINGERPRINT) == fingerprint(page_of(study))


def test_numbers_in_the_prose_of_figure_2():
    """Its text names bifurcations by their ζ, which are rows of its table."""
    prose, _, tables = page_of("fig2_frequency_response").partition("## Continued branches")
    prose = prose.partition("## Where the minimum")[0]
    places = {float(x) for x in _decimals(tables, least=5)}
    for printed in _decimals(prose, least=4):
        digits = len(printed.partition(".")[2])
        assert any(abs(place - float(printed)) <= 0.51 * 10**-digits for place in places), printed


def _decimals(text: str, least: int) -> list[str]:
    words = text.replace("(", " ").replace(")", " ").replace(",", " ").replace(";", " ").split()
    words = [word.rstrip(".") for word in words]
    return [w for w in words if w.startswith("0.") and len(w) >= least + 2 and w[2:].isdigit()]


def test_the_same_figure_gives_the_same_small_picture(tmp_path):
    from matplotlib.figure import Figure

    for name in ("a.png", "b.png"):
        figure = Figure(figsize=(2, 2))
        figure.subplots().plot([0, 1])
        save_picture(figure, tmp_path / name)
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == (220, 220) and image.mode == "P"
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_what_is_stale_is_told(tmp_path):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2, 1))
    figure.subplots().plot([0, 1], [0, 1])
    text = "# A study\n\nProse of 5 words.\n\n| ζ | k |\n|---|---|\n| 0.82456 | 1e-12 |\n"
    folder, figures = tmp_path / "studies", tmp_path / "figures"
    keep(folder, "study", text, {"doubling": 0.8245572210017}, figure)
    picture, page = figures / "study.png", (folder / "study.md").read_text()
    assert headlines(page) == {"doubling": 0.824557221002}
    assert not stale(headlines(page), {"doubling": (0.8245572, 1e-7)})
    assert stale(headlines(page), {"doubling": (0.82470, 1e-7)})
    assert stale(headlines(page), {"another": (0.8, 1.0)})
    assert (
        stamped(picture, FINGERPRINT)
        == fingerprint(page)
        == fingerprint(page.replace("Prose", "Words"))
    )
    for old, new in (("0.82456", "0.82470"), ("1e-12", "1e-11"), ("0.824557221002", "0.8245573")):
        assert fingerprint(page.replace(old, new)) != stamped(picture, FINGERPRINT)
    # A picture of another run.
    other = tmp_path / "other"
    keep(other / "studies", "study", text.replace("0.82456", "0.8"), {"doubling": 0.8}, figure)
    shutil.copy(other / "figures" / "study.png", picture)
    assert fingerprint(page) != stamped(picture, FINGERPRINT)


@pytest.mark.slow
def test_special_points_of_figure_2_and_of_the_bifurcation_diagram():
    """Those that no closed form knows, by continuation."""
    kept = headlines(page_of("fig2_frequency_response"))
    base = vi.Scene.ideal(frequency_ratio=0.9)
    ratios = np.array([0.9])
    computed, doubled = {}, {}
    for k in (0.8, 0.5):
        for xi, damping in ((0.0, "undamped"), (headline_numbers.XI, "damped")):
            name, scene = f"k = {k:g}, {damping}", with_numbers(base, k, xi, 0.9)
            forms = _closed_forms(base, np.array([[k, xi]]), ratios, 1)
            branches, ends = _branches(scene, ratios, jax.tree.map(lambda x: x[0], forms))
            computed |= {f"{name}: BB'": (ends[0], 1e-8), f"{name}: CC'": (ends[1], 1e-8)}
            for branch in branches:
                count = branch.impact_speed.shape[1]
                motion = f"{name}, {2 * branch.cycles}π, {count} impact{'s' * (count > 1)}"
                for point in branch.special:
                    at = point.parameter
                    computed[f"{motion}: {point.kind} {at:.3f}"] = (at, 1e-8)
                if (k, xi, branch.cycles, count) == (0.8, 0.0, 2, 1):
                    doubled = {p.parameter: p for p in branch.special if "doubling" in p.kind}
    assert set(computed) == set(kept) and not stale(kept, computed)
    follow = partial(vi.continue_orbit, parameter=RATIO, bounds=(0.5, 1.9), max_step=0.02)
    first, second = (
        next(p.parameter for p in follow(doubled[at].switch(distance=0.003)).special
             if p.kind == "grazing")
        for at in sorted(doubled)
    )  # fmt: skip
    kept = headlines(page_of("bifurcation_diagram"))
    born = {
        "8π motion touches the stop": (first, 1e-8),
        "8π motion touches the stop, upper end": (second, 1e-8),
    }
    assert not stale(kept, born)


@pytest.mark.slow
def test_motors_fold():
    """The fold of Table 1's T0 = 10 N·m, which no closed form knows."""
    motor = vi.Parameters(torque=10.0, control=1.2, restitution=0.5, gap=0.08).scene()
    guess = headline_numbers.closed(1.19, 0.5, headline_numbers.XI, 2.0, cycles=1)
    orbit = vi.find_orbit(motor, motor.start(Y=guess.Y[0], V=guess.V[0], W=1.19), throw=True)
    branch = vi.continue_orbit(orbit, parameter="drive.control", bounds=(0.5, 6.0), max_step=0.2)
    fold = max(p.parameter for p in branch.special if p.kind == "fold")
    kept = headlines(page_of("motor_frequency_response"))
    assert abs(kept["T0 = 10 N·m, gap 2a, run-up: fold, κ"] - fold) < 1e-7
