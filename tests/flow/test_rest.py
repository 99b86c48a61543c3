"""Coming to rest on a stop, resting and leaving, compared with closed forms."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

GAP, K, ZETA, XI = 0.3, 0.4, 0.3, 0.05


def scene(zeta=ZETA, k=K, gap=GAP, xi=XI):
    return vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=gap, damping_ratio=xi)


class Lifted(vi.AbstractMachine):
    """A ball on a floor that accelerates: x'' = -1 + 0.4 t between impacts."""

    k: float

    cycle = 2.0

    @property
    def contacts(self):
        return vi.RigidStop(0.0, self.k, "left", on=("x", "u"))

    def field(self, t, z):
        return dict(x=z.u, u=0.4 * t - 1.0)

    def hop_by_hop(self, x=0.3):
        """Return the instant of rest: the sum of the hops (cubics) and of the last series."""
        time, u = 0.0, 0.0
        roots = np.roots([0.4 / 6, -0.5, u, x])
        hop = min(r.real for r in roots if abs(r.imag) < 1e-12 and r.real > 0)
        while True:
            approach = -(u + (0.4 * time - 1) * hop + 0.2 * hop**2)
            time, u = time + hop, self.k * approach
            force = 1 - 0.4 * time
            if u < 1e-13:
                return time + 2 * u / force / (1 - self.k)
            hop = 2 * u / (force / 2 + np.sqrt(force**2 / 4 - 4 * u * 0.4 / 6))


def rest_of(k):
    run = vi.simulate(Lifted(k), vi.State(x=0.3, u=0.0), 1, event_log=40, method="reference")
    rests = jnp.argmax(run.event_log.kind[0] == vi.EVENTS.index("rest"))
    return run.event_log.phase[0, rests]


@pytest.mark.parametrize("k", [0.2, 0.25, 0.3])
def test_the_instant_of_rest_has_derivatives(k):
    at = lambda k: Lifted(k).hop_by_hop()
    np.testing.assert_allclose(rest_of(k), at(k), atol=1e-9)
    coarse, fine = ((at(k + h) - at(k - h)) / (2 * h) for h in (2e-4, 1e-4))
    # The number of hops before the last series may be another in the difference: 1e-6.
    derivative = (4 * fine - coarse) / 3
    found = jax.jvp(rest_of, (k,), (1.0,))[1]
    np.testing.assert_allclose([found, jax.grad(rest_of)(k)], derivative, rtol=1e-5)


class Tied(vi.AbstractMachine):
    """A ball on a stiff spring, which has the length of the floor's height."""

    cycle = 1.0
    contacts = vi.RigidStop(0.0, 0.9, "left", on=("x", "v"))

    def field(self, t, z):
        return dict(x=z.v, v=-9.81 - 1e5 * z.x)


@pytest.mark.parametrize(("rtol", "error"), [(1e-10, 2e-9), (1e-12, 1e-11), (1e-13, 3e-12)])
def test_the_instant_of_rest_gets_better_with_the_tolerance(rtol, error):
    # Each hop is an arc of an oscillation about -g/k: from its speed follows its duration.
    w, drop = np.sqrt(1e5), 9.81e-5
    u = w * np.sqrt((1 + drop) ** 2 - drop**2)
    time = np.arccos(drop / (1 + drop)) / w
    while u > 1e-9:
        u *= 0.9
        time += 2 * np.arctan2(u / w, drop) / w
    time += 2 * 0.9 * u / 9.81 / 0.1
    method = vi.Adaptive(rtol=rtol)
    run = vi.simulate(Tied(), vi.State(x=1.0, v=0.0), 1, event_log=256, method=method)
    log = run.event_log
    rest = log.phase[log.kind == vi.EVENTS.index("rest")]
    np.testing.assert_allclose(rest, time, rtol=0, atol=error)


