"""Structures of many degrees of freedom, compared with matrix exponentials, and their errors."""

import contextlib
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from linear_truth import Chatters
from structures import KINDS, machine_and_truth


def check_cycle_by_cycle(machine, truth, start, cycles, tolerance=1e-11, **options):
    """Compare states and impacts after each cycle from the reference's state. Return the number of
    impacts, and of contacts at rest as cycles end."""
    (x, v), resting, impacts, rests = start, (), 0, 0
    for _ in range(cycles):
        state = machine.start(displacement=x, velocity=v)
        x, v, count, resting = truth.cycle(x, v, resting)
        run = vi.simulate(machine, state, 1, **options)
        assert bool(run.successful)
        impacts, rests = impacts + count, rests + len(resting)
        assert int(run.impacts[0]) == count
        np.testing.assert_allclose(run.last.displacement, x, rtol=0, atol=tolerance)
        np.testing.assert_allclose(run.last.velocity, v, rtol=0, atol=tolerance)
    return impacts, rests


@pytest.mark.slow
def test_rest_matches_matrix_exponentials():
    """A coordinate rests on its stop, and the others move, until its force changes sign."""
    rested = 0
    for kind, seed in (("proportional", 5), ("general", 1), ("rigid", 1), ("undamped", 5)):
        machine, truth, start = machine_and_truth(seed, 2, kind, (0.0, 0.0, 0.0), 0.5)
        machine = dataclasses.replace(machine, contacts=machine.contacts[:1])
        truth.contacts = truth.contacts[:1]
        rested += check_cycle_by_cycle(machine, truth, start, 3, record="sections")[1]
    assert rested >= 2


@pytest.mark.slow
def test_structures_of_all_kinds_match_matrix_exponentials():
    """Structures with any damping or with rigid-body motion. Seeds that chatter are left out."""
    compared = impacts = 0
    for kind in KINDS:
        for seed in range(400, 403):
            with contextlib.suppress(Chatters):
                case, options = machine_and_truth(seed, 4, kind), {"rests": False}
                impacts += check_cycle_by_cycle(*case, 3, record="sections", **options)[0]
                compared += 1
    assert compared >= 9 and impacts > 5


def oscillator(**changes):
    given = {
        "mass": [2.0], "damping": [0.2], "stiffness": [2.0], "force": [2.0], "frequency": 0.9,
        "contacts": (vi.RigidStop(0.7, 0.6, at=[1.0]),), **changes,
    }  # fmt: skip
    return vi.machines.Structure(**given)


