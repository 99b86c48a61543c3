"""Files for the command line: what is read, what is refused and how, and every verb once."""

import csv
import dataclasses
import importlib
import tomllib
from pathlib import Path

import numpy as np
import pytest
import vi_jax as vi
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from vi_jax import cli
from vi_jax.cli import checks, config, verbs
from vi_jax.cli.toml import ConfigError, keys_of, read_toml
from vi_jax.machine.numbers import leaf, leaf_names

READY = sorted((Path(__file__).parents[1] / "experiments").glob("*.toml"))

IDEAL = """
[scene]
frequency_ratio = 0.9
damping_ratio = 0.05
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(text, path="file.toml"):
    Path(path).write_text(text, encoding="utf-8")
    return path


def problems_of(text):
    """The sentences with which a file is refused, from reading it or building its scene."""
    with pytest.raises(ConfigError) as refused:
        config.read(written(text)).build()
    return refused.value.problems


# What is read -----------------------------------------------------------------------------------

numbers = st.floats(0.01, 0.99).map(lambda x: round(x, 6))
SI = sorted(field.name for field in dataclasses.fields(vi.Parameters))


@settings(deadline=None, max_examples=30)
@given(machine=st.dictionaries(st.sampled_from(SI), numbers, max_size=6))
def test_any_machine_is_read_as_it_is_written(tmp_path_factory, machine):
    path = tmp_path_factory.mktemp("machine") / "file.toml"
    text = "".join(f"{key} = {value!r}\n" for key, value in machine.items())
    path.write_text("[parameters]\n" + text)
    table = config.read(path).parameters
    assert table is not None
    assert {name: getattr(table, name) for name in machine} == machine
    scene, wanted = table.build(), vi.Parameters(**machine).scene(drive="motor")
    for name in leaf_names(wanted):
        assert float(leaf(scene, name)) == float(leaf(wanted, name))


def test_the_machine_has_the_keys_of_parameters():
    assert set(keys_of(config.ParametersTable)) == {*SI, "drive", "crank", "clock"}


@settings(deadline=None, max_examples=30)
@given(low=numbers, high=numbers, count=st.integers(1, 20), quoted=st.booleans())
def test_ranges_and_names(tmp_path_factory, low, high, count, quoted):
    name = "stops.0.gap"
    key = f'"{name}"' if quoted else name
    path = tmp_path_factory.mktemp("axes") / "file.toml"
    path.write_text(f"[axes]\n{key} = {{ from = {low}, to = {high}, count = {count} }}\n")
    axes = config.read(path).axes
    assert axes is not None and list(axes) == [name]
    np.testing.assert_array_equal(axes[name], np.linspace(low, high, count))


def test_whole_numbers_are_numbers(here):
    file = config.read(written(IDEAL + "gap = 1\n[axes]\ndrive.frequency_ratio = [1, 2]"))
    assert file.axes == {"drive.frequency_ratio": (1.0, 2.0)}
    assert float(file.build()[0].stops[0].gap) == 1.0


def test_scenes(here):
    scene, start, method = config.read(written(IDEAL)).build()
    assert start is None and method is None
    assert [(s.side, float(s.gap), float(s.restitution)) for s in scene.stops] == [
        ("right", 2.0, 0.5)
    ]
    text = """
    [scene]
    drive = "motor"
    motor = { strength = 1.0, control = 0.8, coupling = 0.1, slider_inertia = 0.05 }
    restitution = 0.6
    crank = "slider"
    crank_ratio = 0.3
    clock = "time"
    [[scene.stops]]
    gap = 1.5
    [[scene.stops]]
    side = "left"
    gap = 1.0
    restitution = 0.2
    [start]
    Y = 0.25
    [method]
    name = "fixed-step"
    solver = "Tsit5"
    steps_per_cycle = 20
    """
    scene, start, method = config.read(written(text)).build()
    assert isinstance(scene.drive, vi.Motor) and float(scene.drive.control) == 0.8
    assert isinstance(scene.crank, vi.SliderCrank) and float(scene.crank.ratio) == 0.3
    assert [(s.side, float(s.restitution)) for s in scene.stops] == [("right", 0.6), ("left", 0.2)]
    assert isinstance(start, vi.TimedMotorState) and float(start.W) == 0.8
    assert isinstance(method, vi.FixedStep) and method.steps_per_cycle == 20
    lagging = text.replace(
        "slider_inertia = 0.05 }", "slider_inertia = 0.05, electrical_time = 0.2 }"
    )
    scene, start, _ = config.read(written(lagging + "[simulate]\ncycles = 1")).build()
    assert isinstance(scene.drive, vi.DCMotor) and float(scene.drive.electrical_time) == 0.2
    assert isinstance(start, vi.TimedDCMotorState) and float(start.M) == 0.0
    switched_on = lagging.replace("Y = 0.25", "W = 0\nM = 0.125")
    assert float(config.read(written(switched_on)).build()[1].M) == 0.125
    assert not config.read(written(IDEAL + "stops = []")).build()[0].stops


def test_methods(here):
    def method(text):
        return config.read(written(f"{IDEAL}[method]\n{text}")).build()[2]

    assert isinstance(method('name = "exact-flight"'), vi.ExactFlight)
    adaptive = method('name = "adaptive"\nrtol = 1e-7')
    assert isinstance(adaptive, vi.Adaptive) and float(adaptive.rtol) == 1e-7
    implicit = method('name = "adaptive"\nsolver = "Kvaerno5"')
    assert isinstance(implicit, vi.Adaptive) and implicit.solver.implicit
    series = method('name = "taylor"\norder = 12\nsteps_per_cycle = 6')
    assert isinstance(series, vi.Taylor) and (series.order, series.steps_per_cycle) == (12, 6)
    with pytest.raises(config.ConfigError, match=r"\[method\].*explicit"):
        method('name = "fixed-step"\nsolver = "Kvaerno5"')


@pytest.mark.parametrize("path", READY, ids=lambda path: path.stem)
def test_ready_files(path):
    file = config.read(path)
    scene, _, _ = file.build()
    for verb in verbs.VERBS:
        if getattr(file, verb) is not None:
            break
    else:
        raise AssertionError("no verb")
    checks.check_names(scene, file.axes or (), "[axes]", start=True)
    assert f"vi-jax {verb} experiments/{path.name}" in path.read_text()


def test_there_are_ready_files():
    assert {"regimes", "basins", "frequency_response"} <= {path.stem for path in READY}


# What is refused --------------------------------------------------------------------------------


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


def test_an_editors_mark_is_no_fault(here):
    Path("file.toml").write_bytes(b"\xef\xbb\xbf" + IDEAL.encode())
    scene, _, _ = config.read("file.toml").build()
    assert float(scene.drive.frequency_ratio) == 0.9


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


AXES = "[axes]\ndrive.frequency_ratio = [0.8, 0.9]\nstops.0.gap = [1, 2]\n"


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
        ("scan.scan", "run_here"),
        ("scan.sweep", "_sweep"),
        ("orbit.find", "_find"),
        ("flow.simulate", "_simulate"),
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


# Every verb -------------------------------------------------------------------------------------


def ran(capsys, verb, text, code=0):
    assert cli.main([verb, written(IDEAL + text)]) == code
    return capsys.readouterr().out


def rows(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def is_png(path):
    return Path(path).read_bytes()[:4] == b"\x89PNG"


def test_simulate(here, capsys):
    text = (
        "[simulate]\ncycles = 4\nsettle = 60\nsamples = 8\noutput = 'new/m.csv'\npicture = 'm.png'"
    )
    out = ran(capsys, "simulate", text)
    assert "Run of 4 cycles" in out and "new/m.csv" in out and is_png("m.png")
    table = rows("new/m.csv")
    assert list(table[0]) == ["cycles", "time", "Y", "V"] and len(table) == 33
    scene = vi.Scene.ideal(frequency_ratio=0.9, damping_ratio=0.05)
    run = vi.simulate(scene, scene.start(), 4, settle=60, method=vi.ExactFlight())
    np.testing.assert_allclose([float(r["Y"]) for r in table[::8]], run.sections.Y, atol=1e-12)


def test_simulate_cycle_by_cycle_and_failing(here, capsys):
    text = "[simulate]\ncycles = 3\nsettle = 60\noutput = 'm.csv'\n"
    ran(capsys, "simulate", text)
    table = rows("m.csv")
    assert [row["cycle"] for row in table] == ["1", "2", "3"] and table[0]["impacts"] == "1"
    assert "`max_steps`" in ran(capsys, "simulate", text + "max_steps = 5", code=1)


SCAN = (
    "[axes]\ndrive.frequency_ratio = [0.8, 0.9]\nstart.Y = [0.0, 1.0, 2.5]\n[scan]\nsettle = 60\n"
)


def test_scan(here, capsys):
    out = ran(capsys, "scan", SCAN)
    assert "Scan of 6 motions over drive.frequency_ratio (2: 0.8 … 0.9), start.Y" in out
    assert "failed: 2 of 6 motions" in out and "2: The start or a number of the machine" in out
    assert "<xarray.Dataset>" in out and "Nothing was written" in out
    assert [path.name for path in here.iterdir()] == ["file.toml"]
    out = ran(capsys, "scan", SCAN + "store = 'new/s.zarr'\npicture = 's.png'")
    assert "new/s.zarr" in out and "<xarray.Dataset>" not in out and is_png("s.png")
    data = xr.open_zarr("new/s.zarr")
    scene = vi.Scene.ideal(frequency_ratio=0.8, damping_ratio=0.05)
    run = vi.simulate(scene, scene.start(), 128, settle=60, method=vi.ExactFlight())
    assert float(data["y_min"][0, 0]) == pytest.approx(float(np.min(run.y_min)), abs=1e-12)
    again = ran(capsys, "scan", SCAN + "store = 'new/s.zarr'\npicture = 's.png'")
    assert again == out
    assert cli.main(["scan", written(IDEAL + SCAN + "store = 'new/s.zarr'\ncycles = 200")]) == 2
    assert "the cycles is 128, and now it is 200" in capsys.readouterr().err


def test_interrupted_scans_tell_how_to_go_on(here, capsys, monkeypatch):
    def interrupt(*args, **options):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(importlib.import_module("vi_jax.scan.scan"), "run_here", interrupt)
    assert cli.main(["scan", written(IDEAL + SCAN)]) == 130
    assert "nothing was kept" in capsys.readouterr().err.splitlines()[-1]
    assert cli.main(["scan", written(IDEAL + SCAN + "store = 's.zarr'")]) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "vi-jax: interrupted; the same command goes on from what is in s.zarr"


def test_sweep(here, capsys):
    text = """[sweep]
    parameter = "drive.frequency_ratio"
    values = { from = 1.2, to = 1.7, count = 11 }
    up_and_down = true
    settle = 100
    picture = "s.png"
    output = "s.csv"
    """
    out = ran(capsys, "sweep", text)
    name = "Sweep of drive.frequency_ratio, 11 values"
    assert f"up: {name}:\n  2π with 1 impact from 1.2\n" in out
    assert f"down: {name}:\n  2π with 0 impacts from 1.7\n" in out
    assert out.count(", jump since ") == 2
    assert is_png("s.png")
    table = rows("s.csv")
    assert [row["direction"] for row in table] == ["up"] * 11 + ["down"] * 11
    assert {row["result"] for row in table} == {"completed"}
    up = {row["values"]: float(row["y_min"]) for row in table[:11]}
    down = {row["values"]: float(row["y_min"]) for row in table[11:]}
    assert up.keys() == down.keys()
    # The resonance bends to the right: between the jumps the way back is another.
    assert max(abs(up[value] - down[value]) for value in up) > 0.5
    assert down[table[10]["values"]] == pytest.approx(up[table[10]["values"]], abs=1e-4)


def test_basins(here, capsys):
    text = """[basins]
    region = { start.Y = [0.05, 4.05], start.V = [-1, 1] }
    resolution = [4, 3]
    settle = 200
    picture = "b.png"
    output = "b.csv"
    """
    out = ran(capsys, "basins", text)
    assert "failed: 6 of 12 starts" in out and "period 2π, 1 impact," in out and is_png("b.png")
    table = rows("b.csv")
    assert sorted(row["label"] for row in table) == ["-3"] * 6 + ["0"] * 6
    assert {row["start.Y"] for row in table} == {"0.55", "1.55", "2.55", "3.55"}


@pytest.mark.slow
def test_orbit_and_its_branch(here, capsys):
    text = """[orbit]
    guess = { Y = 1.9, V = 1.54 }
    picture = "o.png"
    [orbit.continue]
    parameter = "drive.frequency_ratio"
    bounds = [0.88, 0.92]
    picture = "c.png"
    output = "c.csv"
    """
    out = ran(capsys, "orbit", text)
    assert "Orbit of period 2π with 1 impact, stable" in out and "Branch of " in out
    assert is_png("o.png") and is_png("c.png")
    table = rows("c.csv")
    ends = sorted((float(table[0]["parameter"]), float(table[-1]["parameter"])))
    np.testing.assert_allclose(ends, [0.88, 0.92], atol=1e-12)
    assert {"y_min", "y_max", "clearance", "stable"} <= set(table[0])


def test_an_orbit_that_is_not_found(here, capsys):
    text = "[orbit]\nguess = { Y = 1.9, V = 1.54 }\nroot_finder = 'gradient'\nmax_steps = 3"
    assert "No orbit" in ran(capsys, "orbit", text, code=1)


def test_help_lists_the_keys(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["orbit", "--help"])
    assert ended.value.code == 0
    out = " ".join(capsys.readouterr().out.split())
    assert (
        "keys of [orbit]: cycles, guess, root_finder" in out and "keys of [orbit.continue]:" in out
    )


def test_the_example_of_the_module_is_valid(here):
    lines = (config.__doc__ or "").splitlines()
    text = "\n".join(line[4:] for line in lines if line.startswith("    "))
    tomllib.loads(text)
    file = read_toml(written(text.replace("[method]", "")), config.Config)
    assert file.machine is not None and file.machine.build().half_gap == 2
    assert file.axes is not None and list(file.axes) == ["stops.0.restitution"]


def test_a_ready_machine_and_one_of_ones_own(here, capsys):
    own = "import vi_jax as vi\n\n\ndef ball():\n    return vi.machines.BouncingBall()\n"
    own += "\n\ndef dead():\n    return vi.machines.BouncingBall(restitution=-1)\n"
    (here / "shaken.py").write_text(own)
    asked = written("[simulate]\ncycles = 3")
    assert cli.main(["simulate", str(asked), "--machine", "shaken:ball"]) == 0
    assert "Run of 3 cycles" in capsys.readouterr().out
    ready = written(
        "[machine]\nname = 'BouncingBall'\n[start]\nspeed = 1.5\n[simulate]\ncycles = 3"
    )
    assert cli.main(["simulate", str(ready)]) == 0
    for name, sentence in (
        ("shaken:bell", "cannot be found"),
        ("nowhere:ball", "cannot be found"),
        ("shaken", "must be package.module:function"),
        ("os:system", "must be a function without arguments"),
        ("math:pi", "must be a function without arguments"),
        ("sys:exit", "raised SystemExit"),
        ("os:getcwd", "must return a machine"),
        ("shaken:dead", "shaken.py, line 9)"),
    ):
        assert cli.main(["simulate", str(asked), "--machine", name]) == 2
        assert sentence in capsys.readouterr().err
    assert cli.main(["simulate", str(ready), "--machine", "shaken:ball"]) == 2
    assert "beside --machine" in capsys.readouterr().err


def test_soft_stops(here):
    text = IDEAL + "[[scene.soft_stops]]\ngap = 2.0\nstiffness = 50.0\nrestitution = 0.5"
    scene, _, _ = config.read(written(text)).build()
    assert isinstance(scene, vi.Scene) and not scene.stops
    assert float(scene.soft_stops[0].damping) == pytest.approx(0.43090752, abs=1e-8)
