"""Error messages of the command line: one line, without a traceback."""

import importlib
import sys
from pathlib import Path

import pytest
from vi_jax import cli
from vi_jax.cli import command

AXES = "[scan]\naxes = { drive.frequency_ratio = [0.8, 0.9], stops.0.gap = [1, 2] }\n"
DUFFING = "machine = 'vi_jax.machines:Duffing'\n"
ONE = "\n[simulate]\ncycles = 1\n"

OWN = """
import vi_jax as vi


def dead():
    return vi.machines.BouncingBall(restitution=vi.nothing)


def number(x=1):
    return x
"""


def test_unreadable_files_are_errors(here, capsys):
    Path("folder").mkdir()
    Path("binary.toml").write_bytes(b"\xff\xfe")
    Path("broken.toml").write_text("[scene\n")
    Path("deep.toml").write_text("a = " + "[" * 5000 + "]" * 5000)
    for name in ("nowhere.toml", "folder", "binary.toml", "broken.toml", "deep.toml", "bad\0name"):
        assert cli.main(["scan", name]) == 2
        printed = capsys.readouterr()
        assert not printed.out and printed.err.count("\n") == 1
        assert printed.err.startswith(f"vi-jax: error: {name}: cannot be read: ")


def test_a_byte_order_mark_is_accepted(here):
    Path("file.toml").write_bytes(b"\xef\xbb\xbf" + (DUFFING + ONE).encode())
    assert cli.main(["simulate", "file.toml"]) == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("machine = 3" + ONE, "a machine or a class is module:name or path/to/file.py:name, not 3"),
        ("machine = 'vi_jax.machines:Dufing'" + ONE, "raised AttributeError"),
        ("machine = 'own.py:dead'" + ONE, "raised AttributeError: module 'vi_jax' has no attribute "
         "'nothing' ("),
        ("machine = 'sys:exit'" + ONE, "sys:exit raised SystemExit"),
        (DUFFING + "arguments = {gap = -1, restitutoin = 0.5}" + ONE,
         "unknown key `restitutoin` in [arguments]; near names: restitution"),
        (DUFFING + "arguments = {restitution = 1.5}" + ONE,
         "[arguments]: Argument `restitution` must be finite and in [0, 1], but got 1.5"),
        (DUFFING + "[simulat]", "unknown key `simulat` in the file; near names: simulate"),
        (DUFFING, "missing table [simulate], which holds the arguments"),
        (DUFFING + "[simulate]\ncycle = 1", "unknown key `cycle` in [simulate]; near names: cycle"),
        (DUFFING + "start = {Y = 3}" + ONE, "[simulate]: Argument `start` must not lie beyond"),
        (DUFFING + "method = {class = 'vi_jax:Adaptive', rtol = 2}" + ONE,
         "[simulate]: `method`: Argument `rtol` must be finite and in (0, 1], but got 2"),
        ("[start]\nW = 1" + ONE, "`W` must be left out: a state with drive `IdealDrive` has Y, V"),
    ],
)  # fmt: skip
def test_mistakes_in_a_machine_or_a_table_are_errors(run, here, monkeypatch, text, words):
    (here / "own.py").write_text(OWN)
    monkeypatch.delitem(sys.modules, "own", raising=False)
    said = run("simulate", text, 2)
    assert words in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("verb", "text", "words"),
    [
        ("scan", "[scan]", "missing key `axes` in [scan]"),
        ("scan", "[scan]\naxes.drive.frequncy_ratio = [1]", "near names: drive.frequency_ratio"),
        ("scan", AXES + "measure = 'extrems'", "Argument `measure` must name a measure"),
        ("scan", AXES + "store = 'file.toml/x'", "Argument `store` must be a path"),
        ("scan", "[scan]\naxes.start.Y = {from = 0, to = 1, count = -3}", "is no row of numbers"),
        ("scan", "[scan]\naxes.start.Y = {from = 0, to = 1, n = 3}", "has `from`, `to` and"),
        ("sweep", "[sweep]\nparameter = 'gap'\nvalues = [1]", "near names: stops.0.gap"),
        ("sweep", "[sweep]\nparameter = 'stops.0.gap'\nvalues = [1]\noutput = 'x.txt'",
         "`output` in [sweep] must end in .csv, .nc"),
    ],
)  # fmt: skip
def test_invalid_tables_are_errors_before_any_work(run, here, monkeypatch, verb, text, words):
    def work(*args, **options):
        raise AssertionError("work began")

    for module, name in (
        ("scans._scan", "run_blocks"),
        ("scans._sweep", "_sweep"),
        ("orbit.find", "_find"),
        ("flow._simulate", "_simulate"),
    ):
        if verb == "scan" and name == "_simulate":
            continue  # a scan traces it for the shapes of its results
        monkeypatch.setattr(importlib.import_module(f"vi_jax.{module}"), name, work)
    Path("folder.png").mkdir()
    said = run(verb, text, 2)
    assert words in said and said.count("\n") == 1
    assert {path.name for path in here.iterdir()} == {"file.toml", "folder.png"}


def test_errors_within_the_library_keep_their_traceback(run, monkeypatch):
    def broken(*args, **options):
        raise TypeError("something else")

    monkeypatch.setattr(command, "simulate", broken)
    with pytest.raises(TypeError, match="something else"):
        run("simulate", DUFFING + ONE)
