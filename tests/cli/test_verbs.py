"""The version and all verbs of the command line, also with delays: output, files and pictures."""

import csv
import importlib
import os
import signal
import sys
from importlib import metadata
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import vi_jax as vi
import xarray as xr
from vi_jax import cli
from vi_jax.cli import command

from differences import quick

READY = sorted((Path(__file__).parents[2] / "experiments").glob("*.toml"))

OWN = """
import jax.numpy as jnp
import vi_jax as vi


class Body(vi.AbstractMachine):
    omega: float = 0.9
    contacts: tuple = (vi.RigidStop(1.0, 0.7),)

    @property
    def cycle(self):
        return 2 * jnp.pi / self.omega

    def field(self, s, x):
        return vi.OscillatorState(x.V, jnp.cos(self.omega * s) - x.Y - 0.1 * x.V)


class Started(Body):
    def start(self):
        return vi.OscillatorState(0.2, 0.1)


class Named(Body):
    def field(self, s, z):
        return dict(x=z.u, u=jnp.cos(self.omega * s) - z.x - 0.1 * z.u)

    contacts: tuple = (vi.RigidStop(1.0, 0.7, on=("x", "u")),)
"""

BODY = """
[simulate]
cycles = 3
settle = 20
picture = "new/m.png"
output = "new/m.csv"
[scan]
axes = { omega = [0.8, 1], contacts.0.gap = [0.9, 1] }
settle = 40
picture = "s.png"
"""


