"""The command line, pictures and the choice of a method with a machine with delays."""

from pathlib import Path

import matplotlib.pyplot as plt
import pytest
import vi_jax as vi
from vi_jax.cli import command

HELD = """
import jax.numpy as jnp
import vi_jax as vi


class Held(vi.AbstractMachine):
    gain: float = 0.3
    delay: float = 4.0
    cycle = 2 * jnp.pi / 0.8
    contacts = vi.RigidStop(0.6, 0.7, on=("x", "u"))
    delays = property(lambda self: dict(sensor=self.delay))

    def field(self, t, z, past):
        pull = self.gain * (past.sensor.x - z.x)
        return dict(x=z.u, u=jnp.cos(0.8 * t) - z.x - 0.1 * z.u + pull)

    def start(self):
        return vi.State(x=0.0, u=0.0)
"""


@pytest.fixture
def held(here, request):
    """Write a file, of a name that no other test uses, and return the name of its machine."""
    (here / f"{request.node.name}.py").write_text(HELD, encoding="utf-8")
    return f"{request.node.name}.py:Held"


def test_simulate_and_pictures(run, held):
    table = "[simulate]\ncycles = 5\nsamples = 16\npicture = 'm.png'"
    out = run("simulate", f"machine = '{held}'\n{table}")
    assert "x = -0.3721662" in out and Path("m.png").exists()
    machine = command.machine_of(held, {})
    motion = vi.simulate(machine, cycles=5, samples=16)
    for draw in (vi.plot_history, vi.plot_phase_portrait):
        line = max(draw(motion, machine=machine).lines, key=lambda x: len(x.get_xdata()))
        assert len(line.get_xdata()) > 80
        plt.close("all")


@pytest.mark.slow
def test_all_other_verbs(run, held):
    head, picture = f"machine = '{held}'\n", "settle = 20\npicture = 'p.png'\n"
    axes = "[scan.axes]\ngain = [0.2, 0.3]\ndelay = [1.0, 4.0]"
    assert "period 1 cycle: 4" in run("scan", f"{head}[scan]\n{picture}{axes}")
    values = "parameter = 'gain'\nvalues = [0.2, 0.3]\n"
    assert "1 cycle with 1 impact" in run("sweep", f"{head}[sweep]\n{values}{picture}")
    region = "[basins.region]\n'start.x' = [-0.5, 0.5]\n'start.u' = [-0.5, 0.5]"
    text = f"{head}[basins]\nresolution = 3\n{picture}{region}"
    assert "1 periodic motion" in run("basins", text)
    text = f"{head}[orbit]\n{picture}"
    assert "a run with the whole history differs by" in run("orbit", text)


@pytest.mark.slow
def test_suggested_method(held):
    found = vi.suggest_method(command.machine_of(held, {}), cycles=4, lanes=2)
    assert found.reached and "Taylor" not in str(found.method)
