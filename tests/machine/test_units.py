"""Numbers are printed in the units that their machine defines."""

import jax
import jax.numpy as jnp
import pytest
import vi_jax as vi
from vi_jax.machine import leaf_names, unit_of

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
