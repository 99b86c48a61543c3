"""Planar bodies with corners on a floor: blocks that slide, tip, land and bounce, and Painlevé's
rod. Numbers of blocks are closed forms, or follow from the linear complementarity problem."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from planar import Block, Rod

SHORT = 1e-4


@pytest.fixture(scope="module")
def blocks():
    """Return a function that simulates many blocks for a cycle; one program does it for all."""

    def one(given, speeds):
        drop = given.pop("drop")
        machine = Block(**given)
        start = machine.at(y=machine.half_height + drop, v=speeds)
        run = vi.simulate(machine, start, 1, event_log=8)
        return run, machine.energy(run.last) - machine.energy(start)

    def many(*cases):
        defaults = dict(half_width=0.2, half_height=0.5, mu=0.3, restitution=0.0, push=0.0)
        rows = [{**defaults, "weight": 9.81, "cycle": SHORT, "drop": 0.0, **x} for x, _ in cases]
        rows += rows[-1:] * (16 - len(rows))
        speeds = [v for _, v in cases] + [cases[-1][1]] * (16 - len(cases))
        columns = {name: jnp.array([x[name] * 1.0 for x in rows]) for name in rows[0]}
        v = dict(zip(("x", "y", "tilt"), jnp.array(speeds, float).T, strict=True))
        return program(columns, v)

    program = jax.jit(jax.vmap(one))
    return many


def velocities(run, count):
    return np.stack([run.last.v.x, run.last.v.y, run.last.v.tilt], 1)[:count]


STILL = (0, 0, 0)


@pytest.mark.slow
def test_blocks_land_on_one_corner_and_on_two(blocks):
    """Falls of a flat block, and G. W. Housner's block that turned about its other corner."""
    flat = dict(half_width=0.5, half_height=0.25, restitution=0.5, weight=0.0)
    tall = dict(half_width=0.25, half_height=1.0)
    speeds, frictions = [(0, -1, 0), (1, -1, 0), (0.3, -1, 0.2)], (0.0, 1e-12, 0.1)
    cases = [({**flat, "mu": mu}, v) for v in speeds for mu in frictions]
    cases += [({**tall, "mu": mu, "weight": 0.0}, (1, -0.25, -1)) for mu in (2, 0.1, 0)]
    cases += [({**tall, "mu": mu}, (1, -0.25, -1)) for mu in (2, 0.1)]
    run, gain = blocks(*cases)
    assert bool(run.successful.all()) and bool((gain < 1e-14).all())
    found = velocities(run, 14)
    # The same without friction and with hardly any.
    np.testing.assert_allclose(found[1:9:3], found[:9:3], atol=3e-12)
    for i, v in enumerate(speeds[:2]):
        np.testing.assert_allclose(found[3 * i], [v[0], 0.5, 0], atol=1e-12)
        drag = 0.1 * 1.5 * np.sign(v[0])
        np.testing.assert_allclose(found[3 * i + 2], [v[0] - drag, 0.5, 0], atol=1e-12)
    # Two corners that strike one after the other, then the first again.
    smooth, rough = (0.369822410, 0.314125789), (0.264625105, 0.359846513, 0.365945257)
    np.testing.assert_allclose(found[6], (0.3, *smooth), atol=1e-9)
    np.testing.assert_allclose(found[8], rough, atol=1e-9)
    ratio = 1 - 1.5 * np.sin(np.arctan(0.25)) ** 2
    np.testing.assert_allclose(-found[9:12, 2], [ratio, 0.808510638, 0.7], atol=1e-9)
    assert abs(found[9, 2] + ratio) < 1e-12
    # Under its weight it rests on that corner and turns on.
    assert run.rests[12:14, 0].tolist() == [1, 1]
    np.testing.assert_allclose(found[12:, 2], found[9:11, 2], atol=20 * SHORT)


@pytest.mark.slow
def test_a_block_that_falls_flat_bounces_to_rest_without_turning(blocks):
    """It falls by 0.05 m with g = 10, so it strikes at 0.1 s, and every bounce is half as long."""
    fall = dict(half_width=1.0, half_height=0.1, restitution=0.5, drop=0.05, weight=10.0, cycle=1.5)
    run, gain = blocks(*(({**fall, "mu": mu}, STILL) for mu in (0.0, 1e-12, 0.5)))
    np.testing.assert_allclose(gain[:3], -0.5, atol=1e-12)
    np.testing.assert_allclose(run.last.y[:3], 0.1, atol=1e-15)
    for part in (run.last.tilt, run.last.v.tilt, run.last.v.x, run.last.x):
        np.testing.assert_allclose(part[:3], 0.0, atol=2e-12)
    expected = np.repeat([0.1, 0.2, 0.25, 0.275], 2)
    np.testing.assert_allclose(run.event_log.phase[:3, 0], [expected] * 3, atol=1e-10)
    assert (run.rests[:3, 0] == 2).all()


