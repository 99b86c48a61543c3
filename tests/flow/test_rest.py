"""Coming to rest on a stop, staying there, leaving: beside closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.optimize import brentq

METHODS = [vi.ExactFlight(), vi.Adaptive(rtol=1e-11), vi.FixedStep(steps_per_cycle=64)]
IDS = ["exact", "adaptive", "fixed"]
GAP, K, ZETA, XI = 0.3, 0.4, 0.3, 0.05


def scene(zeta=ZETA, k=K, gap=GAP, xi=XI):
    return vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=gap, damping_ratio=xi)


class Ball(eqx.Module):
    """Height Y, velocity V, and when the ball came to rest: T grows while it has not."""

    Y: jax.Array
    V: jax.Array
    T: jax.Array


class Ground(vi.AbstractMachine):
    """A ball on the ground, and a clock that goes as the square of its speed changes."""

    gravity: jax.Array
    stops: tuple[vi.RigidStop, ...]
    cycle: float = 10.0

    def field(self, s, state):
        return Ball(state.V, -self.gravity, jnp.where(state.Y > 0, 1.0, 0.0))


@pytest.mark.parametrize("k", [0.0, 0.3, 0.8])
def test_a_bouncing_ball_rests_after_the_time_of_the_series(k):
    # From height h: the fall, then flights of 2 kⁿ times it; in all t (1 + k)/(1 - k).
    def run(height, samples):
        ground = Ground(jnp.asarray(2.0), (vi.RigidStop(0.0, k, "left"),))
        start = Ball(*map(jnp.asarray, (height, 0.0, 0.0)))
        return vi.simulate(
            ground, start, 1, method=vi.Adaptive(rtol=1e-12), samples=samples, impact_log=80
        )

    height = 0.5
    found = run(height, 1)
    log = found.impact_log
    times = np.asarray(log.phase[0])[np.asarray(log.stop[0]) >= 0]
    fall = np.sqrt(2 * height / 2.0)
    end = fall * (1 + k) / (1 - k)
    # What is left after the last impact is of the order of its own flight.
    last = 2 * fall * k ** len(times)
    assert times[-1] + last / (1 - k) == pytest.approx(end, abs=1e-9)
    assert bool(found.successful) and int(found.rests[0]) == 1
    assert len(times) <= 2 + np.log(1e-6) / np.log(max(k, 1e-6))
    assert float(found.sections.Y[-1]) == float(found.sections.V[-1]) == 0.0


@pytest.mark.parametrize("method", METHODS, ids=IDS)
def test_release_when_the_crank_no_longer_presses(method):
    # U = cos φ > d presses the body on; it leaves at φ = arccos d, and moves from there as the
    # linear oscillator does from rest.
    body = scene()
    run = vi.simulate(body, body.start(Y=0.1), 3, method=method, samples=200)
    assert bool(run.successful) and np.asarray(run.rests).tolist() == [2, 1, 1]
    Y = np.asarray(run.samples.state.Y)[400:]
    angle = 2 * np.pi * np.arange(201) / 200
    release = np.arccos(GAP)
    held = angle < release
    assert (Y[held] == GAP).all()

    def free(angle):
        """Y at `angle` after a release from rest, by SciPy's matrix exponential."""
        from scipy.linalg import expm

        A = np.zeros((4, 4))
        A[0, 1], A[1, 0], A[1, 1], A[1, 2] = 1, -1, -2 * XI, 1
        A[2, 3], A[3, 2] = -ZETA, ZETA
        begin = np.array([GAP, 0.0, np.cos(release), np.sin(release)])
        return (expm(A * (angle - release) / ZETA) @ begin)[0]

    flight = (angle > release) & (angle < release + 1.2)
    truth = np.array([free(a) for a in angle[flight]])
    np.testing.assert_allclose(Y[flight], truth, atol=1e-9)


def test_every_method_and_both_clocks_agree():
    body = scene(k=0.6)
    runs = [vi.simulate(body, body.start(Y=0.1), 4, method=m) for m in METHODS]
    runs.append(vi.simulate(body, body.start(Y=0.1), 4, method=METHODS[0], clock="time"))
    for run in runs[1:]:
        np.testing.assert_array_equal(run.impacts, runs[0].impacts)
        np.testing.assert_array_equal(run.rests, runs[0].rests)
        np.testing.assert_allclose(run.y_min, runs[0].y_min, atol=1e-8)
        np.testing.assert_allclose(run.impact_speed, runs[0].impact_speed, atol=1e-8)


def test_impacts_shrink_by_k_and_are_few():
    body = scene()
    run = vi.simulate(body, body.start(), 3, method=vi.ExactFlight(), impact_log=40)
    speed = np.asarray(run.impact_log.speed[2])
    speed = speed[np.isfinite(speed)]
    np.testing.assert_allclose(speed[-4:] / speed[-5:-1], K, rtol=1e-3)
    assert len(speed) < 20


