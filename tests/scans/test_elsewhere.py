"""Scans that are killed, and on several devices."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

SCRIPT = Path(__file__).with_name("long_scan.py")


def _run(path, *options, **environment):
    command = [sys.executable, str(SCRIPT), str(path), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, **environment)


def _stored(path):
    data = xr.open_zarr(path, consolidated=False, chunks=None, mask_and_scale=False)
    return {name: data[name].values for name in data.data_vars}


def _finished(path, *options, **environment):
    process = _run(path, *options, stderr=subprocess.STDOUT, **environment)
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0, out
    return _stored(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the results of the scan."""
    return _finished(tmp_path_factory.mktemp("scan") / "whole")


def _done(path):
    """Return the number of stored lanes."""
    return (_stored(path)["result"] != -1).sum() if path.exists() else 0


def _same(found, whole):
    for name, numbers in whole.items():
        np.testing.assert_array_equal(found[name], numbers)


@pytest.mark.slow
def test_a_killed_scan_resumes_on_two_devices(tmp_path, whole):
    path = tmp_path / "store"
    process = _run(path)
    assert process.stdout.readline() == "begins\n"
    while not _done(path):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert 0 < _done(path) < whole["result"].size
    _same(_finished(path, "--devices", "2"), whole)