class Box(vi.Mechanical):
    """A box on two supports without friction, which bounces without loss."""

    q, mass = ("y", "turn"), (1.0, 1 / 6)
    half: float = 0.5
    cycle = 2 * np.sqrt(2 / 9.81)

    @property
    def contacts(self):
        reach = lambda q, side: q.y + side * self.half * jnp.tan(q.turn) - 0.5 / jnp.cos(q.turn)
        sides = (lambda q: reach(q, -1)), (lambda q: reach(q, 1))
        return tuple(vi.RigidStop(0.0, 1.0, "left", on=x) for x in sides)

    def force(self, t, q, v):
        return dict(y=-9.81, turn=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["standard", "reference"])
def test_a_box_falls_flat_for_ever(method):
    def run(half):
        box = Box(half)
        return vi.simulate(box, box.at(y=1.5), 100, method=method)

    found = jax.vmap(run)(jnp.array([0.3, 0.375, 0.4, 0.5]))
    assert bool(found.successful.all()) and bool((found.impacts == 2).all())
    np.testing.assert_allclose(found.sections.turn, 0.0, atol=1e-10)
    np.testing.assert_allclose(found.sections.y, 1.5, atol=1e-10)


class Table(Box):
    """A table in a plane, with as many legs as hold it and one more."""

    restitution: Any = 0.0
    middle: Any = 0.0
    inertia: Any = 1 / 6

    def mass(self, q):  # pyright: ignore[reportIncompatibleVariableOverride]
        return 1.0, self.inertia

    @property
    def contacts(self):
        height = lambda q, b: q.y + b * jnp.sin(q.turn)
        legs = (lambda q, b=b: height(q, b) for b in (-1.0, self.middle, 1.0))
        return tuple(vi.RigidStop(0.0, self.restitution, "left", on=leg) for leg in legs)


def test_a_table_comes_to_rest():
    """If it falls flat, its spare leg rests when the others do: tested one by one, none of the legs
    was pressed on while the others were held. If it falls obliquely, its legs strike in turn: those
    whose hops are over rest, though another one is about to strike. A leg below the centre could
    carry the table alone, so that the others never came to rest."""

    def run(restitution, middle, inertia, tilt):
        table = Table(0.5, restitution, middle, inertia)
        start = table.at(y=0.1 + jnp.sin(tilt), turn=tilt)
        found = vi.simulate(table, start, 3, max_impacts=1000)
        return found.last, found.successful, found.rests[0]

    shares, tilts = jnp.array([0.0, 0.3, 0.5, 0.7]), jnp.tile(jnp.linspace(0.01, 0.2, 10), 2)
    flat = shares, 0 * shares, 0 * shares + 1 / 6, 0 * shares
    kinds = (jnp.repeat(jnp.array(x), 10) for x in ((0.3, 0.7), (0.2, 0.0), (0.4, 0.6)))
    lanes = (jnp.concatenate(x) for x in zip(flat, (*kinds, tilts), strict=True))
    last, good, rests = jax.vmap(run)(*lanes)
    assert bool(good.all()) and bool((rests[:4] > 0).all())
    for x in (last.y, last.turn, last.v.y, last.v.turn):
        np.testing.assert_allclose(x, 0.0, atol=1e-14)


