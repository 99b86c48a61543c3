"""The annotations of the package `lanes`, checked at run time in a separate process."""

import os
import subprocess
import sys

import pytest

CHECKED = """
import jax, jaxtyping
import jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)
hook = jaxtyping.install_import_hook("vi_jax.lanes", "beartype.beartype")
import vi_jax as vi
import vi_jax.lanes._kernel

try:
    vi_jax.lanes._kernel.kernel_text("no program", 8, 512)
except jaxtyping.TypeCheckError:
    pass
else:
    raise AssertionError("nothing is checked")


def last(control):
    scene = vi.Parameters(control=control).scene()
    run = vi.simulate(scene, scene.start(), 4, clock="time", samples=4, impact_log=2)
    return run.last.Y, run.successful


slopes, good = vi.jit(jax.vmap(jax.jacfwd(last, has_aux=True)))(jnp.linspace(0.7, 0.9, 5))
assert bool(good.all()) and bool(jnp.isfinite(slopes).all())
valve = vi.machines.ReliefValve()
assert bool(vi.simulate(valve, valve.start(), 4, method=vi.Taylor()).successful)
"""


@pytest.mark.slow
def test_the_types_of_the_lanes_are_right(tmp_path):
    # Python would load bytecode that another test compiled with other checks: so in a new folder.
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", CHECKED], capture_output=True, text=True,
        env={**os.environ, "PYTHONPYCACHEPREFIX": str(tmp_path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
