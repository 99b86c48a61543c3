"""The harvester of the guide: its mean power beside what it takes, and by the load."""

import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "own_machine.md"


@pytest.fixture(scope="module")
def machine():
    """Of its class as the guide has it."""
    (text,) = re.findall(
        r"```python\n(class Harvest\(.*?)\n\n\nharvester =", PAGE.read_text(), re.S
    )
    names = {"jax": jax, "jnp": jnp, "eqx": eqx, "vi": vi, "__name__": __name__}
    exec(text, names)
    return names["Harvester"]


@pytest.fixture(scope="module")
def orbit(machine):
    one = machine()
    settled = vi.simulate(one, one.start(), 1, settle=200)
    return vi.find_orbit(one, settled.last, throw=True)


@pytest.mark.exhaustive
def test_power_is_a_column_of_a_branch_and_an_axis_of_a_sweep(machine, orbit):
    branch = vi.continue_orbit(orbit, parameter="resistance", bounds=(0.8, 1.25))
    ax = vi.plot_branch(branch, y="power")
    assert ax.get_ylabel() == "mean power (mW)"
    swept = vi.sweep(
        machine(), "resistance", np.array([1.0]), start=orbit.state, settle=1, cycles=2
    )
    np.testing.assert_allclose(swept.averages["power"], orbit.averages["power"], rtol=1e-6)
    here = branch.at(1.0)[0]
    np.testing.assert_allclose(here.averages["power"], orbit.averages["power"], rtol=1e-7)
    # Beside the trapezoidal rule on the motion's own samples, between its two impacts' kinks.
    run = here.trajectory(samples=4096)
    current, lengths = run.samples.state.current, jnp.diff(run.samples.time)
    middle = 0.5 * (current[1:] ** 2 + current[:-1] ** 2)
    mean = jnp.sum(middle * lengths) / here.duration
    np.testing.assert_allclose(here.averages["power"], mean, rtol=1e-5)


@pytest.mark.exhaustive
def test_its_derivative_by_the_load(machine, orbit):
    """Of a motion through impacts, beside finite differences. The current fades five times in a
    unit of time, which the machine does not say: so steps are sized."""

    def power(load):
        run = vi.simulate(machine(resistance=load), orbit.state, 3, method=vi.Taylor(rtol=1e-13))
        return run.averages["power"], run.impacts

    at, h = jnp.asarray(1.0), 1e-5
    alone = vi.jit(jax.vmap(power))
    (low, high), counts = alone(jnp.array([at - h, at + h]))
    assert int(counts.sum()) >= 6 and (counts[0] == counts[1]).all()
    slope = vi.jit(jax.jacfwd(lambda load: power(load)[0]))(at)
    np.testing.assert_allclose(slope, (high - low) / (2 * h), rtol=1e-6, atol=1e-9)
