"""Files for the command line: what is refused, and in which words."""

import importlib
from pathlib import Path

import pytest
from vi_jax import cli
from vi_jax.cli import config, verbs
from vi_jax.cli.toml import ConfigError

from toml_files import IDEAL, written

AXES = "[axes]\ndrive.frequency_ratio = [0.8, 0.9]\nstops.0.gap = [1, 2]\n"


def problems_of(text):
    """The sentences with which a file is refused, from reading it or building its scene."""
    with pytest.raises(ConfigError) as refused:
        config.read(written(text)).build()
    return refused.value.problems


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[scene]\nfrequency_ratio = 1\nrestitition = 0.5",
         "unknown key `restitition` in [scene]; near names: restitution"),
        ("[scen]\n", "unknown table `scen` in the file; near names: scene, scan"),
        ("[scene]\nfrequency_ratio = '0.9'",
         '`frequency_ratio` in [scene] must be a number, but is "0.9"'),
        ("[scene]\nfrequency_ratio = true",
         "`frequency_ratio` in [scene] must be a number, but is true"),
        ("[scene]\nfrequency_ratio = [1]",
         "`frequency_ratio` in [scene] must be a number, but is [1]"),
        ("scene = 3", "[scene] must be a table, but is 3"),
        ("[scene]\ncrank = 'slidr'",
         '`crank` in [scene] must be one of "cosine", "slider", but is "slidr"'),
        ("[scene]\n[[scene.stops]]\ngap = 1\n[[scene.stops]]\nside = 'left'",
         "missing key `gap` in [[scene.stops]] number 2"),
        ("[[scene.stops]]\ngap = 'x'",
         '`gap` in [[scene.stops]] number 1 must be a number, but is "x"'),
        ("[scan]\nsettle = 1.5", "`settle` in [scan] must be a whole number, but is 1.5"),
        ("[scan]\nmeasure = ['regime', 2]",
         "item 2 of `measure` in [scan] must be a text in quotes, but is 2"),
        ("[scan]\npaired = 1", "`paired` in [scan] must be true or false, but is 1"),
        ("[sweep]\nvalues = [1, 2]", "missing key `parameter` in [sweep]"),
        ("[orbit.continue]\nparameter = 'x'\nbounds = [1]",
         "`bounds` in [orbit.continue] must be a list of 2, but is [1]"),
        ("[axes]\na.b = {from = 1, to = 2, cout = 3}",
         "`a.b` in [axes] must have the keys from, to and count, but has from, to, cout"),
        ("[axes]\na = {from = 1, to = 2, count = 0}",
         "`a` in [axes] must have a count of at least 1 and at most 10000000, but it is 0"),
        ("[axes]\na = []", "`a` in [axes] must be a list of numbers or { from = …, to = …, "
         "count = … }, but is []"),
        ("axes = 1", "[axes] must be a table, but is 1"),
        ("[axes]\na = [1, nan]", "item 2 of `a` in [axes] must be a finite number, but is nan"),
        ("[axes]\na = {from = 1, to = inf, count = 3}",
         "`a` in [axes] must be a finite number, but is inf"),
        ("[axes]\na = {from = 1, to = 2, count = 100000000}",
         "`a` in [axes] must have a count of at least 1 and at most 10000000, but it is 100000000"),
        ("[sweep]\nparameter = 'x'\nvalues = [inf]",
         "item 1 of `values` in [sweep] must be a finite number, but is inf"),
        ("[simulate]\ncycles = 99999999999999999999", "`cycles` in [simulate] must be a whole "
         "number up to 2147483647, but is 99999999999999999999"),
        (f"[scene]\nfrequency_ratio = 1{'0' * 400}",
         "`frequency_ratio` in [scene] must be a number below 1.8e308, but is a longer one"),
        ('[scan]\nstore = "a\\u0000b"',
         "`store` in [scan] must be a text without null characters, but is 'a\\x00b'"),
        ("scene = " + "[" * 5000 + "]" * 5000, "the file is nested too deeply"),
        ("[basins]\nregion = {start.Y = [0, '1']}",
         'item 2 of `start.Y` in [basins.region] must be a number, but is "1"'),
    ],
)  # fmt: skip
def test_what_cannot_be_read(here, text, sentence):
    assert sentence in problems_of(text)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "the file must hold [scene], [parameters] or [machine], but holds none of them"),
        (IDEAL + "[parameters]", "the file must hold [scene], [parameters] or [machine], but holds "
         "[scene] and [parameters]"),
        ("[model]\nname = 'ImpactPair'", "[model] is called [machine] now"),
        ("[machine]\ngap = 0.08\ntorque = 10", "`gap` in [machine]: the SI numbers of the "
         "paper's machine are in [parameters] now"),
        ("[machine]\nname = 'ImpactPear'",
         "unknown machine `ImpactPear` in [machine]; near names: ImpactPair"),
        ("[machine]\nname = 'ImpactPair'\nnumbers = {gap = 2.0}",
         "unknown number `gap` in [machine.numbers]; near names: half_gap"),
        ("[machine]\nname = 'ImpactPair'\nnumbers = {half_gap = -2.0}",
         "`half_gap` in [machine.numbers] must be finite and in (0, inf), but got -2.0"),
        ("[scene]", 'missing key `frequency_ratio` in [scene]: drive = "ideal"'),
        ("[scene]\ndrive = 'motor'\nfrequency_ratio = 1",
         'unfitting key `frequency_ratio` in [scene]: drive = "motor"'),
        (IDEAL + "gap = 1\n[[scene.stops]]\ngap = 1",
         "[scene] must hold `gap` or [[scene.stops]], but holds both"),
        (IDEAL + "crank = 'slider'", '`crank_ratio` in [scene] must stand beside crank = "slider"'),
        (IDEAL + "restitution = 1.5",
         "`restitution` in [scene] must be finite and in [0, 1], but got 1.5"),
        (IDEAL + "[[scene.stops]]\ngap = nan",
         "`gap` in [[scene.stops]] number 1 must be finite and in (-inf, inf), but got nan"),
        ("[parameters]\ninertia = 0",
         "`inertia` in [parameters] must be finite and in (0, inf), but got 0.0"),
        (IDEAL + "[start]\nW = 1", "`W` in [start] must be left out: an ideal drive turns at its "
         "frequency ratio, but got W=1.0"),
        (IDEAL + "[start]\nM = 1", "`M` in [start] must be left out: only a `DCMotor` has a torque "
         "of its own, but got M=1.0"),
        ("[parameters]\nelectrical_time = 0",
         "`electrical_time` in [parameters] must be finite and in (0, inf), but got 0.0"),
        (IDEAL + "[method]\nname = 'exact-flight'\nrtol = 1e-6",
         '`rtol` in [method] does not belong to name = "exact-flight"'),
        (IDEAL + "[method]\nname = 'adaptive'\nsolver = 'Dopri9'",
         "unknown solver `Dopri9` in [method]; near names: Dopri8, Dopri5"),
        (IDEAL + "[method]\nname = 'adaptive'\nrtol = 2",
         "`rtol` in [method] must be finite and in (0, 1], but got 2.0"),
    ],
)  # fmt: skip
def test_what_makes_no_scene(here, text, sentence):
    problems = problems_of(text)
    assert sentence in problems, problems


