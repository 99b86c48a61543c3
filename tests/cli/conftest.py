"""Each test of the command line writes its files into a separate folder."""

from pathlib import Path

import pytest
from vi_jax import cli

IDEAL = """
machine = "vi_jax:Scene.ideal"
arguments = { frequency_ratio = 0.9, damping_ratio = 0.05 }
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(here, capsys):
    """Run a verb with a file (default machine: the ideal scene), check the exit code, and return
    the output."""

    def run(verb, text, code=0, *options):
        Path("file.toml").write_text(text if "machine =" in text else IDEAL + text, "utf-8")
        found = cli.main([verb, "file.toml", *options])
        printed = capsys.readouterr()
        assert found == code, printed.err
        assert code or not printed.err, printed.err
        return printed.err if code == 2 else printed.out

    return run
