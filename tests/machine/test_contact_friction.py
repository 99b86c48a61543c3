"""Friction along a stop, in impacts and while a body rests on it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from rubbing import Block, Rubbing


@pytest.mark.slow
@pytest.mark.parametrize("along", [0.0, 0.5])
def test_oblique_impact_slips_or_sticks(along):
    """Closed form: the tangential impulse is at most μ (1 + k) v at the approach speed v."""
    k, mu = 0.8, 0.3

    def run(u, v):
        block = Block(mu, k, along)
        return vi.simulate(block, block.at(y=0.5, v=dict(x=u, y=-v)), 1, impact_log=40)

    u, v = (x.ravel() for x in jnp.meshgrid(jnp.linspace(-2, 2, 9), jnp.linspace(0, 2, 5)))
    runs = jax.vmap(run)(u, v)
    assert bool(runs.successful.all())
    for i in range(len(u)):
        slip, lost = float(u[i]), 0.0
        for speed in runs.impact_log.speed[i, 0]:
            if not np.isnan(speed):
                most, sticks = mu * (1 + k) * speed, -(1 + along) * slip
                new = slip + float(np.clip(sticks, -most, most))
                lost += 0.5 * (slip**2 - new**2) + 0.5 * (1 - k * k) * float(speed) ** 2
                slip = new
        if int(runs.impacts[i, 0]) < 40 and runs.last.y[i] > 0:  # still bouncing
            assert float(runs.last.v.x[i]) == pytest.approx(slip, abs=1e-9)
            assert float(runs.impact_energy[i, 0]) == pytest.approx(lost, abs=1e-9)
    # Without tangential restitution (`along`), no body reverses its tangential velocity.
    assert along or bool((runs.last.v.x * u >= -1e-12).all())


def test_a_block_slides_to_rest():
    """The block lands without restitution, with speed 1 along the floor and √0.02 downwards. The
    impact takes μ times the downward speed. Then the block slides over v²/(2μ)."""
    mu = 0.3
    run = vi.simulate(Block(mu), Block().at(y=0.01, v=dict(x=1.0)), 1, event_log=6)
    fall = np.sqrt(0.02)
    speed = 1 - mu * fall
    assert run.event_log.kind[0, :3].tolist() == [0, 1, 3]  # hit, rests, sticks
    np.testing.assert_allclose(
        run.event_log.phase[0, :3], [fall, fall, fall + speed / mu], atol=1e-9
    )
    np.testing.assert_allclose(float(run.last.x), fall + speed**2 / (2 * mu), atol=1e-9)
    assert float(run.last.v.x) == 0.0


@pytest.mark.slow
def test_a_block_bounces_to_rest_while_it_slides():
    """Momentum balance: the floor's impulses, with infinitely many last bounces, balance the
    weight. The impulse of friction is μ times as large."""
    mu, restitution, way = 0.3, 0.5, -1
    block = Block(mu, restitution)
    start = block.at(y=1.0, v=dict(x=15.0 * way))
    run = vi.simulate(block, start, 1, method="reference", max_impacts=100)
    assert int(run.rests[0]) == 1
    assert float(run.last.v.x) == pytest.approx(way * (15 - mu * 2 * np.pi), abs=1e-12)
    # The loss in bounces: the energy 1 of the fall, and the work of friction until the bounces end.
    falls = np.sqrt(2.0)
    rests = falls * (1 + restitution) / (1 - restitution)
    speed = 15 - mu * rests
    lost = 1 + 0.5 * (15**2 - speed**2)
    # In the last bounces, 8e-6 of the longest step, the body already counts as resting.
    held = mu * 15 * 8e-6 * 2 * np.pi / 5
    assert lost - held < float(run.impact_energy[0]) <= lost + 1e-9


def force(machine, s, z):
    return machine.numbers["pull"] * jnp.cos(s)


def pressing(machine, s, z):
    return 1 - machine.numbers["lift"] * jnp.sin(2 * s)


def ends(pull, lift, one):
    if one:
        run = vi.simulate(Block(0.3, pull=pull, lift=lift), Block().at(v=dict(x=0.2)), 4)
        return jnp.stack([run.last.x, run.last.v.x])
    start = vi.OscillatorState(jnp.array(0.0), jnp.array(0.2))
    machine = Rubbing(force, 0.3, {"pull": pull, "lift": lift}, pressing)
    run = vi.simulate(machine, start, 4)
    return jnp.stack([run.last.Y, run.last.V])


PULLS = jnp.array([0.2, 0.5, 1.1])


@pytest.mark.slow
@pytest.mark.parametrize("lift", [0.0, 0.6])
def test_contact_friction_equals_dry_friction_under_the_same_load(lift):
    """Compare stick–slip motions and their derivatives with dry friction under a given load."""

    def both(pull, one):
        return ends(pull, lift, one), jax.jacfwd(lambda x: ends(x, lift, one))(pull)

    one, other = (jax.vmap(lambda x, w=w: both(x, w))(PULLS) for w in (1, 0))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)


class Kane(vi.Mechanical):
    """Coordinates along and across a floor, coupled by their masses (T. R. Kane)."""

    q = ("x", "y")
    cycle = 1.0
    contacts = vi.RigidStop(0.0, 1.0, "left", on="y", friction=0.3, along="x")

    def mass(self, q):  # pyright: ignore[reportIncompatibleVariableOverride]
        return [[1 / 0.36, -0.8 / 0.36], [-0.8 / 0.36, 1 / 0.36]]

    def force(self, t, q, v):
        return dict(x=0.0, y=0.0)


def test_an_impact_that_would_gain_energy_is_counted():
    """The first impact takes a share of the restitution that keeps the energy; its numbers are in
    closed form, the root of a quadratic equation."""
    machine = Kane()
    run = vi.simulate(machine, machine.at(y=0.5, v=dict(x=-1.0, y=-1.0)), 2, impact_log=1)
    assert run.reduced.tolist() == [1, 0]
    np.testing.assert_allclose([run.last.v.y, run.last.v.x], [0.801749409, 0.230800893], atol=1e-9)
    assert float(run.impact_energy[0]) == pytest.approx(0.0, abs=1e-14)
    # The impulses change the velocities by the inverse of the masses.
    gains = np.linalg.inv(machine.mass(None))
    push = [float(run.impact_log.drag[0, 0]), float(run.impact_log.impulse[0, 0])]
    np.testing.assert_allclose(gains @ push, [1.230800893, 1.801749409], atol=1e-9)


class Pressed(vi.Mechanical):
    """A body that rubs on a wall and on a floor, on which a spring presses more to the left."""

    q = ("x", "y")
    mass = (1.0, 2.0)
    cycle = 2 * jnp.pi / 0.8
    contacts = (
        vi.RigidStop(0.0, 0.4, "left", on="y", friction=0.3, along="x"),
        vi.DryFriction(0.05, on="x"),
    )

    def force(self, t, q, v):
        link = 0.5 * (q.x - q.y)
        return dict(x=jnp.cos(0.8 * t) - q.x - 0.1 * v.x - link, y=link - 1.0 - q.x)


class PressedByLaw(vi.Mechanical):
    """The same as a body that rubs once."""

    q = "x"
    mass = 1.0
    cycle = Pressed.cycle
    contacts = vi.DryFriction(1.0, on="x", load=lambda z: 0.05 + 0.3 * (1 + 0.5 * z.x))

    def force(self, t, q, v):
        return dict(x=jnp.cos(0.8 * t) - 1.5 * q.x - 0.1 * v.x)


def test_friction_on_a_stop_and_dry_friction_release_a_body_together():
    """Once each released the body to the other at the same instant, without end."""
    pair, one = Pressed(), PressedByLaw()
    run = vi.simulate(pair, pair.at(x=0.2), 2)
    other = vi.simulate(one, one.at(x=0.2), 2)
    np.testing.assert_allclose(run.sections.x, other.sections.x, atol=1e-10)
    np.testing.assert_allclose(run.sections.v.x, other.sections.v.x, atol=1e-10)


class Falling(vi.Mechanical):
    """Three blocks that touch one another, above a floor."""

    masses: object = None
    restitution: object = 0.0
    q = ("x0", "y0", "x1", "y1", "x2", "y2")
    cycle = 0.25

    def mass(self, q):
        return tuple(self.masses[i // 2] for i in range(6))

    @property
    def contacts(self):
        def between(axis, i):
            return lambda q: getattr(q, f"{axis}{i}") - (getattr(q, f"{axis}{i - 1}") if i else 0)

        return tuple(
            vi.RigidStop(
                0.0, self.restitution, "left", on=between("y", i), friction=0.3 + 0.2 * i,
                along=between("x", i),
            )
            for i in range(3)
        )  # fmt: skip

    def force(self, t, q, v):
        return {
            f"{axis}{i}": g * self.masses[i]
            for axis, g in dict(x=0, y=-9.81).items()
            for i in range(3)
        }


def test_bodies_that_touch_fall_together_without_a_force():
    """Rounding of a force that is zero pressed one on another and released its friction, without
    end. Two bodies move on as one, and all are at rest on the floor in the end."""

    def one(masses, restitution, height):
        falling = Falling(masses, restitution)
        start = falling.at(y0=height, y1=height, y2=height, v=dict(x0=0.1, x1=0.1, x2=0.4))
        return vi.simulate(falling, start, 6)

    masses = jnp.asarray(np.random.default_rng(3).uniform(0.3, 3.0, (24, 3)))
    cases = jnp.tile(jnp.asarray([0.0, 0.3]), 12), jnp.repeat(jnp.asarray([0.02, 0.5]), 12)
    run = jax.vmap(one)(masses, *cases)
    assert bool(run.successful.all())
    first = jax.tree.map(lambda x: x[12:, 1], run.sections)  # still in the air
    for i, slip in enumerate((0.1, 0.1, 0.4)):
        expected = 0.5 - 0.5 * 9.81 * Falling.cycle**2
        np.testing.assert_allclose(getattr(first, f"y{i}"), expected, atol=1e-13)
        np.testing.assert_allclose(getattr(first, f"x{i}"), slip * Falling.cycle, atol=1e-13)
    for i in range(3):
        place, speed = getattr(run.last, f"y{i}")[:, None], getattr(run.last.v, f"y{i}")[:, None]
        np.testing.assert_allclose(jnp.hstack([place, speed]), 0, atol=1e-12)