def test_structure_of_one_degree_equals_the_oscillator():
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.6, gap=0.7, damping_ratio=0.05)
    wanted = vi.simulate(scene, scene.start(Y=0.1), 20)
    run = vi.simulate(machine := oscillator(), machine.start(displacement=0.1), 20)
    np.testing.assert_allclose(run.last.displacement, wanted.last.Y, rtol=0, atol=1e-11)
    np.testing.assert_allclose(run.last.velocity, wanted.last.V, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(run.impacts, wanted.impacts)
    np.testing.assert_allclose(run.y_min, wanted.y_min, rtol=0, atol=1e-11)
    # ½ M (1 - k²) V² with a mass of 2; the scene's unit of energy is that of the stiffness.
    np.testing.assert_allclose(run.impact_energy, 2 * wanted.impact_energy, rtol=1e-9)


def test_undamped_in_resonance_and_with_a_constant_force():
    """Compare with sin(s)·s/2 + 3(1 - cos s), and with s²/2 of a rigid body at constant force."""
    machine = vi.machines.Structure(
        mass=[1.0, 1.0], stiffness=[1.0, 0.0], force=[1.0, 0.0], static_force=[3.0, 1.0]
    )
    last = vi.simulate(machine, machine.start(), 1, record="sections").last
    T = 2 * np.pi
    np.testing.assert_allclose(last.displacement, [0.0, T * T / 2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(last.velocity, [T / 2, T], rtol=0, atol=1e-12)


def test_energy_and_momentum_of_an_impact():
    """An impact loses ½ (1 - k²) m (c·v)², with m = 1/(cᵀM⁻¹c); its impulse is along c."""
    machine, _, _ = machine_and_truth(4, 4, "general")
    stop, body = machine.contacts[2], machine.coordinates[1]
    v = jnp.asarray([0.3, -0.2, 0.5, 0.1])
    state = machine.start(velocity=v)
    new = body.placed(state, body.position(state), stop.velocity_after(body.velocity(state)))
    mass, row = np.asarray(machine.mass), np.asarray(stop.at)
    gained = mass @ np.asarray(new.velocity - v)
    np.testing.assert_allclose(gained / row, gained[0] / row[0], rtol=1e-10)
    lost = 0.5 * (v @ mass @ v - new.velocity @ mass @ new.velocity)
    np.testing.assert_allclose(
        lost, body.mass * stop.loss(row @ v, stop.coefficient(row @ v)), rtol=1e-12
    )


@pytest.mark.slow
def test_derivatives_with_respect_to_matrices():
    """Compare derivatives with respect to matrices, gap, frequency, force, start and contact row
    with differences, where natural frequencies coincide."""
    n = 3
    base = 1.5 * np.eye(n)
    change = np.array([[0.3, 0.2, 0.1], [0.2, -0.1, 0.4], [0.1, 0.4, 0.2]])

    @jax.jit
    def last(p):
        machine = vi.machines.Structure(
            mass=jnp.eye(n) + p[1] * change @ change, damping=0.05 * np.eye(n) + p[2] * change,
            stiffness=base + p[0] * change, force=p[5] * jnp.asarray([1.0, 0.3, -0.2]),
            frequency=p[4], contacts=(vi.RigidStop(p[3], 0.7, at=jnp.array([0.3, 0, 1]) + p[7]),),
        )  # fmt: skip
        start = machine.start(displacement=p[6] * jnp.array([0.1, 0.2, -0.3]))
        run = vi.simulate(machine, start, 3, record="sections", rests=False)
        return jnp.concatenate([run.last.displacement, run.last.velocity])

    p = jnp.asarray([0.0, 0.0, 0.0, 0.25, 0.9, 1.0, 1.0, 0.0])
    found = jax.jacfwd(last)(p)
    size = np.abs(found).max(axis=0)
    h = 1e-6 * jnp.eye(8)
    slopes = np.stack([(last(p + e) - last(p - e)) / 2e-6 for e in h], axis=-1)
    np.testing.assert_allclose(found / size, slopes / size, rtol=0, atol=1e-6)

    backward = jax.grad(lambda p: jnp.sum(last(p) ** 2))(p)
    np.testing.assert_allclose(backward / size, 2 * last(p) @ found / size, rtol=0, atol=1e-10)


def test_both_sides_of_a_gap_are_one_coordinate():
    c = [1.0, -1.0]
    stops = (
        vi.RigidStop(0.5, 0.8, at=c),
        vi.RigidStop(0.5, 0.8, "left", at=c),
        vi.RigidStop(1.0, at=[0.0, 1.0], restitution=0.5),
    )
    machine = vi.machines.Structure(mass=np.eye(2), stiffness=np.eye(2), contacts=stops[:2])
    assert len(machine.coordinates) == 1
    state = machine.start(displacement=[0.1, 0.2])
    np.testing.assert_array_equal(machine.mirrored(state).displacement, [-0.1, -0.2])
    for force, own_image in ([0.0, 0.0], True), ([0.0, 0.1], False):
        pressed = dataclasses.replace(machine, static_force=jnp.asarray(force))
        assert (pressed.mirrored(state) is not None) == own_image
    machine = vi.machines.Structure(mass=np.eye(2), stiffness=np.eye(2), contacts=stops)
    assert [stop.coordinate for stop in machine.contacts] == [0, 0, 1]
    assert machine.mirrored(state) is None
    np.testing.assert_allclose(machine.coordinates[0].mass, 0.5)


@pytest.mark.slow
def test_modes_at_points():
    """Two equal masses between three equal springs: modes (1, 1) and (1, -1) over √2."""
    K = np.array([[2.0, -1.0], [-1.0, 2.0]])
    shapes = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2)
    contact = (vi.RigidStop(0.6, 0.7, at=[0.0, 1.0]),)
    given = {"contacts": contact, "force": [1.0, 0.0], "frequency": 0.8}
    by_modes = vi.machines.Structure.from_modes([1.0, np.sqrt(3.0)], 0.02, shapes, **given)
    np.testing.assert_allclose(by_modes.contacts[0].at, shapes[1])
    C = shapes @ np.diag([0.04, 0.04 * np.sqrt(3)]) @ shapes.T
    plain = vi.machines.Structure(mass=np.eye(2), damping=C, stiffness=K, **given)
    runs = [vi.simulate(m, m.start(), 6, record="sections") for m in (by_modes, plain)]
    assert int(runs[0].impacts.sum()) > 3
    np.testing.assert_array_equal(runs[0].impacts, runs[1].impacts)
    there = shapes @ np.asarray(runs[0].last.displacement)
    np.testing.assert_allclose(there, runs[1].last.displacement, rtol=0, atol=1e-12)


EYE = np.eye(2)
WRONG = {
    "mass that is not square": ({"mass": np.ones((2, 3))}, r"`mass`.*\(2, 3\)"),
    "mass that is not definite": ({"mass": np.diag([1.0, 0.0])}, "positive definite.* 0,"),
    "mass that is not symmetric": ({"mass": [[2.0, 1.0], [0.0, 2.0]]}, r"`mass`.*symmetric.*\[0, "),
    "stiffness of another size": ({"stiffness": np.eye(3)}, r"`stiffness`.*\(3, 3\)"),
    "row of another length": ({"contacts": (vi.RigidStop(1, 1, at=[1.0]),)}, r"contacts\[0\].at"),
    "no row": ({"contacts": (vi.RigidStop(1, 1),)}, r"Stop 0 .*at=c"),
}


@pytest.mark.parametrize(("changes", "words"), WRONG.values(), ids=WRONG)
def test_wrong_matrices_raise(changes, words):
    with pytest.raises(ValueError, match=words):
        vi.machines.Structure(**{"mass": EYE, "stiffness": EYE, **changes})


def test_traced_mass_that_is_not_definite_fails_its_lane():
    def last(mass):
        machine = oscillator(mass=mass[None, None] * jnp.ones((1, 1)))
        return vi.simulate(machine, machine.start(), 1, record="sections", rests=False)

    run = vi.jit(jax.vmap(last))(jnp.asarray([2.0, -1.0]))
    assert run.successful.tolist() == [True, False]
