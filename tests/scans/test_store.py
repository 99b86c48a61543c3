"""Damaged stores, and stores of another function."""

import importlib
import json
import shutil
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
import xarray as xr

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.01)
AXES = {"start.Y": np.linspace(-1.0, 1.0, 600)}


def scan_into(path, machine=SCENE):
    return vi.scan(
        machine, AXES, measure="extremes", settle=5, cycles=4, lanes=256, workers=1, store=path
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "whole"
    return path, {name: x.values for name, x in scan_into(path).variables.items()}


def test_xarray_opens_a_store_without_a_warning(whole):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept = xr.open_zarr(whole[0])
    np.testing.assert_array_equal(kept.y_min, whole[1]["y_min"])


def _flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(content)


def _cut(path):
    path.write_bytes(path.read_bytes()[:-3])


@pytest.mark.parametrize(
    "damage, where, words, blocks",
    [
        ("deleted", "y_min/c/1", "y_min/c/1", 1),
        ("deleted", "y_min", "y_min/c/0, y_min/c/1, y_min/c/2", 3),
        (_cut, "y_max/c/2", "y_max/c/2", 1), (_flip, "impact_speed/c/0", "impact_speed/c/0", 1),
        (_flip, "result/c/0", "result/c/0", 1), (_cut, "start.Y/c/0", "start.Y", 0),
    ],
)  # fmt: skip
def test_damaged_blocks_are_computed_again_with_a_warning(
    whole, tmp_path, monkeypatch, damage, where, words, blocks
):
    path = tmp_path / "store"
    shutil.copytree(whole[0], path)
    broken = path / where
    if damage == "deleted":
        shutil.rmtree(broken) if broken.is_dir() else broken.unlink()
    else:
        damage(broken)
    work = importlib.import_module("vi_jax.scans._scan")
    compute, computed = work.compute, []
    monkeypatch.setattr(work, "compute", lambda *a: computed.append(1) or compute(*a))
    with pytest.warns(UserWarning, match=f"lost or damaged, and are computed again: {words}[.]"):
        found = scan_into(path)
    assert len(computed) == blocks
    for name, numbers in whole[1].items():
        np.testing.assert_array_equal(found[name].values, numbers)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scan_into(path)
    assert len(computed) == blocks


def test_a_read_only_folder_raises_before_any_work(whole, monkeypatch):
    """Its parent folder is writable."""
    checks = importlib.import_module("vi_jax._checks")
    create = checks.tempfile.TemporaryFile

    def refused(dir=None, **options):
        if dir == whole[0]:
            raise PermissionError(13, "Permission denied")
        return create(dir=dir, **options)

    monkeypatch.setattr(checks.tempfile, "TemporaryFile", refused)
    with pytest.raises(ValueError, match=r"`store` must be a path .*: Permission denied"):
        scan_into(whole[0])


def test_blocks_are_not_larger_than_the_grid():
    data = vi.scan(
        SCENE, {"start.Y": [0.0, 0.5]}, measure="extremes", settle=5, cycles=4, lanes=10**9
    )
    assert (data.result == 0).all()


def test_a_second_writer_raises(whole, tmp_path, monkeypatch):
    computed = importlib.import_module("vi_jax.scans._scan")
    compute = computed.compute

    def twice(*arguments):
        with pytest.raises(ValueError, match="`store` must not be in use, but another scan writes"):
            scan_into(tmp_path / "store")
        return compute(*arguments)

    monkeypatch.setattr(computed, "compute", twice)
    found = scan_into(tmp_path / "store")
    np.testing.assert_array_equal(found.y_min, whole[1]["y_min"])
    scan_into(tmp_path / "store")


def test_a_store_with_a_truncated_header_raises(whole, tmp_path):
    path = tmp_path / "store"
    shutil.copytree(whole[0], path)
    _cut(path / "zarr.json")
    with pytest.raises(ValueError, match=r"`store` must be the store of a scan, but .*zarr.json"):
        scan_into(path)


def test_failed_lanes_do_not_count_as_damage(tmp_path):
    """Failed lanes are NaN, which Zarr stores as an empty chunk by default."""

    def run():
        axes = {"start.Y": np.linspace(2.5, 3.0, 256)}
        return vi.scan(SCENE, axes, measure="extremes", settle=5, cycles=4, store=tmp_path / "s")

    with pytest.warns(UserWarning, match="256 of 256 lanes failed"):
        run()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        run()
    assert [str(w.message)[:7] for w in said] == ["256 of "]


def test_another_function_with_equal_probed_lanes_raises(tmp_path, monkeypatch):
    """The first and the last lane agree, so that only the code differs."""
    module = importlib.import_module("vi_jax.scans._scan")
    monkeypatch.setattr(module, "run_blocks", lambda *arguments: None)

    def run(name, change=0.0, hidden=None):  # its functions close over `change` and `hidden`
        def machine(zeta):
            bump = change * (zeta - 0.8) * (1.2 - zeta)
            return vi.Scene.ideal(frequency_ratio=zeta + bump, damping_ratio=0.02)

        def measure(scene, run):
            late = jnp.where(scene.drive.frequency_ratio > 0.9, 1.0 + change, 1.0)
            return {"depth": late * run.y_min[-1], "hidden": 0.0 if hidden is None else 1.0}

        scene, kept = (machine, "extremes") if name == "scene" else (SCENE, measure)
        axes = {"zeta" if name == "scene" else "drive.frequency_ratio": [0.8, 1.0, 1.2]}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "3 of 3 lanes failed .not_computed")
            vi.scan(scene, axes, measure=kept, settle=5, cycles=4, store=tmp_path / name)

    for name, what in {"scene": "machine", "measure": "measure 1"}.items():
        run(name)
        run(name)
        with pytest.raises(ValueError, match=rf"the code of {what} is \w+, and now it is \w+"):
            run(name, change=0.1)
    opaque = (x for x in "ab")
    shutil.rmtree(tmp_path / "measure")
    run("measure", hidden=opaque)
    with pytest.raises(ValueError, match=r"must be new, since it is unknown .* measure 1"):
        run("measure", hidden=opaque)


def test_a_store_of_another_release_warns(whole, tmp_path):
    path = tmp_path / "store"
    shutil.copytree(whole[0], path)
    head = json.loads((path / "zarr.json").read_text())
    assert head["attributes"]["vi_jax"] == vi.__version__
    head["attributes"]["vi_jax"] = "0.0.1"
    (path / "zarr.json").write_text(json.dumps(head))
    with pytest.warns(UserWarning, match=rf"begun by vi_jax 0\.0\.1, and this is {vi.__version__}"):
        found = scan_into(path)
    np.testing.assert_array_equal(found.y_min, whole[1]["y_min"])
