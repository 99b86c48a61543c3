"""Runs and sweeps in parts are those in one go; Ctrl-C between the parts keeps them."""

import csv
import os
import signal
import threading

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
import vi_jax as vi
from vi_jax import cli
from vi_jax.cli import output
from vi_jax.cli import parts as in_parts

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)
START = SCENE.start(Y=0.3)


def never():
    return False


def press(*_):
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture
def short(monkeypatch):
    """Parts of five cycles."""
    monkeypatch.setattr(in_parts, "_INTERVALS", 5 * in_parts._PER_CYCLE)


def same(a, b):
    for x, y in zip(jtu.tree_leaves(a), jtu.tree_leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("settle", [0, 3, 47])
def test_a_run_in_parts_is_the_same_run(short, settle):
    options = {"settle": settle, "samples": 4, "impact_log": 2}
    whole = vi.simulate(SCENE, START, 13, **options)
    parts = in_parts.simulate_in_parts(SCENE, START, 13, interrupted=never, **options)
    for name in ("sections", "y_min", "impacts", "duration", "samples", "impact_log", "clearance"):
        same(getattr(parts, name), getattr(whole, name))
    assert bool(parts.successful) and parts.impacts.shape == (13,)
    assert int(parts.steps) >= int(whole.steps)


def test_a_run_that_fails_is_nan_from_there_on(short):
    options = {"settle": 3, "samples": 4, "impact_log": 2, "max_steps": 80}
    whole = vi.simulate(SCENE, START, 13, **options)
    parts = in_parts.simulate_in_parts(SCENE, START, 13, interrupted=never, **options)
    assert parts.result == whole.result == vi.RESULTS.max_steps
    good = np.isfinite(np.asarray(whole.y_min))
    assert 0 < good.sum() < 13
    np.testing.assert_array_equal(np.isfinite(np.asarray(parts.y_min)), good)
    np.testing.assert_allclose(parts.y_min, whole.y_min, atol=1e-9)


@pytest.mark.slow
def test_a_sweep_in_parts_is_the_same_sweep():
    gaps = [2.0, 1.2, 0.5, -0.5, 0.5, 2.0]
    options = {"settle": 50, "cycles": 8, "start": START}
    whole = vi.sweep(SCENE, "stops.0.gap", gaps, **options)
    parts = in_parts.sweep_in_parts(SCENE, "stops.0.gap", gaps, interrupted=never, **options)
    same((parts.values, parts.y_min, parts.period, parts.sections), (
        whole.values, whole.y_min, whole.period, whole.sections))  # fmt: skip


FILE = """
[scene]
frequency_ratio = 0.9
damping_ratio = 0.02
"""
SIMULATE = "[simulate]\ncycles = 13\nsettle = 3\nsamples = 4\nmax_impacts = 1000\n"
SWEEP = "[sweep]\nparameter = 'stops.0.gap'\nvalues = [2.0, 1.9, 1.8]\nsettle = 50\ncycles = 8\n"


@pytest.mark.parametrize(
    "verb, text, part, words, rows",
    [
        ("simulate", SIMULATE, "simulate", "after 10 of 13 cycles", 41),
        ("sweep", SWEEP + "up_and_down = true\n", "sweep", "after 2 of 6 values", 2),
    ],
)
def test_interrupts_keep_what_was_computed(
    short, tmp_path, monkeypatch, capsys, verb, text, part, words, rows
):
    """Pressed in the second part, again at once, and while the file is written."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file.toml").write_text(FILE + text + "output = 'out.csv'\n")
    compute, calls, write = getattr(in_parts, part), [], output.write_whole

    def computed(*arguments, **options):
        calls.append(1)
        if len(calls) == 2:
            press()
            press()
        return compute(*arguments, **options)

    monkeypatch.setattr(in_parts, part, computed)
    monkeypatch.setattr(output, "write_whole", lambda *a: (press(), write(*a)))
    before = signal.getsignal(signal.SIGINT)
    assert cli.main([verb, "file.toml"]) == 130
    assert signal.getsignal(signal.SIGINT) is before and len(calls) == 2
    printed = capsys.readouterr()
    assert printed.err.splitlines()[-1] == f"vi-jax: interrupted {words}, which are kept"
    assert printed.err.count("keeping what was computed") == 1 and "out.csv" in printed.out
    with open("out.csv", newline="", encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == rows


def test_an_interrupt_before_anything_is_kept(short, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file.toml").write_text(FILE + SIMULATE.replace("settle = 3", "settle = 90"))
    compute = in_parts.simulate
    monkeypatch.setattr(in_parts, "simulate", lambda *a, **o: (press(), compute(*a, **o))[1])
    assert cli.main(["simulate", "file.toml"]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "vi-jax: interrupted; nothing was written"


def test_another_thread_has_no_interrupts():
    words = []

    def work():
        with in_parts.noted_interrupts() as interrupted:
            words.append(interrupted())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert words == [False]


def test_a_long_run_takes_parts_of_a_fraction_of_a_second():
    """So many cycles of samples that one call would last for a minute are cut into short ones."""
    seen = []

    def once():
        seen.append(1)
        return len(seen) == 2

    run = in_parts.simulate_in_parts(SCENE, START, 10**6, interrupted=once)
    assert run.impacts.size <= 2 * 1024 and jnp.isfinite(run.last.Y)
