"""Scans that are killed, on several devices, and on clusters."""

import importlib
import re
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
from vi_jax.scans.store import ZarrStore

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


@pytest.mark.exhaustive
def test_a_cluster_may_lose_a_worker(tmp_path, whole):
    _same(_finished(tmp_path / "cluster", "--cluster"), whole)


@pytest.mark.slow
def test_a_scan_waits_for_workers(monkeypatch):
    distributed = pytest.importorskip("dask.distributed")
    computed, said = importlib.import_module("vi_jax.scans._scan"), []
    monkeypatch.setattr(computed, "_PATIENCE", 0.2)
    monkeypatch.setattr(computed, "warn", lambda words: said.append(words) or cluster.scale(1))
    scene, axes = vi.Scene.ideal(frequency_ratio=0.9), {"start.Y": np.linspace(-1.0, 1.0, 300)}
    options: dict = {"measure": "extremes", "settle": 5, "cycles": 4, "lanes": 256}
    empty = {"n_workers": 0, "processes": False, "dashboard_address": None}
    with distributed.LocalCluster(**empty) as cluster:
        with distributed.Client(cluster) as client:
            found = vi.scan(scene, axes, **options, cluster=client)
    assert said and "has no workers. The scan waits" in said[0]
    xr.testing.assert_identical(found, vi.scan(scene, axes, **options))


class _Forgetful(ThreadPoolExecutor):
    """A fake Dask client that loses the fifth block."""

    status, given = "running", 0

    get_executor = lambda self, **options: self
    scheduler_info = lambda self: {"workers": {"one": {}}}

    def submit(self, *task):
        self.given += 1
        return Future() if self.given == 5 else super().submit(*task)


def test_lost_blocks_are_submitted_again(monkeypatch):
    scene, axes = vi.Scene.ideal(frequency_ratio=0.9), {"start.Y": np.linspace(-1.0, 1.0, 2000)}
    options: dict = {"measure": "extremes", "settle": 5, "cycles": 4, "lanes": 256}
    wanted = vi.scan(scene, axes, **options)
    monkeypatch.setattr(importlib.import_module("vi_jax.scans._scan"), "_PATIENCE", 0.1)
    with _Forgetful(1) as client:
        found = vi.scan(scene, axes, **options, cluster=client)
    assert client.given > 8  # nine, or more on a stalling computer
    xr.testing.assert_identical(found, wanted)


@pytest.mark.slow
def test_a_lost_scheduler_raises_with_a_hint(tmp_path, monkeypatch):
    distributed = pytest.importorskip("dask.distributed")
    known, store = tmp_path / "scheduler.json", tmp_path / "store"
    parts = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", *words, "--scheduler-file", str(known)],
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        for words in (
            ("scheduler", "--port", "0", "--no-dashboard"),
            ("worker", "--nthreads", "1", "--no-nanny", "--no-dashboard"),
        )
    ]
    scene = vi.Scene.ideal(frequency_ratio=0.9)
    axes = {"start.Y": np.linspace(-1.0, 1.0, 3000)}
    options: dict = {"measure": "extremes", "settle": 500, "cycles": 50, "lanes": 256}
    write = ZarrStore.write

    def written(self, where, numbers):
        write(self, where, numbers)
        parts[0].kill()

    try:
        client = distributed.Client(scheduler_file=str(known), timeout=60)
        client.wait_for_workers(1, timeout=60)
        with monkeypatch.context() as patched:
            patched.setattr(ZarrStore, "write", written)
            told = r"was lost, or its scheduler. (\d+) of 12 blocks .* stored in .*store. The same"
            with pytest.raises(ConnectionError, match=told) as lost:
                vi.scan(scene, axes, **options, cluster=client, store=store)
        done = int(re.search(told, str(lost.value))[1])
        assert 1 <= done < 12
        assert (_stored(store)["result"] != -1).sum() in (256 * done, 256 * done - 72)
        with pytest.raises(ConnectionError, match=r"Nothing was stored. Pass a `store`"):
            vi.scan(scene, axes, **options, cluster=client)
        client.close(timeout=1)
    finally:
        for part in parts:
            part.kill()
            part.wait()
    found = vi.scan(scene, axes, **options, store=store)  # goes on
    np.testing.assert_array_equal(found["y_max"], vi.scan(scene, axes, **options)["y_max"])