@pytest.mark.slow
def test_a_motion_through_rest_forgets_its_start():
    body = scene()
    orbit = vi.find_orbit(body, body.start(Y=0.1), impact_log=20)
    assert bool(orbit.successful) and bool(orbit.stable)
    np.testing.assert_allclose(np.abs(orbit.multipliers), 0.0, atol=1e-12)
    assert float(orbit.state.Y) == GAP and float(orbit.state.V) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.grad])
def test_derivatives_pass_through_rest(derivative):
    def lowest(zeta):
        body = scene(zeta)
        return vi.simulate(body, body.start(Y=0.1), 2, method=vi.ExactFlight()).y_min[1]

    slope = derivative(lowest)(ZETA)
    h = 1e-6
    difference = (lowest(ZETA + h) - lowest(ZETA - h)) / (2 * h)
    assert float(slope) == pytest.approx(float(difference), rel=1e-6)


def test_starts_on_the_stop():
    body = scene(gap=0.5)
    # Pressed on at φ = 0 it stays; with the slightest velocity inwards it does not.
    for V, rest in ((0.0, True), (-0.3, False), (0.2, False)):
        run = vi.simulate(body, body.start(Y=0.5, V=V), 1, method=vi.ExactFlight(), samples=64)
        assert bool(run.successful)
        assert (float(run.samples.state.Y[1]) == 0.5) == rest
    # With the stop beyond the crank's reach nothing presses on, and a start at rest leaves.
    wide = scene(gap=1.5)
    run = vi.simulate(wide, wide.start(Y=1.5), 1, method=vi.ExactFlight(), samples=64)
    assert run.rests is None and float(run.samples.state.Y[1]) < 1.5


def test_k_of_zero_sticks_at_the_first_impact():
    body = scene(k=0.0)
    run = vi.simulate(body, body.start(), 3, method=vi.ExactFlight(), samples=100)
    # It may be driven away once before it is pressed on.
    assert (np.asarray(run.rests) >= 1).all() and (np.asarray(run.impacts) <= 4).all()
    assert float(run.samples.state.Y[200]) == GAP and float(run.samples.state.V[200]) == 0.0


def test_a_motor_turns_on_while_the_body_rests():
    # The shaft at rest contact feels a spring whose end is held: energy is kept without a motor.
    table = vi.Parameters(torque=0.0, control=0.5, restitution=0.3, gap=0.3 * 0.04, damping=0.0)
    motor = table.scene()
    start = motor.start(Y=0.3, V=0.0, W=1.2)
    run = vi.simulate(motor, start, 1, method=vi.Adaptive(rtol=1e-12), samples=400)
    Y, W = np.asarray(run.samples.state.Y), np.asarray(run.samples.state.W)
    held = np.arange(401) < 400 * np.arccos(0.3) / (2 * np.pi)
    held &= np.cumprod(Y == Y[0]).astype(bool)
    assert held.sum() > 20
    phase = 2 * np.pi * np.arange(401) / 400
    drive = motor.drive
    inertia = 1 + drive.slider_inertia * np.sin(phase) ** 2
    energy = 0.5 * inertia * W**2 + 0.5 * drive.coupling * (Y - np.cos(phase)) ** 2
    np.testing.assert_allclose(np.asarray(energy)[held], float(energy[0]), rtol=1e-10)


def test_two_stops_and_many_lanes():
    stops = (vi.RigidStop(0.2, 0.3), vi.RigidStop(0.3, 0.5, "left"))
    base = scene()
    body = eqx.tree_at(lambda s: s.stops, base, stops, is_leaf=lambda x: isinstance(x, tuple))
    zetas = jnp.linspace(0.1, 2.0, 64)

    def lane(zeta):
        here = eqx.tree_at(lambda s: s.drive.frequency_ratio, body, zeta)
        run = vi.simulate(here, here.start(), 20, method=vi.ExactFlight())
        return run.successful, run.y_min, run.y_max, run.rests

    good, low, high, rests = jax.vmap(lane)(zetas)
    assert bool(good.all())
    assert float(low.min()) >= -0.3 - 1e-12 and float(high.max()) <= 0.2 + 1e-12
    alone = [lane(zeta)[3] for zeta in zetas[::16]]
    np.testing.assert_array_equal(rests[::16], jnp.stack(alone))


def test_release_phase_to_nine_digits():
    # V⁻ of the first impact after a release depends on nothing but the release.
    body = scene()
    run = vi.simulate(body, body.start(), 4, method=vi.ExactFlight(), impact_log=20)
    first = np.asarray(run.impact_log.phase[3][0])
    release = np.arccos(GAP)

    def height(angle):
        from scipy.linalg import expm

        A = np.zeros((4, 4))
        A[0, 1], A[1, 0], A[1, 1], A[1, 2] = 1, -1, -2 * XI, 1
        A[2, 3], A[3, 2] = -ZETA, ZETA
        begin = np.array([GAP, 0.0, np.cos(release), np.sin(release)])
        return (expm(A * (angle - release) / ZETA) @ begin)[0] - GAP

    truth = brentq(height, first - 0.3, first + 0.1, xtol=1e-13)
    assert first == pytest.approx(truth, abs=1e-9)


