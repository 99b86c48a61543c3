"""The explorer for any machine: how it is named, its sliders, what they show; no page needed."""

import time
from io import BytesIO

import jax
import numpy as np
import pytest
import vi_jax as vi
from PIL import Image
from vi_jax import cli
from vi_jax.explore import controls
from vi_jax.explore.pictures import MAPS, DiagramPicture, MotionPicture, gif_of
from vi_jax.explore.subject import SETTLE, Subject, ready

from differences import some

OWN = """
import vi_jax as vi
def make():
    return vi.machines.Duffing()
def broken():
    return vi.machines.Duffing(gap=1 / 0)
def three():
    return 3
"""


@pytest.mark.parametrize(
    ("name", "more", "message"),
    [
        ("no.such:make", [], "--machine no.such:make cannot be found: No module named 'no'"),
        ("none.py:make", [], "cannot be found: there is no file"),
        ("own.py:gone", [], "has no attribute 'gone'"),
        ("own.py:three", [], "must return a machine, but returned 3"),
        ("own.py:broken", [], "raised ZeroDivisionError: division by zero"),
        ("own.py", [], "must be package.module:function or path/to/file.py:function"),
        ("own.py:make", ["--range", "gap=1"], "--range must be NAME=LOW:HIGH, but is 'gap=1'"),
        ("own.py:make", ["--range", "gap=2:1"], "two finite numbers (low, high), low < high"),
        ("own.py:make", ["--range", "gab=1:2"], "is of 'gab'"),
    ],
)
def test_what_is_no_machine_is_said_before_anything_starts(
    name, more, message, tmp_path, monkeypatch, capsys
):
    (tmp_path / "own.py").write_text(OWN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("vi_jax.cli.entry.missing", lambda: None)
    monkeypatch.setattr("vi_jax.cli.entry.serve", lambda *a, **k: pytest.fail("it started"))
    assert cli.main(["explore", "--no-browser", "--machine", name, *more]) == 2
    printed = capsys.readouterr().err
    assert message in printed and printed.count("\n") == 1


def test_a_file_is_served_with_its_ranges(tmp_path, monkeypatch):
    (tmp_path / "own.py").write_text(OWN, encoding="utf-8")
    called = []
    monkeypatch.setattr("vi_jax.cli.entry.missing", lambda: None)
    monkeypatch.setattr("vi_jax.cli.entry.serve", lambda *a, **k: called.append(k))
    name = f"{tmp_path}/own.py:make"
    assert cli.main(["explore", "--machine", name, "--range", "gap=0.5:3"]) == 0
    shown, subject = called[0]["machine"]
    assert shown == name and isinstance(subject.machine, vi.machines.Duffing)
    assert (subject.controls["gap"].low, subject.controls["gap"].high) == (0.5, 3.0)


def test_ranges_are_within_what_the_machine_allows():
    made = {name: Subject(kind()) for name, kind in ready().items()}
    assert {"BouncingBall", "Beam", "Woodpecker"} <= set(made) and "Structure" not in made
    for subject in made.values():
        for name, control in subject.controls.items():
            assert control.low <= control.value <= control.high
            # The page opens with the machine's own numbers, not with places next to them.
            steps = (control.value - control.low) / control.step
            assert abs(steps - round(steps)) < 1e-9
            for end in (control.low, control.high):
                if not isinstance(subject.machine, vi.machines.Woodpecker):  # its sleeve and pole
                    subject.at({**subject.beginning(), name: end})  # no machine refuses it
    duffing = made["Duffing"].controls
    assert (duffing["restitution"].low, duffing["restitution"].high) == (0.0, 1.0)
    assert (duffing["amplitude"].low, duffing["amplitude"].high) == pytest.approx((0.0, 0.6))


@pytest.fixture(scope="module")
def pair():
    subject = Subject(vi.machines.ImpactPair(), {"restitution": (0.2, 0.9)})
    subject.compile(lambda step: None)
    return subject


@pytest.mark.slow
def test_what_is_shown_is_what_is_simulated(pair):
    values = {**pair.beginning(), "restitution": 0.6, SETTLE: 100.0}
    seen, (machine, start) = pair.seen(values), pair.at(values)
    assert float(machine.restitution) == 0.6
    run = vi.simulate(machine, start, 256, settle=100)
    np.testing.assert_allclose(seen.extremes, (run.y_min.min(), run.y_max.max()), rtol=1e-9)
    found = pair.diagram(values, "restitution")
    value = found.values[60]
    here, start = pair.at({**values, "restitution": value})
    run = vi.simulate(here, start, 16, settle=pair.before)
    np.testing.assert_allclose(found.y_min[60], run.y_min, rtol=1e-9)


@pytest.mark.slow
def test_no_slider_of_a_machine_compiles_and_redraws_are_quick(pair):
    picture, begin, took, compiled = MotionPicture(labels=pair.machine.labels), [], [], []
    begin = pair.beginning()
    picture.draw(pair.seen(begin), pair.stops(pair.machine), which=MAPS[1])
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: compiled.append(name) if "backend_compile" in name else None
    )
    for name in (*pair.names, "start.place", SETTLE):
        control = pair.controls[name]
        for part in (0.4, 0.6):
            values = {**begin, name: control.low + part * (control.high - control.low)}
            since = time.process_time()
            machine, _ = pair.at(values)
            png = picture.draw(pair.seen(values), pair.stops(machine), which=MAPS[1])
            took.append(time.process_time() - since)
            assert Image.open(BytesIO(png)).size == (1008, 594)
        pair.diagram(values, pair.names[0])
    assert not compiled and np.median(took) < 0.2


def test_requests_that_no_slider_makes_are_refused_in_a_sentence(pair):
    for wrong in (1e9, float("nan"), None, "0.5"):
        values = {**pair.beginning(), "restitution": wrong}
        assert "must be a number from 0.2 to 0.9" in controls.fault(pair.controls, values)
    with pytest.raises(ValueError, match="restitution"):
        pair.at({**pair.beginning(), "restitution": 7.0})


@pytest.mark.parametrize("name", some(["Beam", "ReliefValve"], "ReliefValve"))
def test_machines_of_other_kinds(name):
    """Several coordinates to a state; no drive. Pictures of each, and it moves."""
    subject = Subject(ready()[name]())
    subject.compile(lambda step: None)
    seen = subject.seen(subject.beginning())
    assert not seen.fault and seen.regime and subject.words(seen)["position"]
    assert np.isfinite(seen.path.Y).all()
    assert gif_of(seen, subject.machine).startswith(b"GIF")
    found = subject.diagram(subject.beginning(), subject.names[0])
    ax = DiagramPicture().set(found, 1.0, shown="Y on the section", label="x")
    assert ax.get_xlabel() == "x" and np.isfinite(found.Y).any()
