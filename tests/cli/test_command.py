"""The command `vi-jax` without a verb."""

import subprocess
import sys
from importlib import metadata

import pytest
import vi_jax as vi
from vi_jax import cli


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
def test_a_closed_pipe_as_in_head_is_no_failure():
    code = "import sys; from vi_jax import cli; sys.exit(cli.main(['--help']))"
    with subprocess.Popen(
        [sys.executable, "-u", "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        told = process.stderr.read().decode()
    assert process.returncode == 0 and not told
