"""Interrupted scans resume; a store rejects another scan."""

import importlib
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import vi_jax as vi
import xarray as xr

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.01)


@pytest.mark.slow
def test_a_store_resumes_and_rejects_another_scan(tmp_path, monkeypatch):
    work = importlib.import_module("vi_jax.scans._scan")
    axes = {"drive.frequency_ratio": np.linspace(0.6, 1.4, 40), "start.Y": np.linspace(-1, 1, 30)}
    options = {"settle": 20, "cycles": 128, "lanes": 256, "workers": 1}
    whole = vi.scan(SCENE, axes, **options)
    path = tmp_path / "new" / "store.zarr"
    done = []
    compute = work.compute

    def interrupted(*arguments):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(1)
        return compute(*arguments)

    monkeypatch.setattr(work, "compute", interrupted)
    with pytest.raises(KeyboardInterrupt):
        vi.scan(SCENE, axes, store=path, **options)
    half = xr.open_zarr(path, consolidated=False, chunks=None, mask_and_scale=False)
    assert 0 < int((half.result == 0).sum()) < half.result.size
    counted = []
    monkeypatch.setattr(work, "compute", lambda *a: counted.append(1) or compute(*a))
    rest = vi.scan(SCENE, axes, store=path, **options)
    assert len(counted) == 5 - len(done)
    for name in whole.data_vars:
        np.testing.assert_array_equal(rest[name].values, whole[name].values)
    with pytest.raises(ValueError, match="settle is 20, and now it is 21"):
        vi.scan(SCENE, axes, store=path, **{**options, "settle": 21})
    with pytest.raises(ValueError, match=r"axis start.Y is .*, and now it is"):
        vi.scan(SCENE, {**axes, "start.Y": np.linspace(-1, 1.1, 30)}, store=path, **options)
    other = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.1, damping_ratio=0.01)
    with pytest.raises(ValueError, match=r"machine stops\.0\.gap is 2\.0, and now it is 2\.1"):
        vi.scan(other, axes, store=path, **options)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("mine")
    with pytest.raises(ValueError, match="neither"):
        vi.scan(SCENE, axes, store=tmp_path / "full", **options)


def test_an_interrupted_creation_leaves_no_store(tmp_path, monkeypatch):
    store = importlib.import_module("vi_jax.scans.store")
    create = store.zarr.Group.create_array

    def interrupted(group, name, **options):
        if name == "y_min":
            raise KeyboardInterrupt
        return create(group, name, **options)

    def run():
        return vi.scan(SCENE, {"start.Y": [0.0, 0.1]}, settle=5, store=tmp_path / "store")

    with monkeypatch.context() as patched:
        patched.setattr(store.zarr.Group, "create_array", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run()
    assert not list(tmp_path.iterdir())
    assert bool((run().result == 0).all())
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


def test_an_interrupted_scan_in_memory_keeps_its_results(monkeypatch):
    """A block that ends on another thread after the interrupt is included."""
    work = importlib.import_module("vi_jax.scans._scan")
    begun, compute = threading.Barrier(2), work.compute

    def interrupted(*arguments, dry=False):
        if not dry:
            if begun.wait() == 0:
                raise KeyboardInterrupt
            time.sleep(0.2)
        return compute(*arguments, dry=dry)

    monkeypatch.setattr(work, "compute", interrupted)
    with pytest.raises(KeyboardInterrupt) as caught:
        vi.scan(SCENE, {"start.Y": np.linspace(-1, 1, 600)}, settle=5, lanes=256, workers=2)
    assert isinstance(caught.value, vi.Interrupted)
    codes = np.asarray(caught.value.partial.result)
    assert (codes == 0).sum() == 256 and (codes == -1).sum() == 344


def test_blocks_are_computed_by_any_executor():
    axes = {"start.Y": np.linspace(-1, 1, 600)}
    options = {"measure": "extremes", "settle": 5, "cycles": 4, "lanes": 256}
    with ThreadPoolExecutor(2) as pool:
        found = vi.scan(SCENE, axes, **options, cluster=pool)
        assert pool.submit(int).result() == 0  # the pool is not shut down
    xr.testing.assert_identical(found, vi.scan(SCENE, axes, **options))
    with pytest.raises(ConnectionError, match=r"was lost, .* Nothing was stored"):
        vi.scan(SCENE, axes, **options, cluster=pool)
