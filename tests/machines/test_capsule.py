"""A capsule with impacts inside and dry friction outside: beside SciPy, and the laws it keeps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

CAPSULE = vi.machines.Capsule
CLOSE = vi.Adaptive(rtol=1e-12)
NAMES = ("amplitude", "frequency", "damping_ratio", "mass_ratio", "gap", "restitution", "friction",
         "static_ratio")  # fmt: skip


def flown(p, start, duration):
    """State (place, speed, capsule's speed and way) and impacts by SciPy's DOP853, the laws written
    out again; `None` for a motion with impacts too weak to be distinguished from rest."""
    a, w, xi, gamma, gap, e, level, ratio = p

    def forces(t, x):
        return a * np.cos(w * t), x[0] + 2 * xi * x[1]

    def set_off(t, x):
        pull = forces(t, x)[1]
        return 0 if abs(pull) <= level * ratio else np.sign(pull)

    def rate(t, x):
        drive, pull = forces(t, x)
        capsule = 0.0 if mode == 0 else (pull - mode * level) / gamma
        return [x[1], drive - pull - capsule, capsule, x[2]]

    def stop(t, x):
        return x[0] - gap

    def change(t, x):
        return abs(forces(t, x)[1]) - level * ratio if mode == 0 else -mode * x[2]

    for event in (stop, change):
        event.terminal, event.direction = True, 1
    t, x, impacts, changes = 0.0, np.array([*start, 0.0]), 0, 0
    mode = np.sign(x[2]) or set_off(t, x)
    while t < duration - 1e-14:
        found = solve_ivp(
            rate, (t, duration), x, method="DOP853", rtol=1e-13, atol=1e-14, max_step=0.1,
            events=[stop, change],
        )  # fmt: skip
        t, x = found.t[-1], found.y[:, -1].copy()
        if found.t_events[0].size:
            if x[1] < 1e-3:
                return None
            impacts += 1
            x[2] += (1 + e) * x[1] / (1 + gamma)
            x[:2] = gap, -e * x[1]
            mode = np.sign(x[2])
        elif found.t_events[1].size:
            changes += 1
            if mode == 0:
                mode = np.sign(forces(t, x)[1])
            else:
                x[2], mode = 0.0, set_off(t, x)
    return x, impacts, changes


def drawn(number):
    draw = np.random.default_rng(11).uniform
    numbers = np.stack([
        draw(0.3, 3, number), draw(0.4, 2, number), draw(0, 0.2, number), draw(1, 8, number),
        draw(0.2, 1.2, number), draw(0.3, 0.95, number), draw(0.1, 1.5, number),
        draw(1, 1.4, number),
    ])  # fmt: skip
    return numbers, draw(-0.2, 0.2, (3, number)) * np.array([[1], [1], [0]])


def lane(numbers, start, cycles=5, **options):
    capsule = CAPSULE(**dict(zip(NAMES, numbers, strict=True)))
    start = capsule.start(place=start[0], speed=start[1], capsule_speed=start[2])
    return vi.simulate(capsule, start, cycles, **options)


@pytest.mark.slow
def test_a_capsule_beside_scipy():
    numbers, starts = drawn(100)
    run = vi.jit(jax.vmap(lambda p, x: lane(p, x, method=CLOSE), in_axes=1))(
        jnp.asarray(numbers), jnp.asarray(starts)
    )
    assert bool(run.successful.all())
    assert (np.asarray(run.y_max).T <= numbers[4] + 1e-15).all(), "never beyond the stop"
    assert (np.asarray(run.impact_energy) >= 0).all()
    compared = several = held = 0
    for i in range(100):
        wanted = flown(numbers[:, i], starts[:, i], 10 * np.pi / numbers[1, i])
        if wanted is None:
            continue
        x, impacts, changes = wanted
        last = run.last
        found = [
            last.place[i],
            last.speed[i],
            last.capsule_speed[i],
            run.sections.progress[i].sum(),
        ]
        np.testing.assert_allclose(found, x, atol=1e-8)
        assert int(run.impacts[i].sum()) == impacts
        compared, several, held = compared + 1, several + impacts, held + changes
    assert compared >= 90 and several > 300 and held > 300


@pytest.mark.slow
@pytest.mark.parametrize("method", [vi.FixedStep(steps_per_cycle=64), vi.Taylor(20, 16)], ids="ft")
def test_other_methods_agree(method):
    numbers, starts = (jnp.asarray(x[:, :24]) for x in drawn(100))
    both = [
        vi.jit(jax.vmap(lambda p, x, m=m: lane(p, x, method=m), in_axes=1))(numbers, starts)
        for m in (CLOSE, method)
    ]
    for a, b in zip(*(jax.tree.leaves(run.sections) for run in both), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    np.testing.assert_array_equal(both[0].impacts, both[1].impacts)


def test_an_impact_keeps_the_momentum_and_gains_no_energy():
    draw = np.random.default_rng(2).uniform
    for gamma, e, u, v in draw([0.2, 0, 0, -2], [9, 1, 3, 2], (40, 4)):
        capsule = CAPSULE(mass_ratio=gamma, restitution=e)
        (body,), (stop,) = capsule.coordinates, capsule.stops
        before = capsule.start(place=0.5, speed=u, capsule_speed=v)
        after = body.placed(before, stop.place, stop.rebound(before.speed))
        momenta, energies = [], []
        for x in (before, after):
            mass, shell = float(x.speed + x.capsule_speed), float(x.capsule_speed)
            momenta.append(mass + gamma * shell)
            energies.append(0.5 * mass**2 + 0.5 * gamma * shell**2)
        assert momenta[1] == pytest.approx(momenta[0], abs=4e-15 * (1 + gamma))
        lost = float(body.mass * stop.loss(before.speed))
        assert lost >= 0 and energies[0] - energies[1] == pytest.approx(lost, abs=1e-13)


def test_energy_and_momentum_of_a_capsule_on_ice():
    """No drive, no damping, no friction: they are kept but for what the impacts take."""
    free = CAPSULE(amplitude=0.0, damping_ratio=0.0, friction=0.0)
    start = free.start(place=0.1, speed=2.0, capsule_speed=0.3)
    run = vi.simulate(free, start, 6, method=CLOSE)

    def energy(x):
        moving = (x.speed + x.capsule_speed) ** 2 + free.mass_ratio * x.capsule_speed**2
        return float(0.5 * (moving + x.place**2))

    assert int(run.impacts.sum()) >= 3
    lost = float(run.impact_energy.sum())
    assert energy(start) - energy(run.last) == pytest.approx(lost, abs=1e-11)
    for x in (start, run.last):
        momentum = float(x.speed + (1 + free.mass_ratio) * x.capsule_speed)
        assert momentum == pytest.approx(2.0 + 6 * 0.3, abs=1e-11)


def test_a_mass_pressed_on_the_stop_pushes_the_capsule():
    """Pressed on it passes the drive on: both stand still until that exceeds friction, then move as
    one body, the motion of which is known in closed form."""
    a, level, gamma, w = 1.5, 1.2, 2.0, 0.01
    capsule = CAPSULE(
        amplitude=a, friction=level, gap=0.1, frequency=w, mass_ratio=gamma, damping_ratio=0.0
    )
    fine = vi.Adaptive(rtol=1e-10)
    start = capsule.start(place=0.1)  # it sets off at once, at ωt = 0
    run = vi.simulate(capsule, start, 1, samples=100, method=fine)
    at = np.arange(12) * 2 * np.pi / 100  # it slows down, and stops at the earliest here
    speed = (a * np.sin(at) - level * at) / (w * (1 + gamma))
    way = (a * (1 - np.cos(at)) - level * at**2 / 2) / (w**2 * (1 + gamma))
    states = jax.tree.map(lambda x: np.asarray(x)[:12], run.samples.state)
    np.testing.assert_allclose(states.capsule_speed, speed, atol=1e-8)
    np.testing.assert_allclose(states.travel, way, rtol=1e-8)
    np.testing.assert_array_equal(states.place, 0.1)
    np.testing.assert_array_equal(states.speed, 0.0)
    # With friction above the drive it stands, until the mass is pulled off.
    stuck = dataclasses.replace(capsule, friction=2.0)
    run = vi.simulate(stuck, start, 1, samples=100, method=fine)
    still = np.asarray(run.samples.state.place)[:23] == 0.1  # cos ωt > 0.1/1.5
    assert still.all()
    np.testing.assert_allclose(run.samples.state.capsule_speed[:23], 0, atol=1e-14)
    assert bool(run.successful)


def test_how_far_it_goes():
    capsule = CAPSULE()
    run = vi.simulate(capsule, capsule.start(), 60, method=CLOSE)
    np.testing.assert_array_equal(run.sections.travel, 0.0)
    assert float(run.sections.progress[-1]) == pytest.approx(0.58211294, abs=1e-7)
    np.testing.assert_allclose(np.diff(run.sections.progress[-10:]), 0, atol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"mass_ratio": 0.0}, "`mass_ratio`"),
        ({"friction": -1.0}, "`friction`"),
        ({"static_ratio": 0.9}, "`static_ratio`"),
        ({"frequency": 0.0}, "`frequency`"),
        ({"restitution": 1.1}, "`restitution`"),
        ({"damping_ratio": "x"}, "`damping_ratio`"),
    ],
)
def test_wrong_numbers_are_named(wrong, message):
    with pytest.raises((ValueError, TypeError), match=message):
        CAPSULE(**wrong)