@pytest.mark.slow
def test_rest_is_the_same_in_single_precision():
    """Random machines chatter, rest and leave. The lowest hops are smaller than rounding."""
    rng = np.random.default_rng(0)
    lanes, uniform = 200, rng.uniform
    gap = uniform(-0.9, 1, lanes)
    numbers = np.stack([
        uniform(0.02, 0.5, lanes), uniform(0, 0.3, lanes), uniform(0, 0.6, lanes), gap,
        gap - uniform(0, 1.5, lanes) * (rng.random(lanes) > 0.2), uniform(-1, 1, lanes),
    ])  # fmt: skip

    def lane(x):
        zeta, xi, k, gap, Y, V = x
        one = scene(zeta, k, gap, xi)
        run = vi.simulate(one, one.start(Y=Y, V=V), 6, method=vi.ExactFlight(), samples=2)
        return run.successful, run.samples.state.Y, run.rests

    found = {}
    for double in (True, False):
        with jax.enable_x64(double):
            found[double] = [np.asarray(x) for x in jax.jit(jax.vmap(lane))(jnp.asarray(numbers.T))]
    assert found[True][0].all() and found[False][0].all()
    assert np.abs(found[True][1] - found[False][1]).max() < 1e-5
    np.testing.assert_array_equal(found[True][2].sum(1), found[False][2].sum(1))


def test_resting_body_moves_with_its_stop():
    """The position has derivative 1 with respect to the gap, and 0 with respect to its start."""

    def last(gap, start):
        pressed = scene(gap=gap)
        return vi.simulate(pressed, pressed.start(Y=start, V=0.0), 1, settle=3).last.Y

    by_gap, by_start = jax.grad(last, argnums=(0, 1))(-1.5, -1.5)
    assert (float(by_gap), float(by_start)) == (1.0, 0.0)


@pytest.mark.slow
def test_second_derivatives_pass_through_rest_and_release():
    """Derivatives along a direction in all parameters, while the body's force acts on the shaft."""
    numbers = jnp.asarray([0.45, -0.2, 0.8, 0.3, 0.1, -0.7, 0.4])
    direction = jnp.asarray([0.3, 0.3, 0.2, 0.1, 0.1, 0.3, -0.3])

    def run(shift):
        k, gap, control, coupling, xi, Y, V = numbers + shift * direction
        drive = vi.Motor(0.6, control, coupling, 0.1)
        machine = vi.Scene(xi, drive, stops=(vi.RigidStop(gap, k),))
        method = vi.FixedStep(steps_per_cycle=40)
        return vi.simulate(machine, machine.start(Y=Y, V=V, W=0.7), 2, method=method)

    def last(shift):
        return jnp.stack(jax.tree.leaves(run(shift).last))

    assert run(0.0).rests.tolist() == [1, 1]
    orders, h = [jax.jit(last)], 1e-4
    for order in (1, 2):
        orders.append(jax.jit(jax.jacfwd(orders[-1])))
        near, far = ((orders[-2](d) - orders[-2](-d)) / (2 * d) for d in (h, 2 * h))
        found = orders[-1](0.0)
        scale = 1 + float(jnp.abs(found).max())
        assert scale > 1.001, order
        np.testing.assert_allclose(found, (4 * near - far) / 3, atol=1e-7 * scale)


class Body(vi.AbstractMachine):
    """A body of mass one under a force a + b s + c sin s, with drag."""

    force: Any = eqx.field(converter=lambda x: jnp.asarray(x, float))
    contacts: tuple = ()
    drag: Any = eqx.field(default=0.0, converter=lambda x: jnp.asarray(x, float))
    cycle = 2 * jnp.pi

    def field(self, s, state):
        a, b, c = self.force
        pull = a + b * s + c * jnp.sin(s) - self.drag * state.V
        return vi.OscillatorState(state.V, pull)


def at(Y, V):
    return vi.OscillatorState(jnp.asarray(float(Y)), jnp.asarray(float(V)))


def test_a_soft_stop_touched_at_rest():
    """Compare with SciPy under a force that presses, grows from zero, or pulls away."""
    forces = np.repeat([(1.0, 0, 0), (0, 0, 1.0), (-1.0, 0, 0)], 2, axis=0)
    gaps = np.tile([0.0, 1e-12], 3)

    def one(force, gap):
        spring = vi.SoftStop(gap, 50.0, restitution=0.6)
        return vi.simulate(Body(force, contacts=(spring,), drag=0.1), at(0, 0), 1)

    run = jax.vmap(one)(jnp.asarray(forces), jnp.asarray(gaps))
    assert bool(run.successful.all())
    damper = float(vi.SoftStop(0.0, 50.0, restitution=0.6).damping) * np.sqrt(50.0)
    for i, ((a, b, c), gap) in enumerate(zip(forces, gaps, strict=True)):

        def rate(s, x, a=a, b=b, c=c, gap=gap):
            push = 50 * (x[0] - gap) + damper * x[1] if x[0] > gap else 0.0
            return x[1], a + b * s + c * np.sin(s) - 0.1 * x[1] - push

        truth = solve_ivp(rate, (0, 2 * np.pi), (0, 0), rtol=1e-11, atol=1e-13, max_step=1e-2)
        np.testing.assert_allclose([run.last.Y[i], run.last.V[i]], truth.y[:, -1], atol=1e-6)


