"""Numbers are printed in the units that their machine defines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.machine.numbers import leaf_names, unit_of

M = vi.machines

# Machine, label of the position, and units of position, velocity and exponents.
MACHINES = {
    "paper": (vi.Scene.ideal(frequency_ratio=0.9, damping_ratio=0.05), "Y", "a", "a ω", "ω"),
    "ball": (M.BouncingBall(), "height", "g/ω²", "g/ω", "ω"),
    "pair": (M.ImpactPair(), "place in the box", "a", "a ω", "ω"),
    "free pair": (M.ImpactPair(mass_ratio=0.2), "place in the box", "a", "a ω", "ω"),
    "duffing": (M.Duffing(), "x", "1", "1", "1"),
    "valve": (M.ReliefValve(), "lift", "1", "1", "1"),
    "capsule": (M.Capsule(), "place in the capsule", "F/k", "F/√(k m)", "√(k/m)"),
    "rotor": (M.UnbalancedRotor(gap=1.0), "Y", "m r/M", "m r ω/M", "ω"),
}


@pytest.fixture(params=MACHINES)
def case(request):
    return MACHINES[request.param]


def test_every_number_has_a_unit(case):
    machine, _, position, velocity, rate = case
    units, start = machine.units, machine.start()
    for name, unit in (("position", position), ("velocity", velocity), ("rate", rate)):
        assert unit_of(units, name) == unit
    for name in (*leaf_names(machine), *leaf_names(start), "time", "energy", "power"):
        assert unit_of(units, name)
    # The components for position and velocity have these units.
    names = leaf_names(start)
    probe = jax.tree.unflatten(jax.tree.structure(start), list(jnp.arange(float(len(names)))))
    assert unit_of(units, names[int(machine.position(probe))]) == position
    assert unit_of(units, names[int(machine.velocity(probe))]) == velocity


@pytest.mark.slow
def test_machine_without_units_uses_those_of_its_labels():
    class Own(vi.AbstractMachine):
        gap: float = 0.5

        @property
        def contacts(self):
            return (vi.RigidStop(self.gap, 0.6),)

        cycle = 2 * np.pi
        labels = "lift (mm)", "speed (mm/s)"

        def field(self, s, x):
            return vi.OscillatorState(x.V, jnp.cos(s) - x.Y)

    start = vi.OscillatorState(jnp.asarray(0.0), jnp.asarray(0.1))
    data = vi.scan(
        Own(), {"gap": [0.5, 0.6], "start.V": [0.1]}, start=start, settle=0, cycles=2,
        measure="extremes", progress=False,
    )  # fmt: skip
    assert data.y_min.attrs["units"] == "mm" and data.impact_speed.attrs["units"] == "mm/s"
    assert "units" not in data["gap"].attrs and "units" not in data["start.V"].attrs
    run = vi.simulate(Own(), start, 2)
    assert "lift in [" in str(run) and str(run).count(" mm\n") == 1 and " a" not in str(run)[90:]
    assert run.to_xarray().impact_speed.attrs["units"] == "mm/s"