def test_a_rod_that_slides_into_the_ground_jams():
    """P. Painlevé's rod: beyond this friction no acceleration fulfils Coulomb's law, unless the rod
    turns fast enough to lift its end."""
    limit = (1 + 3 * np.cos(1) ** 2) / (3 * np.sin(1) * np.cos(1))
    below, beyond = limit * (1 - 1e-6), limit * (1 + 1e-6)

    def one(mu, slip, turning, cycle):
        rod = Rod(mu=mu, cycle=cycle)
        start = rod.sliding(1.0, slip, turning)
        run = vi.simulate(rod, start, 1)
        tip = run.last.y - jnp.sin(run.last.theta)
        return run.result, run.last.v.theta, tip, rod.energy(run.last) - rod.energy(start)

    cases = [
        (below, -1, 0, 1e-7), (beyond, -1, 0, 1e-7), (1.6, -1, 0, 1e-2),
        (1.6, -1, 4, 1e-5), (1.6, 1, 0, 1e-5), (0.8, -1, 0, 1e-5),
    ]  # fmt: skip
    result, turning, tip, gain = jax.vmap(one)(*jnp.array(cases, float).T)
    jams = result == vi.RESULTS.jammed
    assert jams.tolist() == [False, True, True, False, False, False]
    assert bool((result == vi.RESULTS.successful)[~jams].all())
    # Lift-off with the acceleration of the free end; the others stay on the floor.
    np.testing.assert_allclose(tip[3], 0.5 * 3.65353576 * 1e-10, rtol=1e-4)
    np.testing.assert_allclose(tip[4:], 0.0, atol=1e-15)
    # θ'' = 3 λ (μ σ' sin θ - cos θ), with the normal force λ and the friction against the slip.
    s, c, times = np.sin(1), np.cos(1), 1e-5
    for i, push, drag in ((4, 2.41739128, -1.6), (5, 12.5028225, 0.8)):
        np.testing.assert_allclose(turning[i] / times, 3 * push * (drag * s - c), rtol=1e-3)
    assert bool((gain[~jams] < 1e-12).all())


def test_rods_of_any_mass_ratio_jam_beyond_painleves_limit():
    """With inertia J, mass and half-length 1, p = 1 + cos²θ/J - μ sinθ cosθ/J for slip -1, so that
    the rod jams for μ > (J + cos²θ)/(sinθ cosθ). At rest across the
    floor b = -g."""

    def result(inertia, theta, share):
        s, c = jnp.sin(theta), jnp.cos(theta)
        rod = Rod(mu=share * (inertia + c * c) / (s * c), inertia=inertia, cycle=1e-6)
        return vi.simulate(rod, rod.sliding(theta, -1.0, 0.0), 1).successful

    J, theta, share = (
        x.ravel() for x in jnp.meshgrid(
            jnp.asarray([0.05, 0.2, 1 / 3, 1.2]), jnp.asarray([0.4, 1.0, 1.3]),
            jnp.asarray([0.99, 1.0 - 1e-6, 1.0 + 1e-6, 1.01]),
        )
    )  # fmt: skip
    np.testing.assert_array_equal(jax.jit(jax.vmap(result))(J, theta, share), share < 1)


def test_a_rod_that_bounces_to_rest_sticks_at_once():
    """Its last bounces are summed up, and in their time the tip gets a slip of second order."""

    def one(mu, restitution):
        rod = Rod(mu=mu, restitution=restitution, cycle=0.3)
        start = rod.sliding(1.2, -1.0, -2.0)
        run = vi.simulate(rod, start.replace(y=start.y + 0.01), 1, event_log=80, max_impacts=200)
        return run.successful, run.event_log

    good, log = jax.jit(jax.vmap(one))(*jnp.array([(0.8, 0.3), (0.8, 0.6), (1.6, 0.3)]).T)
    kind, phase = np.asarray(log.kind)[:, 0], np.asarray(log.phase)[:, 0]
    rest, mode = (kind == vi.EVENTS.index(x) for x in ("rest", "mode"))
    assert bool(good.all()) and (rest.sum(1) == 1).all()
    assert not (mode & (np.abs(phase - phase[rest][:, None]) < 1e-6)).any()


@pytest.mark.slow
def test_two_corners_hold_a_block_together(blocks):
    """The corners have linearly dependent tangents, so their forces are not unique. With friction
    0.3 they hold the block up to a force of 2.943 N; one of them would reach its bound at 1.4 N."""
    pushes, speeds = (2.0, 2.9, 2.95, 2.0, 4.0), (0.0, 0.0, 0.0, 0.5, -0.5)
    cases = [(dict(push=f, cycle=0.6), (v, 0, 0)) for f, v in zip(pushes, speeds, strict=True)]
    run, _ = blocks(*cases)
    bound = 0.3 * 9.81
    slides, stops = 0.6 * (2.95 - bound), 0.5 / (bound - 2)
    turns = 0.5 / (bound + 4)
    expected = [0.0, 0.0, 0.5 * 0.6 * slides, 0.5 * 0.5 * stops]
    expected += [-0.25 * turns + 0.5 * (4 - bound) * (0.6 - turns) ** 2]
    assert bool(run.successful.all())
    np.testing.assert_allclose(run.last.x[:5], expected, atol=1e-11)
    np.testing.assert_allclose(run.last.tilt[:5], 0.0, atol=1e-14)
    np.testing.assert_allclose(run.last.v.x[:4], [0, 0, slides, 0], atol=1e-12)