def test_every_fault_is_told(here):
    problems = problems_of("[scene]\nrestitition = 1\nfrequency_ratio = 'x'\n[scan]\nsettle = 'y'")
    assert len(problems) == 3


def test_files_that_are_none(here, capsys):
    Path("folder").mkdir()
    Path("binary.toml").write_bytes(b"\xff\xfe")
    written("[scene\n", "broken.toml")
    for name, words in {
        "nowhere.toml": "No such file",
        "folder": "folder: the file cannot be read",
        "binary.toml": "cannot be read",
        "broken.toml": "is not valid TOML",
        "bad\0name": "null",
    }.items():
        assert cli.main(["scan", name]) == 2
        printed = capsys.readouterr()
        assert not printed.out and printed.err.count("\n") == 1
        assert printed.err.startswith("vi-jax: error: ") and words in printed.err


@pytest.mark.parametrize(
    ("verb", "text", "words"),
    [
        ("scan", "", "missing table [scan]"),
        ("scan", "[scan]", "missing table [axes]"),
        ("scan", "[scan]\n[axes]\ndrive.frequncy_ratio = [1]", "near names: drive.frequency_ratio"),
        ("scan", AXES + "[scan]\nmeasure = 'extrems'", "`measure` in [scan] must name a measure"),
        ("scan", AXES + "[scan]\ncycles = 3", "`cycles` in [scan] must be at least 128"),
        ("scan", "[axes]\nstops.0.restitution = [2]\n[scan]",
         "[scan]: `restitution` must be finite"),
        ("scan", AXES + "[scan]\nderivatives = 'gap'", "near names: stops.0.gap"),
        ("scan", AXES + "[scan]\npicture = 'x.jpg'", "must end in .png, .pdf, .svg, but"),
        ("scan", AXES + "[scan]\npicture = 'file.toml/x.png'", "`picture` in [scan] cannot be"),
        ("scan", AXES + "[scan]\npicture = 'folder.png'", "it is a folder"),
        ("scan", AXES + "[scan]\nmeasure = 'frequency_ratio'\npicture = 'x.png'", 'needs "regime"'),
        ("scan", "[axes]\nstart.Y = [1]\n[scan]\npicture = 'x.png'", "two axes, but there are 1"),
        ("scan", AXES + "[scan]\nstore = 'file.toml/x'", "`store` in [scan] must be a path"),
        ("scan", AXES + "[scan]\nstore = 'full'", "`store` in [scan] must be a new folder"),
        ("sweep", "[sweep]\nparameter = 'gap'\nvalues = [1]", "near names: stops.0.gap"),
        ("sweep", "[sweep]\nparameter = 'stops.0.restitution'\nvalues = [0.5, 1.1]",
         "`values` in [sweep]: `restitution` must be finite and in [0, 1], but got 1.1"),
        ("sweep", "[sweep]\nparameter = 'stops.0.gap'\nvalues = [1]\noutput = 'x.txt'",
         "`output` in [sweep] must end in .csv"),
        ("basins", "[basins]\nregion = {Y = [0, 1]}", "near names: start.Y"),
        ("basins", "[basins]\nregion = {start.Y = [1, 0]}",
         "`region` in [basins] must give ranges"),
        ("basins", "[basins]\npicture = 'x.png'\nregion = {start.Y = [0, 1]}", "two parts"),
        ("scan", "[axes]\nstart.Y = {from = 0, to = 1, count = 1000000}\n"
         "start.V = {from = 0, to = 1, count = 1000000}\n[scan]",
         "[axes] must ask for results that fit into the memory"),
        ("scan", AXES + "[scan]\ncycles = 2000000000", "`cycles` in [scan] must"),
        ("simulate", "[simulate]\ncycles = 2000000000", "`cycles` in [simulate] must ask for"),
        ("simulate", "[simulate]\ncycles = 1\noutput = '" + "a" * 400 + ".csv'",
         "File name too long"),
        ("basins", "[basins]\nregion = {start.Y = [0, 1]}\nsamples = 3\nseed = -1",
         "`seed` in [basins] must be at least 0"),
        ("basins", "[basins]\nregion = {start.Y = [0, 1]}\napart = 0", "`apart` in [basins] must"),
        ("orbit", "[orbit]\ncycles = 3\narcs = 2",
         "[orbit] must have a number of arcs that divides the 3 cycles, but has 2 arcs"),
        ("orbit", "[orbit.continue]\nparameter = 'stops.0.gap'\nbounds = [1, 3]\nstep = 0",
         "`step` in [orbit.continue] must be finite and in (0, inf), but got 0.0"),
        ("orbit", "[orbit.continue]\nparameter = 'stops.0.gap'\nbounds = [1, 3]\nmax_step = nan",
         "`max_step` in [orbit.continue] must be finite"),
        ("orbit", "[orbit]\nroot_finder = 'newtn'",
         '`root_finder` in [orbit] must be one of "newton"'),
        ("orbit", "[orbit]\ntolerance = -1", "`tolerance` in [orbit] must be finite"),
        ("orbit", "[orbit]\nguess = {W = 1}", "`W` in `guess` in [orbit] must be left out"),
        ("orbit", "[orbit.continue]\nparameter = 'drive.frequency_ratio'\nbounds = [1, 2]",
         "must hold the machine's drive.frequency_ratio = 0.9"),
        ("simulate", "[simulate]\ncycles = 0", "`cycles` in [simulate] must be at least 1"),
        ("simulate", "[simulate]\ncycles = 1\n[start]\nY = 3",
         "[start] must not lie beyond a stop"),
        ("simulate", "[simulate]\ncycles = 1\nsamples = 0\npicture = 'x.png'", "`samples` in"),
    ],
)  # fmt: skip
def test_what_cannot_be_done_is_said_before_any_work(here, capsys, monkeypatch, verb, text, words):
    def work(*args, **options):
        raise AssertionError("work began")

    for module, name in (
        ("scans._computed", "run_here"),
        ("scans._sweep", "_sweep"),
        ("orbit.find", "_find"),
        ("flow._simulate", "_simulate"),
    ):
        if verb == "scan" and name == "_simulate":
            continue  # traced for the shapes of what will be stored
        monkeypatch.setattr(importlib.import_module(f"vi_jax.{module}"), name, work)
    Path("folder.png").mkdir()
    Path("full").mkdir()
    written("mine", "full/letter.txt")
    assert cli.main([verb, written(IDEAL + text)]) == 2
    printed = capsys.readouterr()
    assert words in printed.err.splitlines()[-1] and not printed.out
    assert {path.name for path in here.iterdir()} == {"file.toml", "folder.png", "full"}


def test_a_fault_of_the_library_is_not_taken_for_the_users(here, monkeypatch):
    def broken(*args, **options):
        raise TypeError("something else")

    monkeypatch.setattr(verbs, "simulate_in_parts", broken)
    with pytest.raises(TypeError, match="something else"):
        cli.main(["simulate", written(IDEAL + "[simulate]\ncycles = 1")])
