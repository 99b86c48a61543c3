"""What is passed in is looked at before any work, and refused with a sentence that names it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from vi_jax import _checks


def test_calls_that_cannot_be_run_are_refused_with_a_reason():
    script = Path(__file__).with_name("refused_calls.py")
    root = Path(_checks.__file__).parents[1]
    process = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(root)},
        cwd=script.parent,
    )
    assert process.returncode == 0, process.stderr
    found = json.loads(process.stdout)
    assert found["wrong"] == {} and found["calls"] > 100


def test_annotations_hold_for_one_machine_through_every_verb():
    """In a process of its own, as annotations are checked where a module is imported."""
    root = Path(__file__).parents[1]
    options = ["--annotations", "-n", "0", "-q", "-p", "no:cacheprovider", "-m", "", "-k", "[pair]"]
    process = subprocess.run(
        [sys.executable, "-m", "pytest", *options, "tests/machines/test_verbs.py"],
        capture_output=True, text=True, cwd=root, env={**os.environ, "PYTHONPATH": str(root)},
    )  # fmt: skip
    assert process.returncode == 0, process.stdout[-5000:]
    assert "10 passed" in process.stdout


def test_no_more_than_the_memory_is_asked_for():
    _checks.fits_memory("cycles", 1e6)
    with pytest.raises(ValueError, match=r"`cycles` must ask for results that fit into the memory"):
        _checks.fits_memory("cycles", 1e18)
