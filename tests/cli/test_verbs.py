"""Every verb of the command line once: what it prints, writes and draws."""

import csv
import importlib
from pathlib import Path

import numpy as np
import pytest
import vi_jax as vi
import xarray as xr
from vi_jax import cli

from toml_files import IDEAL, written


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

    monkeypatch.setattr(importlib.import_module("vi_jax.scans._computed"), "run_here", interrupt)
    assert cli.main(["scan", written(IDEAL + SCAN)]) == 130
    assert "nothing was kept" in capsys.readouterr().err.splitlines()[-1]
    assert cli.main(["scan", written(IDEAL + SCAN + "store = 's.zarr'")]) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "vi-jax: interrupted; the same command goes on from what is in s.zarr"


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