def test_body_rests_while_a_pressing_force_grows_from_zero():
    """Under sin s the stop holds the body for half a cycle, then releases it."""

    def one(restitution):
        body = Body(jnp.asarray((0, 0, 1.0)), (vi.RigidStop(0.0, restitution),))
        return vi.simulate(body, at(0, 0), 1, event_log=4)

    run = jax.vmap(one)(jnp.array([0.0, 0.3, 0.8]))
    assert bool(run.successful.all()) and int(run.impacts.sum()) == 0
    np.testing.assert_allclose(run.last.Y, -np.pi, atol=1e-9)
    np.testing.assert_allclose(run.last.V, -2.0, atol=1e-9)
    assert (run.event_log.kind[:, 0, 0] == vi.EVENTS.index("release")).all()
    np.testing.assert_allclose(run.event_log.phase[:, 0, 0], np.pi, atol=1e-9)


def test_impact_without_restitution_as_the_force_changes_sign():
    """The force s - 1 changes sign as the body meets the stop at s = 1, where it stays."""
    speed, place = 0.5 + 0.5, -(0.5 - 1 / 3) - 0.5  # at s = 0; they are 0.5 and 0 at s = 1
    body = Body(jnp.asarray((-1.0, 1.0, 0)), (vi.RigidStop(0.0, 0.0),))
    run = vi.simulate(body, at(place, speed), 1, impact_log=4)
    assert bool(run.successful) and int(run.impacts[0]) == 1 and int(run.rests[0]) == 1
    np.testing.assert_allclose(run.impact_log.speed[0, 0], 0.5, rtol=1e-9)
    assert float(run.last.Y) == 0.0 and float(run.last.V) == 0.0


@pytest.mark.slow
def test_every_event_is_logged_in_order():
    """A force presses a ball on a stop in part of each cycle. The log changes no motion."""
    body = Body(jnp.asarray((0.3, 0, 1.0)), (vi.RigidStop(0.0, 0.4),), drag=0.1)
    plain = vi.simulate(body, at(-0.2, 0), 4, impact_log=40)
    run = vi.simulate(body, at(-0.2, 0), 4, impact_log=40, event_log=60)
    split = vi.simulate(body, at(-0.2, 0), 4, samples=7, event_log=60)
    log = run.event_log
    kinds = np.asarray(log.kind)
    for i in range(4):
        count, hits = int(plain.impacts[i]), kinds[i] == 0
        assert hits.sum() == count and (kinds[i] == 1).sum() == run.rests[i]
        np.testing.assert_array_equal(log.phase[i, hits], plain.impact_log.phase[i, :count])
        np.testing.assert_array_equal(log.value[i, hits], plain.impact_log.speed[i, :count])
        used = kinds[i] >= 0
        assert (np.diff(log.phase[i, used]) >= 0).all() and used.argmin() == used.sum()
    # The ball leaves when the force changes sign: sin s = -0.3.
    leaves = np.asarray(log.phase)[kinds == 2]
    assert run.rests.sum() == len(leaves) > 1
    np.testing.assert_allclose(leaves, np.pi + np.arcsin(0.3), atol=1e-9)
    assert (np.asarray(log.number)[kinds >= 0] == 0).all()
    table = run.to_xarray(along="event").to_dataframe()
    assert table.event_kind.tolist() == [vi.EVENTS[k] for k in kinds[kinds >= 0]]
    assert (table.cycle == 1 + np.nonzero(kinds >= 0)[0]).all()
    np.testing.assert_array_equal(split.event_log.kind, kinds)
    np.testing.assert_allclose(split.event_log.phase, log.phase, atol=1e-7)