@pytest.mark.parametrize("k", [0.0, 1e-9, 0.5, 0.97])
def test_nothing_is_lost_over_many_machines(k):
    # Damping may outweigh the crank at the moment of a hard impact, and not an instant later.
    draw = np.random.default_rng(0).uniform

    def lane(zeta, gap, xi):
        body = scene(zeta, k, gap, xi)
        run = vi.simulate(body, body.start(Y=jnp.minimum(gap, 0.0)), 30, method=vi.ExactFlight())
        return run.successful, run.y_max - gap

    good, beyond = jax.jit(jax.vmap(lane))(
        draw(0.3, 3, 200), draw(-0.5, 1, 200), draw(0.01, 1, 200)
    )
    assert bool(good.all())
    assert float(beyond.max()) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS[:2], ids=IDS[:2])
def test_one_impact_and_rest_without_restitution(method):
    body = scene(zeta=0.9, k=0.0, gap=0.8)
    orbit = vi.find_orbit(body, body.start(Y=0.2), method=method)
    assert bool(orbit.successful) and int(orbit.impacts) == 1


@pytest.mark.slow
def test_single_precision_rests_as_double_does():
    """Random machines that chatter, rest and leave; the flattest hops are below rounding."""
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("machine", "start"),
    [
        (vi.machines.BouncingBall(acceleration=0.9), {}),
        (scene(zeta=0.3, gap=-1.5), {"Y": -1.5, "V": 0.0}),
    ],
    ids=["ball", "pressed"],
)
def test_a_body_that_rests_for_ever_is_in_periodic_motion(machine, start):
    """What departs a little from the stop comes to rest on it: nothing of it is left."""
    settled = vi.simulate(machine, machine.start(**start), 1, settle=200).last
    orbit = vi.find_orbit(machine, settled, throw=True)
    assert int(orbit.impacts) == 0 and int(orbit.cycles) == 1 and bool(orbit.stable)
    np.testing.assert_array_equal(orbit.multipliers, 0)
    assert float(orbit.y_max) == float(orbit.y_min) == float(machine.position(settled))


def test_a_body_that_rests_moves_with_its_stop():
    """Its place by the stop's is 1, by its own start 0, until it leaves."""

    def last(gap, start):
        pressed = scene(gap=gap)
        return vi.simulate(pressed, pressed.start(Y=start, V=0.0), 1, settle=3).last.Y

    by_gap, by_start = jax.grad(last, argnums=(0, 1))(-1.5, -1.5)
    assert (float(by_gap), float(by_start)) == (1.0, 0.0)


NUMBERS = {  # restitution, gap, control, coupling, damping ratio, Y and V of the start
    "plastic": ((0.0, 0.3, 0.7, 0.2, 0.05, 0.0, 1.0), [2, 1]),
    "chatter": ((0.3, 0.3, 0.7, 0.2, 0.05, 0.0, 1.0), [0, 1]),
    "chatter twice": ((0.45, -0.2, 0.8, 0.3, 0.1, -0.7, 0.4), [1, 1]),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", NUMBERS)
def test_higher_derivatives_pass_through_rest_and_release(name):
    """While a shaft moves on that feels the body: by all numbers of the machine at once."""
    numbers, expected = NUMBERS[name]
    direction = jnp.asarray([0.3, 0.3, 0.2, 0.1, 0.1, 0.3, -0.3])

    def run(shift):
        k, gap, control, coupling, xi, Y, V = jnp.asarray(numbers) + shift * direction
        machine = vi.Scene(
            oscillator=vi.Oscillator(xi),
            drive=vi.Motor(0.6, control, coupling, 0.1),
            stops=(vi.RigidStop(gap, k if numbers[0] else 0.0),),
        )
        method = vi.FixedStep(steps_per_cycle=40)
        return vi.simulate(machine, machine.start(Y=Y, V=V, W=0.7), 2, method=method)

    def last(shift):
        return jnp.stack(jax.tree.leaves(run(shift).last))

    assert run(0.0).rests.tolist() == expected
    orders, h = [jax.jit(last)], 1e-4
    for order in (1, 2, 3):
        orders.append(jax.jit(jax.jacfwd(orders[-1])))
        near, far = (
            (orders[-2](d) - orders[-2](-d)) / (2 * d) for d in (jnp.asarray(h), jnp.asarray(2 * h))
        )
        found = orders[-1](0.0)
        scale = 1 + float(jnp.abs(found).max())
        assert scale > 1.001, order
        np.testing.assert_allclose(found, (4 * near - far) / 3, atol=1e-7 * scale)
