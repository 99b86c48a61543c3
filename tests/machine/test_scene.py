"""Scenes and parameters: dimensionless groups, kinematics, units and errors; units of machines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.machine import leaf_names, unit_of


def test_groups_of_table_1():
    table = vi.Parameters(torque=2.0, control=0.7, restitution=0.8)
    scene = table.scene()
    drive = scene.drive
    assert float(table.natural_frequency) == pytest.approx(15.930782, abs=5e-7)
    assert float(scene.damping_ratio) == pytest.approx(0.0448368, abs=5e-8)
    assert float(scene.stops[0].gap) == pytest.approx(2.0)
    assert float(drive.slider_inertia) == pytest.approx(0.0053333, abs=5e-8)
    assert float(drive.coupling) == pytest.approx(0.0093333, abs=5e-8)
    assert float(drive.strength) == pytest.approx(0.13134, abs=5e-6)
    assert float(vi.Parameters(torque=100.0).scene().drive.strength) == pytest.approx(
        6.5671, abs=5e-5
    )
    assert float(drive.no_load_speed) == 1.0 and float(drive.control) == pytest.approx(0.7)
    assert float(table.scene(drive="ideal").drive.frequency_ratio) == pytest.approx(0.7)
    assert float(table.scene(crank="slider").crank.ratio) == pytest.approx(1 / 3)
    assert float(vi.Parameters(no_load_speed=20.0).scene().drive.no_load_speed) == pytest.approx(
        20.0 / 15.930782, rel=1e-7
    )
    assert float(table.metres(2.0)) == pytest.approx(0.08)
    assert float(table.seconds(table.natural_frequency)) == pytest.approx(1.0)
    assert float(table.metres_per_second(1.0)) == pytest.approx(0.04 * 15.930782, rel=1e-7)
    assert float(table.radians_per_second(0.5)) == pytest.approx(0.5 * 15.930782, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1e-9, 1 / 3, 0.9])
def test_slider_crank_kinematics(ratio):
    crank = vi.SliderCrank(ratio)
    phase = jnp.linspace(0.0, 6.28, 101)
    U = lambda x: crank.slide(x).U
    slide = jax.vmap(crank.slide)(phase)
    exact = np.cos(phase) + (np.sqrt(1 - (ratio * np.sin(phase)) ** 2) - 1) / ratio
    np.testing.assert_allclose(
        slide.U, exact, atol=1e-15 / min(ratio, 1.0) if ratio < 1e-3 else 1e-14
    )
    np.testing.assert_allclose(slide.U_phi, jax.vmap(jax.grad(U))(phase), atol=1e-12)
    np.testing.assert_allclose(slide.U_phiphi, jax.vmap(jax.grad(jax.grad(U)))(phase), atol=1e-11)
    if ratio < 1e-3:  # a long rod approaches the cosine crank
        np.testing.assert_allclose(slide.U, np.cos(phase), atol=2e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: vi.RigidStop(2.0, 1.5), r"`restitution`.*in \[0, 1\].*1.5"),
        (lambda: vi.RigidStop(float("nan"), 0.5), r"`gap` must be finite.*nan"),
        (lambda: vi.RigidStop(2.0, 0.5, "top"), r"`side` must be one of 'right', 'left'.*'top'"),
        (lambda: vi.SliderCrank(1.0), r"`ratio`.*\(0, 1\).*1"),
        (lambda: vi.Parameters().scene(drive="steam"), r"`drive` must be one of.*'steam'"),
        (lambda: vi.Scene.ideal(frequency_ratio=0.9).start(W=1.0), r"`W` must be left out"),
        (
            lambda: vi.Scene(
                damping_ratio=0.0, drive=vi.IdealDrive(1.0), stops=[vi.RigidStop(1, 1)] * 2
            ),
            r"`stops` must hold at most one stop on each side.*'right', 'right'",
        ),
        (
            lambda: vi.Scene(
                damping_ratio=0.0, drive=vi.IdealDrive(1.0),
                stops=(vi.RigidStop(1, 1), vi.RigidStop(-1.5, 1, "left")),
            ),
            r"`stops` must leave room.*-0.5",
        ),
    ],
)  # fmt: skip
def test_errors_name_argument_requirement_and_value(make, message):
    with pytest.raises(ValueError, match=message):
        make()


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