@pytest.mark.slow
def test_tall_blocks_rock_to_rest():
    """Blocks that are dropped on one corner, and rock and bounce. Each rock ends in many impacts of
    one corner, and the rocks get shorter without end; in 3 s all come to rest."""

    def one(mu, restitution, tilt):
        block = Block(mu=mu, restitution=restitution, cycle=3.0)
        lift = block.half_height * jnp.cos(tilt) + block.half_width * jnp.sin(tilt)
        start = block.at(y=lift + 0.01, tilt=tilt)
        run = vi.simulate(block, start, 1, max_impacts=5000)
        lost = block.energy(start) - block.energy(run.last)
        return run.successful, run.last, lost - run.impact_energy[0]

    cases = [(mu, e, tilt) for mu in (0.0, 0.3, 1.0) for e in (0.0, 0.5) for tilt in (0.02, 0.2)]
    good, last, slid = jax.jit(jax.vmap(one))(*jnp.array(cases).T)
    assert bool(good.all())
    np.testing.assert_allclose(last.y, 0.5, atol=1e-14)
    np.testing.assert_allclose([last.tilt, last.v.tilt, last.v.y], 0.0, atol=1e-14)
    # Friction does the rest of the work, and none without friction. The last impacts before each
    # rest are summed up, with an error of second order in the time that they take.
    assert bool((slid > -1e-8).all())
    np.testing.assert_allclose(slid[:4], 0.0, atol=1e-8)


class Feet(Block):
    """A body with feet at these places, on a floor that is shaken."""

    feet: tuple = (-0.2, 0.2)
    size: Any = 3.0
    cycle = 0.5

    @property
    def places(self):
        return dict(zip("abc", self.feet, strict=False))

    def force(self, t, q, v):
        return dict(x=self.size * jnp.sin(4 * jnp.pi * t), y=-9.81, tilt=0.0)


@pytest.mark.slow
def test_a_third_foot_between_two_changes_nothing():
    """The load moves from one side of the middle foot to the other, and the body slides or tips:
    two feet carry it at a time, and a third one takes over."""

    def one(mu, size, places):
        body = Feet(mu=mu, size=size, feet=places)
        run = vi.simulate(body, body.at(y=0.5), 2)
        last = run.last
        return run.successful, jnp.stack([last.x, last.y, last.tilt, last.v.x, last.v.tilt])

    cases = jnp.array([(0.2, 3.0), (0.9, 3.0), (0.45, 5.0), (0.9, 6.0)]).T
    many = lambda places: jax.jit(jax.vmap(lambda *x: one(*x, places)))(*cases)
    (two, expected), (three, found) = many((-0.2, 0.2)), many((-0.2, 0.05, 0.2))
    assert bool(two.all()) and bool(three.all())
    np.testing.assert_allclose(found[:2], expected[:2], atol=1e-12)
    # After landings on two feet in turn, which are summed up.
    np.testing.assert_allclose(found[2:], expected[2:], atol=2e-6)


@pytest.mark.slow
def test_a_third_foot_comes_to_rest_with_two_others():
    """The body is dropped on one foot and bounces to rest on all."""

    def one(mu, size, tilt, places):
        body = Feet(mu=mu, size=size, feet=places, restitution=0.3)
        lift = jnp.maximum(-tilt * places[-1], -tilt * places[0]) + 0.5
        run = vi.simulate(body, body.at(y=lift, tilt=tilt), 2, max_impacts=2000)
        last = run.last
        return run.successful, jnp.stack([last.x, last.y, last.tilt, last.v.x, last.v.tilt])

    cases = jnp.array([(0.27, 3.0, 0.01), (0.5, 2.0, -0.02), (0.5, 2.0, 0.04)]).T
    many = lambda places: jax.jit(jax.vmap(lambda *x: one(*x, places)))(*cases)
    (two, expected), (three, found) = many((-0.33, 0.54)), many((-0.33, 0.0002, 0.54))
    assert bool(two.all()) and bool(three.all())
    np.testing.assert_allclose(found, expected, atol=1e-10)


