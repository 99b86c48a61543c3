"""Files are there whole or not at all."""

import errno
import os

import numpy as np
import pytest
import vi_jax._files as files
from matplotlib.figure import Figure
from vi_jax import save_picture
from vi_jax.cli.output import write_rows


def _full(handle):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("written", ["a.csv", "a.png"])
def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch, written):
    path = tmp_path / written
    path.write_bytes(b"before")

    def write():
        if written == "a.csv":
            write_rows(str(path), [{"x": np.arange(5.0)}])
        else:
            figure = Figure(figsize=(1, 1))
            figure.subplots().plot([0, 1])
            save_picture(figure, path)

    with monkeypatch.context() as patched:
        patched.setattr(files.os, "fsync", _full)
        with pytest.raises(OSError, match="No space left"):
            write()
    assert path.read_bytes() == b"before" and os.listdir(tmp_path) == [written]
    write()
    assert path.read_bytes()[:4] in (b"\x89PNG", b"x\r\n0") and os.listdir(tmp_path) == [written]


def test_links_and_permissions_are_kept(tmp_path):
    path, link = tmp_path / "real", tmp_path / "link"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path)
    files.write_whole(link, "new")
    assert link.is_symlink() and path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o640
