"""Files are there whole or not at all."""

import errno
import os

import numpy as np
import pytest
import vi_jax._files as files
from vi_jax.cli.output import write_rows


def _full(handle):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "a.csv"
    path.write_bytes(b"before")
    with monkeypatch.context() as patched:
        patched.setattr(files.os, "fsync", _full)
        with pytest.raises(OSError, match="No space left"):
            write_rows(str(path), [{"x": np.arange(5.0)}])
    assert path.read_bytes() == b"before" and os.listdir(tmp_path) == ["a.csv"]


def test_links_and_permissions_are_kept(tmp_path):
    path, link = tmp_path / "real", tmp_path / "link"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path)
    files.write_whole(link, "new")
    assert link.is_symlink() and path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o640
