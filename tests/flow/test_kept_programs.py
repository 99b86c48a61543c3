"""Compiled programs that are kept in a folder serve later processes, but never another machine."""

import os
import subprocess
import sys

import pytest

RUN = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import vi_jax as vi

print(vi.keep_programs())
STIFFNESS = float(sys.argv[1])

class Body(vi.Mechanical):
    q = ("x",)
    cycle = 3.0

    def mass(self, q):
        return 1.0

    def force(self, t, q, v):
        return dict(x=-STIFFNESS * q.x)

print(float(vi.simulate(Body(), Body().at(x=1.0)).last.x))
"""


def test_a_changed_global_gives_the_new_motion_with_a_warm_cache(tmp_path):
    unset = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    environment = {k: x for k, x in os.environ.items() if k not in unset}
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "JAX_PLATFORMS": "cpu"}

    def found(stiffness):
        command = [sys.executable, "-c", RUN, str(stiffness)]
        out = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        folder, x = out.stdout.split()
        assert folder == str(tmp_path / "vi_jax") and not out.stderr
        return float(x), {path for path in (tmp_path / "vi_jax").rglob("*") if path.is_file()}

    first, files = found(4.0)
    assert first == pytest.approx(0.9601702866503661, abs=1e-8)  # cos 6
    assert any(path.suffix == ".o" for path in files)
    second, more = found(1.0)
    assert second == pytest.approx(-0.9899924966004454, abs=1e-8) and more > files  # cos 3
    assert found(4.0) == (first, more)
