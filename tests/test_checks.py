"""Arguments are checked before any work, and error messages name the argument."""

import json
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import pytest
import vi_jax as vi
from vi_jax import _checks
from vi_jax._messages import warn, warning_once


def test_invalid_calls_raise_with_a_reason():
    script = Path(__file__).with_name("refused_calls.py")
    root = Path(_checks.__file__).parents[1]
    process = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(root)}, cwd=script.parent,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    found = json.loads(process.stdout)
    assert found["wrong"] == {} and found["calls"] > 100


@pytest.mark.slow
def test_annotations_hold_in_every_verb():
    """Annotations are checked from the import of a module on, so this needs another process."""
    root = Path(__file__).parents[1]
    options = ["--annotations", "-n", "0", "-q", "-p", "no:cacheprovider", "-m", ""]
    options += ["-k", "([pair] and not suggest) or as_many_contacts_stick"]
    files = ["tests/machines/test_verbs.py", "tests/machine/test_contacts.py"]
    process = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *files],
        capture_output=True, text=True, cwd=root, env={**os.environ, "PYTHONPATH": str(root)},
    )  # fmt: skip
    assert process.returncode == 0, process.stdout[-5000:]
    assert "10 passed" in process.stdout


def test_requests_beyond_the_memory_raise():
    _checks.fits_memory("cycles", 1e6)
    with pytest.raises(ValueError, match=r"`cycles` must ask for results that fit into the memory"):
        _checks.fits_memory("cycles", 1e18)


def test_all_numbers_of_an_array_must_be_in_range():
    stop = vi.RigidStop(1.0, 0.5)
    for numbers, good in ([0.5, 1.0], True), ([0.5, 1.5], False):
        put = eqx.tree_at(lambda x: x.restitution, stop, jnp.asarray(numbers))
        assert bool(_checks.in_range(put)) == good


def test_a_warning_is_given_once_per_call():
    @warning_once
    def call():
        for words in ("one", "one", "other"):
            warn(words)

    with pytest.warns(UserWarning) as caught:
        call()
        call()
    assert [str(x.message) for x in caught] == ["one", "other"] * 2