def rows(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def is_png(path):
    return Path(path).read_bytes()[:4] == b"\x89PNG"


def test_simulate_samples_and_cycles(run):
    text = "[simulate]\ncycles = 4\nsettle = 60\noutput = 'new/m.csv'\npicture = 'm.png'\n"
    out = run("simulate", text + "samples = 8")
    assert "Run of 4 cycles" in out and "new/m.csv" in out and is_png("m.png")
    table = rows("new/m.csv")
    assert list(table[0]) == ["sample", "sample_Y", "sample_V", "sample_time"] and len(table) == 33
    scene = vi.Scene.ideal(frequency_ratio=0.9, damping_ratio=0.05)
    whole = vi.simulate(scene, scene.start(), 4, settle=60)
    Y = [float(row["sample_Y"]) for row in table[::8]]
    np.testing.assert_allclose(Y, whole.sections.Y, atol=1e-12)
    run("simulate", text)
    table = rows("new/m.csv")
    assert [row["cycle"] for row in table] == ["1", "2", "3", "4"] and table[0]["impacts"] == "1"
    assert float(table[3]["section_Y"]) == pytest.approx(float(whole.last.Y), abs=1e-12)
    assert "`max_steps`" in run("simulate", text + "max_steps = 5", 1)


def test_scan(run):
    text = "[scan]\nsettle = 60\n"
    text += "axes = {drive.frequency_ratio = [0.8, 0.9], start.Y = [0, 1, 2.5]}\n"
    out = run("scan", text)
    assert "Scan of 6 motions over drive.frequency_ratio (2), start.Y (3)" in out
    assert "  period 2π: " in out and "warning: 2 of 6 lanes failed (bad_start: 2)" in out
    assert "<xarray.Dataset>" in out and os.listdir() == ["file.toml"]
    asked = text + "store = 'new/s.zarr'\npicture = 's.png'\noutput = 's.nc'"
    out = run("scan", asked)
    assert "new/s.zarr" in out and is_png("s.png")
    data = xr.open_zarr("new/s.zarr")
    scene = vi.Scene.ideal(frequency_ratio=0.8, damping_ratio=0.05)
    whole = vi.simulate(scene, scene.start(), 128, settle=60)
    assert float(data["y_min"][0, 0]) == pytest.approx(float(np.min(whole.y_min)), abs=1e-12)
    with xr.open_dataset("s.nc") as kept:
        np.testing.assert_array_equal(kept["y_min"], data["y_min"])
    assert run("scan", asked) == out
    said = run("scan", text + "store = 'new/s.zarr'\ncycles = 200", 2)
    assert "the cycles is 128, and now it is 200" in said


def test_the_message_of_an_interrupted_scan_names_its_store(run, capsys, monkeypatch):
    def interrupt(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module("vi_jax.scans._scan"), "run_blocks", interrupt)
    text = "[scan]\naxes.start.Y = [0.0, 1.0]\n"
    Path("file.toml").write_text("machine = 'vi_jax.machines:Duffing'\n" + text)
    assert cli.main(["scan", "file.toml"]) == 130
    assert "nothing was written" in capsys.readouterr().err.splitlines()[-1]
    Path("file.toml").write_text("machine = 'vi_jax.machines:Duffing'\n" + text + "store = 's'")
    assert cli.main(["scan", "file.toml"]) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "vi-jax: interrupted; the same command goes on from what is in s"


@pytest.mark.slow
def test_sweep(run):
    out = run("sweep", """[sweep]
        parameter = "drive.frequency_ratio"
        values = { from = 1.2, to = 1.7, count = 11 }
        settle = 100
        picture = "s.png"
        output = "s.csv"
        """)  # fmt: skip
    name = "Sweep of drive.frequency_ratio, 11 values"
    assert f"{name}:\n  2π with 1 impact from 1.2 ω\n" in out
    assert out.count(", large change since ") == 1 and is_png("s.png")
    table = rows("s.csv")
    assert {row["result"] for row in table} == {"successful"}
    scene = vi.Scene.ideal(frequency_ratio=0.8, damping_ratio=0.05)
    found = vi.sweep(scene, "drive.frequency_ratio", np.linspace(1.2, 1.7, 11), settle=100)
    np.testing.assert_allclose([float(row["y_min"]) for row in table], found.y_min, atol=1e-12)


@pytest.mark.slow
def test_basins(run):
    out = run("basins", """[basins]
        region = { start.Y = [0.05, 4.05], start.V = [-1, 1] }
        resolution = [4, 3]
        settle = 200
        picture = "b.png"
        output = "b.csv"
        """)  # fmt: skip
    assert "failed: 50.00 %" in out and "period 2π, 1 impact," in out and is_png("b.png")
    table = rows("b.csv")
    assert sorted(row["label"] for row in table) == ["-3"] * 6 + ["0"] * 6
    assert {row["start.Y"] for row in table} == {"0.55", "1.55", "2.55", "3.55"}


@pytest.mark.slow
def test_orbit_and_its_branch(run):
    text = """[orbit]
        guess = { Y = 1.9, V = 1.54 }
        picture = "o.png"
        output = "o.csv"
        root_finder = { class = "vi_jax:Newton", tolerance = 1e-9 }
        [continue]
        parameter = "drive.frequency_ratio"
        bounds = [0.88, 0.92]
        picture = "c.png"
        output = "c.csv"
        """
    out = run("continue", text)
    assert "Orbit of period 2π with 1 impact, stable" in out and "Branch of " in out
    assert is_png("o.png") and is_png("c.png")
    (motion,) = rows("o.csv")
    scene = vi.Scene.ideal(frequency_ratio=0.9, damping_ratio=0.05)
    speed = float(vi.closed_form_orbits(scene).impact_speed[0])
    lost = 0.5 * (1 - float(scene.stops[0].restitution) ** 2) * speed**2
    assert float(motion["impact_energy"]) == pytest.approx(lost, abs=1e-8)
    assert motion["stability"] == "stable" and motion["impacts"] == "1"
    table = rows("c.csv")
    ends = sorted(float(row["drive.frequency_ratio"]) for row in (table[0], table[-1]))
    np.testing.assert_allclose(ends, [0.88, 0.92], atol=1e-12)
    assert {"y_min", "y_max", "clearance", "stable", "section_Y"} <= set(table[0])
    os.remove("o.png")
    failing = text.replace("tolerance = 1e-9", "max_steps = 1")
    assert "No orbit" in run("continue", failing, 1) and not os.path.exists("o.png")


HEADS = [
    'machine = "mine.py:Started"\n[start]\nY = 0.3\n',
    'machine = "mine:Body"\n[start]\nclass = "vi_jax:OscillatorState"\nY = 0\nV = 0\n',
    'machine = "mine:Named"\n[start]\nx = 0.0\nu = 0\n',
]


@pytest.mark.parametrize("head", quick(HEADS, HEADS[2]))
def test_user_defined_machines(run, here, monkeypatch, head):
    """Machines with and without a method `start`; periods are counted in cycles."""
    (here / "mine.py").write_text(OWN)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    run("simulate", head + BODY)
    assert is_png("new/m.png") and len(rows("new/m.csv")) == 3
    out = run("scan", head + BODY)
    assert "period 1 cycle: 4 (100.0 %)" in out and is_png("s.png")
    said = run("simulate", 'machine = "mine.py:Body"\n' + BODY, 2)
    assert said.count("\n") == 1 and "`start` is missing, and Body has no method `start`" in said
    said = run("simulate", 'machine = "mine.py:Body"\n[start]\nY = 1\n' + BODY, 2)
    assert said.count("\n") == 1 and "State(Y=1)" in said


@pytest.mark.slow
def test_machines_with_other_arguments(run):
    beam = """machine = "vi_jax.machines:Beam"
        method = { class = "vi_jax:ExactFlight" }
        arguments = { modes = 4, two_sided = true, shaken = "tip", gap = 1 }
        start = { displacement = [0.1, 0, 0, 0] }
        """
    files = "[simulate]\ncycles = 2\nsettle = 2\npicture = 'b.png'\noutput = 'b.csv'\n"
    assert "displacement[3] = " in run("simulate", beam + files)
    assert "section_displacement[3]" in rows("b.csv")[0] and is_png("b.png")
    si = """machine = "vi_jax:Parameters.scene"
        arguments = { torque = 10, gap = 0.08, drive = "motor" }
        """
    assert "W = " in run("simulate", si + files)


PARTS = "[simulate]\ncycles = 40\nsettle = 30\nsamples = 4\noutput = 'o.csv'\n"


def split_runs(monkeypatch):
    """Split runs into parts of ten cycles."""
    monkeypatch.setattr(command, "_CYCLES", 10)


def test_a_run_in_parts_is_the_same_run(monkeypatch):
    split_runs(monkeypatch)
    scene = vi.Scene.ideal(frequency_ratio=0.9, damping_ratio=0.02)
    options = {"settle": 3, "samples": 4, "impact_log": 2, "method": vi.Adaptive()}
    whole = vi.simulate(scene, scene.start(Y=0.3), 23, **options)
    parts, _ = command.run_in_parts(scene, scene.start(Y=0.3), 23, **options)
    for name in ("sections", "y_min", "impacts", "duration", "samples", "impact_log", "clearance"):
        each = (jax.tree.leaves(getattr(run, name)) for run in (parts, whole))
        for x, y in zip(*each, strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9)
    assert bool(parts.successful) and int(parts.steps) >= int(whole.steps)
    assert int(parts.rejected) >= int(whole.rejected) > 0


def test_a_run_in_parts_ends_with_the_part_that_fails(monkeypatch):
    split_runs(monkeypatch)
    scene = vi.Parameters(control=-1.0).scene()  # its motor stalls
    found, _ = command.run_in_parts(scene, scene.start(W=0.1), 40)
    assert not bool(found.successful) and found.impacts.size == 10


@pytest.mark.parametrize("pressed, kept", [(1, None), (3, 81)])
def test_ctrl_c_keeps_the_recorded_cycles_of_a_run(run, monkeypatch, capsys, pressed, kept):
    """Send Ctrl-C in the first part or a later one, and again while results are written."""
    split_runs(monkeypatch)
    compute, calls = command.simulate, []

    def computed(*args, **options):
        calls.append(1)
        if len(calls) == pressed:
            os.kill(os.getpid(), signal.SIGINT)
        return compute(*args, **options)

    for name in ("_joined", "_write_files"):
        after = getattr(command, name)
        press = lambda *args, after=after, **options: (
            os.kill(os.getpid(), signal.SIGINT), after(*args, **options)
        )[1]  # fmt: skip
        monkeypatch.setattr(command, name, press)
    monkeypatch.setattr(command, "simulate", computed)
    before = signal.getsignal(signal.SIGINT)
    run("simulate", PARTS, 130)
    assert signal.getsignal(signal.SIGINT) is before and len(calls) == pressed
    assert (len(rows("o.csv")) if kept else os.path.exists("o.csv")) == (kept or False)


def test_a_picture_that_cannot_be_drawn_loses_nothing(run):
    text = "[scan]\naxes.start.Y = [0.0, 1.0]\nsettle = 9\npicture = 'p.png'\noutput = 'o.csv'"
    out = run("scan", text)
    assert "picture: not drawn: " in out and len(rows("o.csv")) == 2


@pytest.mark.parametrize("path", READY, ids=lambda path: path.stem)
def test_ready_files(path, monkeypatch):
    tables = command.read(str(path))
    machine = command.machine_of(tables["machine"], tables["arguments"])
    (verb,) = command.VERBS.keys() & tables.keys()
    assert f"vi-jax {verb} experiments/{path.name}" in path.read_text("utf-8")
    assert tables[verb].keys() <= {*command.VERBS[verb].keys()} and machine.start() is not None


def test_version(capsys):
    assert vi.__version__ == metadata.version("vi-jax") and "__version__" in dir(vi)
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("vi-jax ")


HELD = """
import jax.numpy as jnp
import vi_jax as vi


class Held(vi.AbstractMachine):
    gain: float = 0.3
    delay: float = 4.0
    cycle = 2 * jnp.pi / 0.8
    contacts = vi.RigidStop(0.6, 0.7, on=("x", "u"))
    delays = property(lambda self: dict(sensor=self.delay))

    def field(self, t, z, past):
        pull = self.gain * (past.sensor.x - z.x)
        return dict(x=z.u, u=jnp.cos(0.8 * t) - z.x - 0.1 * z.u + pull)

    def start(self):
        return vi.State(x=0.0, u=0.0)
"""


# Without a stop, with which the programs of orbits are large.
FREE = HELD.replace("    contacts", "    # contacts")


@pytest.fixture
def held(here, request):
    """Write a file, of a name that no other test uses, and return the name of its machine. The text
    of the file is the fixture's parameter, by default `HELD`."""
    file = f"{request.node.originalname}.py"
    (here / file).write_text(getattr(request, "param", HELD), encoding="utf-8")
    return f"{file}:Held"


def test_simulate_and_pictures(run, held):
    table = "[simulate]\ncycles = 5\nsamples = 16\npicture = 'm.png'"
    out = run("simulate", f"machine = '{held}'\n{table}")
    assert "x = -0.3721662" in out and Path("m.png").exists()
    machine = command.machine_of(held, {})
    motion = vi.simulate(machine, cycles=5, samples=16)
    for draw in (vi.plot_history, vi.plot_phase_portrait):
        line = max(draw(motion, machine=machine).lines, key=lambda x: len(x.get_xdata()))
        assert len(line.get_xdata()) > 80
        plt.close("all")


@pytest.mark.slow
@pytest.mark.parametrize("held", [FREE], indirect=True, ids=["without a stop"])
def test_scan_and_orbit_with_a_delay(run, held):
    head, picture = f"machine = '{held}'\n", "settle = 20\npicture = 'p.png'\n"
    axes = "[scan.axes]\ngain = [0.2, 0.3]\ndelay = [0.5, 1.0]"
    assert "period 1 cycle: 4" in run("scan", f"{head}[scan]\n{picture}{axes}")
    text = f"{head}[orbit]\n{picture}"
    assert "a run with the whole history differs by" in run("orbit", text)


@pytest.mark.slow
def test_suggested_method(held):
    found = vi.suggest_method(command.machine_of(held, {}), cycles=4, lanes=2)
    assert found.reached and "Taylor" not in str(found.method)
