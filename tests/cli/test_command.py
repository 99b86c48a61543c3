"""The command `vi-jax` without a verb."""

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