class _Lever(vi.Mechanical):
    """A body beats another one, with a lever in between whose height is the sine of its angle."""

    q = ("x", "th", "y")
    mass = (1.9, 1.2e-3, 0.6)
    cycle = 1 / 14
    contacts = vi.RigidStop(0.15e-3, 0.6, on=lambda q: q.y - q.x + 0.02 * jnp.sin(q.th))

    def force(self, t, q, v):
        spring = 3e4 * (q.y - q.x) + 15 * (v.y - v.x)
        turn = 2 * jnp.pi * 14 * t
        return dict(
            x=60 * jnp.sin(turn) - 2e4 * q.x - 20 * v.x + spring,
            th=-0.2 * q.th - 2e-3 * v.th + 0.02 * jnp.cos(turn),
            y=-spring,
        )


class _StraightLever(_Lever):
    """The same, with y + 0.02 sin(th) for y: the gap is straight, and the masses depend on th."""

    contacts = vi.RigidStop(0.15e-3, 0.6, on=lambda q: q.y - q.x)

    def mass(self, q):
        arm = 0.02 * jnp.cos(q.th)
        return [[1.9, 0, 0], [0, 1.2e-3 + 0.6 * arm**2, -0.6 * arm], [0, -0.6 * arm, 0.6]]

    def force(self, t, q, v):
        arm = 0.02 * jnp.cos(q.th)
        y, speed = q.y - 0.02 * jnp.sin(q.th), v.y - arm * v.th
        forces = super().force(t, q.replace(y=y), v.replace(y=speed))
        return forces | dict(th=forces["th"] - arm * forces["y"])


def test_releases_from_a_curved_gap():
    """Its rounding once showed an impact at the release, and every lane failed."""
    angles = jnp.linspace(-0.002, 0.002, 8)
    bent, straight = _Lever(), _StraightLever()
    run = jax.vmap(lambda th: vi.simulate(bent, bent.at(x=1e-4, th=th), 60))(angles)
    assert run.successful.all() and (run.rests.sum(axis=1) > 5).all()
    start = dict(x=1e-4, th=angles[0])
    height = 0.02 * jnp.sin(angles[0])
    same = vi.simulate(straight, straight.at(**start, y=height), 18)
    assert same.rests.sum() > 0 and (run.rests[0, :18] == same.rests).all()
    np.testing.assert_allclose(run.sections.x[0, :19], same.sections.x, atol=1e-10)
    np.testing.assert_allclose(run.sections.th[0, :19], same.sections.th, atol=1e-9)


class Pulsed(vi.Mechanical):
    """A block that friction holds, and one that rests on the floor, under a force that jumps to 8 N
    at the time `begin` of each cycle, and falls. Units: m, s, kg, N."""

    level: float = 5.0
    begin: float = 0.0
    q, mass, cycle = ("block", "lifted"), (2.0, 2.0), 0.5

    @property
    def contacts(self):
        floor = vi.RigidStop(0.0, 0.0, "left", on="lifted")
        return floor, vi.DryFriction(self.level, on="block")

    def force(self, t, q, v):
        push = jnp.where(t < self.begin, 0.0, 8.0 - 24.0 * (t - self.begin))
        return dict(block=push, lifted=push - self.level)


@pytest.mark.filterwarnings("ignore:.*cycle")
def test_a_force_that_jumps_releases_held_bodies():
    def found(level, begin):
        machine = Pulsed(level=level, begin=begin)
        run = vi.simulate(machine, machine.at(), 1, settle=1)
        return jnp.stack([run.y_max[0], (run.last.block - run.sections.block[0])])

    # Along y'' = (8 - L)/2 - 12 t the top is reached at twice the time at which the force vanishes.
    top = lambda level: ((8 - level) / 2) ** 3 / 216
    wanted = jnp.stack([top(5.0), top(5.0)])
    np.testing.assert_allclose(found(5.0, 0.0), wanted, rtol=1e-9)
    np.testing.assert_allclose(found(5.0, 0.2), wanted, rtol=1e-6)
    slopes = jax.jacfwd(found)(5.0, 0.0)
    np.testing.assert_allclose(slopes, jax.grad(top)(5.0) * jnp.ones(2), rtol=1e-9)
    # JAX does not show where the force jumps: the instant has no derivative.
    assert np.isnan(jax.jacfwd(found)(5.0, 0.2)).all()
