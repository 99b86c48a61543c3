"""A capsule with impacts inside and dry friction outside: beside SciPy, and the laws it keeps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from event_by_event import followed

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

    def hit(t, x):
        nonlocal mode
        speed = x[2] + (1 + e) * x[1] / (1 + gamma)
        mode = np.sign(speed)
        return None if x[1] < 1e-3 else [gap, -e * x[1], speed, x[3]]

    def change(t, x):
        return abs(forces(t, x)[1]) - level * ratio if mode == 0 else -mode * x[2]

    def changed(t, x):
        nonlocal mode
        mode, speed = (np.sign(forces(t, x)[1]), x[2]) if mode == 0 else (set_off(t, x), 0.0)
        return [*x[:2], speed, x[3]]

    mode = np.sign(start[2]) or set_off(0.0, start)
    events = [(lambda t, x: x[0] - gap, hit), (change, changed)]
    t, x, met = followed(rate, [*start, 0.0], duration, events, max_step=0.1)
    return None if t < duration - 1e-12 else (x, met.count(0), met.count(1))


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


def test_an_impact_keeps_the_momentum_and_gains_no_energy():
    draw = np.random.default_rng(2).uniform
    for gamma, e, u, v in draw([0.2, 0, 0, -2], [9, 1, 3, 2], (40, 4)):
        capsule = CAPSULE(mass_ratio=gamma, restitution=e)
        (body,), (stop, _) = capsule.coordinates, capsule.contacts
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