@pytest.mark.slow
def test_feet_rest_with_the_friction_of_another():
    """One foot has the friction of all. When another was tested for rest without that foot, no
    friction held the body, nothing pressed the foot on, and it bounced on for ever."""

    def one(mu, size, tilt):
        body = Feet(mu=mu, size=size, feet=(-0.25, 0.0, 0.25), restitution=0.3)
        start = body.at(y=0.5 + 0.25 * tilt, tilt=tilt)
        return vi.simulate(body, start, 3, max_impacts=2000)

    cases = jnp.array([(0.9154, 0.5248, 0.0281), (0.7814, 3.0197, 0.012), (0.8044, 1.4187, 0.0252)])
    run = jax.jit(jax.vmap(one))(*cases.T)
    assert bool(run.successful.all())
    assert int(run.impacts[:, 2].max()) == 0  # it has rocked to rest
    np.testing.assert_allclose(run.last.tilt, 0.0, atol=1e-12)


@pytest.mark.slow
def test_a_corner_that_another_impact_lifts_is_released():
    """The corners rest from the start."""
    block = Feet(mu=0.45, size=-6.0)
    log = vi.simulate(block, block.at(y=0.5), 4, event_log=16).event_log
    kinds, numbers = np.asarray(log.kind).ravel(), np.asarray(log.number).ravel()
    held = np.isin(kinds, [vi.EVENTS.index(x) for x in ("rest", "release")])
    for corner in (0, 1):
        of_corner = kinds[held & (numbers == corner)]
        assert len(of_corner) >= 7 and (np.diff(of_corner) != 0).all()  # rests and releases in turn


def test_corners_of_a_sliding_block_that_strike_in_turn_come_to_rest():
    """A tall block slides on one corner while the other hops. Each landing closes the first corner,
    too. Let p_ij be the change of the speed of corner i by an impulse on corner j with its
    friction. With restitution e the hopping corner leaves with e - p₀₁p₁₀(1 + e)/(p₀₀p₁₁) of
    its speed. With the motion of first order within the brief chatter of the other corner it
    gained speed, and went on for ever."""
    a, h, mu, e, speed = 0.26, 0.44, 0.54, 0.7, 1e-5
    block = Block(half_width=a, half_height=h, mu=mu, restitution=e, weight=6.2, cycle=0.5)
    inertia = (a * a + h * h) / 3
    p = [[1 + i * a * (j * a - mu * h) / inertia for j in (-1, 1)] for i in (-1, 1)]
    share = e - p[0][1] * p[1][0] * (1 + e) / (p[0][0] * p[1][1])
    start = block.at(y=h, v=dict(x=1.0, y=0.5 * speed, tilt=-0.5 * speed / a))
    run = vi.simulate(block, start, 1, max_impacts=5000, impact_log=4000)
    assert run.successful
    # At the end only friction acts, until the block sticks.
    np.testing.assert_allclose(run.last.x, 0.5 / (mu * 6.2), rtol=1e-4)
    np.testing.assert_allclose([run.last.y, run.last.tilt], [h, 0.0], atol=1e-14)
    speeds = np.asarray(run.impact_log.speed[0])[np.asarray(run.impact_log.stop[0]) == 0]
    speeds = speeds[speeds > 1e-6]
    np.testing.assert_allclose(speeds[1:] / speeds[:-1], share, rtol=2e-3)
    np.testing.assert_allclose(speeds[-1] / speeds[0], share ** (len(speeds) - 1), rtol=2e-2)


class InACorner(vi.Mechanical):
    """A body on a floor that is pushed on a wall, whose friction holds it, too."""

    q = ("x", "y")
    mass = (1.0, 1.0)
    cycle = 1.0
    mu: Any = 0.5
    contacts = property(
        lambda self: (
            vi.RigidStop(0.0, 0.5, "left", on="x", friction=self.mu, along="y"),
            vi.RigidStop(0.0, 0.5, "left", on="y"),
        )
    )

    def force(self, t, q, v):
        return dict(x=-5.0, y=1.0 - 4 * t)


def test_a_floor_takes_over_when_the_friction_of_a_wall_is_at_its_bound():
    """The friction holds the body alone until the force exceeds 5 μ. The body fell through the
    floor, since the solver was asked once more at the bound, without the event."""
    machine = InACorner()
    run = vi.simulate(machine, machine.at(), 1, event_log=6)
    assert run.successful
    np.testing.assert_allclose([run.last.x, run.last.y, run.last.v.y], 0.0, atol=1e-15)
    stops = [x.normal for x in vi.contact_forces(machine, run.last, 1.0).values()]
    np.testing.assert_allclose(stops[0], 5.0, rtol=1e-12)
    assert stops[1] >= 0.5 - 1e-12
