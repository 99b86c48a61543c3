"""The command line: what it prints, where it writes, how it fails."""

import subprocess
import sys
import time
from importlib import metadata
from io import StringIO

import pytest
import vi_jax as vi
from vi_jax import cli
from vi_jax.cli import entry, progress


def test_version(capsys):
    assert vi.__version__ == metadata.version("vi-jax") and "__version__" in dir(vi)
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("vi-jax ")


def test_a_command_is_needed(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main([])
    assert ended.value.code == 2
    assert "command" in capsys.readouterr().err


@pytest.mark.slow
def test_reproduce(tmp_path, capsys):
    out = tmp_path / "new" / "folder"
    assert cli.main(["reproduce", "--quick", "--out", str(out)]) == 0
    printed = capsys.readouterr()
    assert {path.name for path in out.iterdir()} == {
        "fig1.png",
        "fig3.png",
        "fig4.png",
        "report.md",
        "report.json",
    }
    assert len(printed.out.splitlines()) <= 16
    assert str(out) in printed.out
    assert "simulating" in printed.err and "simulating" not in printed.out


@pytest.mark.parametrize("terminal", [False, True])
def test_a_countdown_moves_in_a_terminal(terminal, monkeypatch):
    class Stream(StringIO):
        def isatty(self):
            return terminal

    monkeypatch.setattr(sys, "stderr", Stream())
    monkeypatch.setattr(progress, "_PAUSE", 0.01)
    with pytest.raises(KeyError), progress.Countdown() as countdown:
        countdown("first", 60.0)
        time.sleep(0.2)
        countdown("second", 3.0)
        raise KeyError
    assert isinstance(sys.stderr, Stream)
    printed = sys.stderr.getvalue()
    assert printed.endswith("\n") and printed.count("\n") == 2
    first, second, _ = printed.split("\n")
    assert "about 60 s left] first" in first and "some seconds left] second" in second
    assert (first.count("first") > 3) == terminal == ("\r" in printed)


def _no_work(*args, **options):
    raise AssertionError("work began")


@pytest.mark.parametrize("below", ["", "folder"])
def test_a_file_in_the_way(tmp_path, capsys, monkeypatch, below):
    monkeypatch.setattr(entry, "reproduce", _no_work)
    file = tmp_path / "taken"
    file.write_text("mine")
    assert cli.main(["reproduce", "--out", str(file / below)]) == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1 and "taken" in printed.err
    assert file.read_text() == "mine"


@pytest.mark.parametrize("out", ["", "/proc/nowhere", "bad\0name"])
def test_a_path_that_cannot_be_written(capsys, monkeypatch, out):
    monkeypatch.setattr(entry, "reproduce", _no_work)
    assert cli.main(["reproduce", "--out", out]) == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1 and "error" in printed.err and not printed.out


@pytest.mark.slow
def test_interrupt_keeps_what_was_written(tmp_path, capsys, monkeypatch):
    from vi_jax.paper import report

    def interrupt(cases):
        raise KeyboardInterrupt

    monkeypatch.setattr(report, "check_claims", interrupt)
    assert cli.main(["reproduce", "--quick", "--out", str(tmp_path)]) == 130
    assert {path.name for path in tmp_path.iterdir()} == {"fig1.png", "fig3.png", "fig4.png"}
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.slow
def test_a_failing_write_is_one_line(tmp_path, capsys):
    (tmp_path / "fig3.png").mkdir()
    assert cli.main(["reproduce", "--quick", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("vi-jax: error:")


@pytest.mark.slow
def test_a_reader_that_has_seen_enough():
    """`vi-jax ... | head` is no failure."""
    code = "import sys; from vi_jax import cli; sys.exit(cli.main(['--help']))"
    with subprocess.Popen(
        [sys.executable, "-u", "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        told = process.stderr.read().decode()
    assert process.returncode == 0 and not told
