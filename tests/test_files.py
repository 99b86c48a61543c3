"""Files are there whole or not at all."""

import errno
import os

import numpy as np
import pytest
import vi_jax._files as files
from matplotlib.figure import Figure
from PIL import Image
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


def _figure():
    figure = Figure(figsize=(2, 2))
    figure.subplots().plot([0, 1]).pop().axes.set_xlabel("restitution k")
    return figure


def test_a_picture_is_what_its_name_ends_in(tmp_path):
    begins = {"png": b"\x89PNG", "pdf": b"%PDF-", "svg": b"<?xml", "PDF": b"%PDF-"}
    for ending, first in begins.items():
        path = save_picture(_figure(), tmp_path / f"a.{ending}")
        assert path.read_bytes().startswith(first), ending
        again = save_picture(_figure(), tmp_path / f"b.{ending}")
        assert path.read_bytes() == again.read_bytes()
    # Words are words: readable in the SVG; in the PDF set with a font, not with drawn outlines.
    assert ">restitution k</text>" in (tmp_path / "a.svg").read_text("utf-8")
    assert b"/FontFile2" in (tmp_path / "a.pdf").read_bytes()
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == (220, 220)


@pytest.mark.parametrize("name", ["a.jpg", "a", "a.eps", "a.png.gz"])
def test_other_kinds_of_pictures_are_refused(tmp_path, name):
    with pytest.raises(ValueError, match=r"`path` must end in \.png, \.pdf, \.svg"):
        save_picture(_figure(), tmp_path / name)
    assert not os.listdir(tmp_path)


def test_no_resolution_and_too_many_colours_are_refused(tmp_path):
    figure = _figure()
    with pytest.raises(ValueError, match="`dpi` must be"):
        save_picture(figure, tmp_path / "a.svg", dpi=0)
    with pytest.raises(ValueError, match="`colors` must be at most 256"):
        save_picture(figure, tmp_path / "a.png", colors=300)


def test_links_and_permissions_are_kept(tmp_path):
    path, link = tmp_path / "real", tmp_path / "link"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path)
    files.write_whole(link, "new")
    assert link.is_symlink() and path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o640
