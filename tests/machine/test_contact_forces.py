"""Forces of contacts in given states, beside closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from planar import Block

HALF_WIDTH, HALF_HEIGHT, G = 0.2, 0.5, 9.81


def test_a_pushed_block_slides_or_tips():
    """The balances of force and moment. It slides if the push exceeds μ m g. It tips about the
    right corner, and sticks there, if that corner has all the weight and friction holds it."""
    friction, push = jnp.array([0.2, 0.35, 0.45]), jnp.array([3.0, 4.5, 4.5])

    def forces(mu, push):
        block = Block(HALF_WIDTH, HALF_HEIGHT, mu, push=push)
        return vi.contact_forces(block, block.start())

    found = jax.vmap(forces)(friction, push)
    for i, mu in enumerate((0.2, 0.35)):
        right = G / 2 * (1 + mu * HALF_HEIGHT / HALF_WIDTH)
        assert float(found["right"].normal[i]) == pytest.approx(right, abs=1e-12)
        assert float(found["left"].normal[i]) == pytest.approx(G - right, abs=1e-12)
        assert float(found["right"].tangential[i]) == pytest.approx(-mu * right, abs=1e-12)
    # About the corner: (J + m r²) θ'' = m g a - F h; its forces follow from the centre's motion.
    square = HALF_WIDTH**2 + HALF_HEIGHT**2
    turn = (4.5 * HALF_HEIGHT - G * HALF_WIDTH) / (4 / 3 * square)
    assert float(found["left"].normal[2]) == 0.0
    assert float(found["right"].normal[2]) == pytest.approx(G + turn * HALF_WIDTH, abs=1e-12)
    drag = turn * HALF_HEIGHT - 4.5
    assert float(found["right"].tangential[2]) == pytest.approx(drag, abs=1e-12)


class Leaning(vi.Mechanical):
    """A rod of length 1 that leans on a wall."""

    q = ("x", "y", "angle")
    mass = (2.0, 2.0, 2.0 / 12)
    cycle = 0.5

    @property
    def contacts(self):
        sides = dict(
            floor=(lambda q: q.y - 0.5 * jnp.sin(q.angle), lambda q: q.x + 0.5 * jnp.cos(q.angle)),
            wall=(lambda q: q.x - 0.5 * jnp.cos(q.angle), lambda q: q.y + 0.5 * jnp.sin(q.angle)),
        )
        return tuple(
            vi.RigidStop(0.0, 0.0, "left", on=gap, friction=0.5, along=place, name=name)
            for name, (gap, place) in sides.items()
        )

    def force(self, t, q, v):
        return dict(x=0.0, y=-2 * G, angle=0.0)


def test_velocities_of_rounding_are_no_slip():
    """Regression: a block that stood with v = 1e-16 slid, and a corner had more than its weight; a
    rod that had come to lean on a wall did not touch it. Forces and moments balance."""
    block = Block(HALF_WIDTH, HALF_HEIGHT, 0.3)
    for speeds in (dict(x=1e-16), dict(tilt=1e-17), dict(x=-1e-16, y=1e-17, tilt=-1e-16)):
        found = vi.contact_forces(block, block.at(y=HALF_HEIGHT, v=speeds))
        for corner in found.values():
            np.testing.assert_allclose(corner.normal, G / 2, rtol=1e-12)
            assert abs(corner.tangential) < 1e-12
    rod, angle = Leaning(), 1.3
    start = rod.at(x=0.5 * np.cos(angle), y=0.5 * np.sin(angle), angle=angle)
    for state in (start, vi.simulate(rod, start, 7).last):
        found = vi.contact_forces(rod, state)
        floor, wall = found["floor"], found["wall"]
        assert abs(floor.normal + wall.tangential - 2 * G) < 1e-12
        assert abs(floor.tangential + wall.normal) < 1e-12
        across, up = np.cos(angle), np.sin(angle)
        moment = (floor.normal - wall.tangential) * across + (floor.tangential - wall.normal) * up
        assert abs(moment) < 1e-12 and min(floor.normal, wall.normal) > 1


class Several(vi.AbstractMachine):
    """A body on a soft stop, with dry friction."""

    cycle = 2 * np.pi
    contacts = (
        vi.SoftStop(0.1, 50.0, on=("x", "u"), mass=2.0),
        vi.DryFriction(0.5, on="u", mass=2.0, name="guide"),
    )

    def field(self, t, z):
        return dict(x=z.u, u=0.15 - 0 * z.x)


def test_soft_stops_and_dry_friction():
    """A spring's force at its depth; friction that slides, and that holds the applied force."""
    machine = Several()
    sliding = vi.contact_forces(machine, vi.State(x=0.14, u=0.3))
    assert float(sliding["right soft stop"].normal) == pytest.approx(-50.0 * -0.04, rel=1e-12)
    assert float(sliding["guide"].tangential) == -0.5
    held = vi.contact_forces(machine, vi.State(x=0.0, u=0.0))
    assert float(held["right soft stop"].normal) == 0.0
    assert float(held["guide"].tangential) == pytest.approx(-0.3, abs=1e-15)


class Table(vi.Mechanical):
    """A ball on a table, and a weight on a soft stop."""

    q = ("x", "y", "w")
    mass = (2.0, 2.0, 0.5)
    push: float = 1.0
    cycle = 2 * np.sqrt(2 * 0.3 / G)
    contacts = (
        vi.RigidStop(0.0, 1.0, "left", on="y", friction=0.1, along="x", name="table"),
        vi.SoftStop(0.0, 50.0, side="left", on="w", name="spring"),
    )

    def force(self, t, q, v):
        return dict(x=self.push, y=-2.0 * G, w=-0.5 * G)


def test_forces_as_a_measure():
    """The weights at rest; and the momentum of a ball that bounces without loss, which a force
    along the table accelerates from one impact to the next, where it sticks."""
    table, measure = Table(), vi.ContactForces(samples=16, impacts=8)
    start = table.at(w=-0.5 * G / 50)
    axes = {"start.y": [0.0, 0.3]}
    found = vi.scan(table, axes, start=start, settle=0, cycles=3, measure=measure)
    rests, bounces = (found.isel({"start.y": i}) for i in range(2))
    given = dict(start=start, settle=0, cycles=3, measure=measure)
    swept = vi.sweep(table, "push", [1.0, 1.5], **given).measured
    np.testing.assert_allclose(swept["table_normal"], [2 * G, 2 * G], rtol=1e-12)
    np.testing.assert_allclose(swept["table_tangential_max"], [1.0, 1.5], rtol=1e-12)
    for data in (rests, bounces):
        assert float(data.spring_normal) == pytest.approx(0.5 * G, rel=1e-9)
    assert float(rests.table_normal) == pytest.approx(2 * G, rel=1e-12)
    assert float(rests.table_tangential_max) == pytest.approx(1.0, rel=1e-12)
    assert float(rests.table_impulse) == float(bounces.table_normal) == 0.0
    assert float(bounces.table_impulse) == pytest.approx(2 * G * table.cycle, rel=1e-9)
    assert float(bounces.table_drag) == pytest.approx(-2.5 / 3 * table.cycle, rel=1e-9)
