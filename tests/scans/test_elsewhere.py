"""Scans that are killed, on several devices, and on clusters."""

import importlib
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import vi_jax as vi
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


class _Forgetful(ThreadPoolExecutor):
    """A fake Dask client that loses some of the tasks that it is given, by number."""

    status, given, lost = "running", 0, frozenset()

    get_executor = lambda self, **options: self
    scheduler_info = lambda self: {"workers": {"one": {}}}

    def submit(self, *task):
        self.given += 1
        return Future() if self.given in self.lost else super().submit(*task)


@pytest.mark.parametrize(
    ("at_once", "lost"), [(4096, {5}), (4096, {5, 9}), (2, {5, 6}), (1, {3, 4})]
)
def test_lost_blocks_are_submitted_again(monkeypatch, at_once, lost):
    """Eight blocks; one that is submitted again may be lost again."""
    scene, axes = vi.Scene.ideal(frequency_ratio=0.9), {"start.Y": np.linspace(-1.0, 1.0, 2000)}
    options: dict = {"measure": "extremes", "settle": 5, "cycles": 4, "lanes": 256}
    wanted = vi.scan(scene, axes, **options)
    module = importlib.import_module("vi_jax.scans._scan")
    monkeypatch.setattr(module, "_PATIENCE", 0.02)
    monkeypatch.setattr(module, "_ON_CLUSTER", at_once)
    with _Forgetful(1) as client:
        client.lost = lost
        found = vi.scan(scene, axes, **options, cluster=client)
    assert client.given >= 8 + len(lost)  # or more on a stalling computer
    xr.testing.assert_identical(found, wanted)
