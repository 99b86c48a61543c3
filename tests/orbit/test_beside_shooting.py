"""Branches of motions that hit, stick and slip, their special points beside a shooting code that
knows nothing of this package: SciPy from event to event, multipliers by differences."""

from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.optimize import newton

from shooting import doubling, fixed_point, flown, zero_along


class Impactor(vi.AbstractMachine):
    """The stick–slip example of COCO's toolbox `hspo`: see `experiments/validated`."""

    voltage: Any = 0.57
    stops: tuple = ()
    cycle: float = 2 * np.pi / 0.92
    events: tuple = (
        vi.Reset(
            lambda machine, s, x, slides: x[0] - 0.5,
            lambda machine, s, x, slides: (x[0], -0.8 * x[1], 0.3 * x[1]),
            modes=lambda *_: (1.0,),
        ),
        vi.Reset(
            lambda machine, s, x, slides: jnp.where(slides > 0, -x[2], -1.0),
            lambda machine, s, x, slides: (x[0], x[1], jnp.zeros_like(x[2])),
            modes=lambda *_: (0.0,),
        ),
    )
    begin = lambda self, s, x: (0.0,)

    def field(self, s, x, slides):
        force = (self.voltage * jnp.sin(0.92 * s) / (1 - x[0])) ** 2 - 0.04 * x[1] - x[0]
        return x[1], force + slides * (3.17 + 0.2 * force), slides * (-3.17 - 0.2 * force)


def after_a_cycle(voltage, x, turns=None):
    """The impactor's place and speed a cycle later, of one impact. In `turns` are listed the places
    at which it turns back after that."""
    s, end, slides, x = 0.0, 2 * np.pi / 0.92, 0.0, np.array([*x, 0.0])

    def field(s, x):
        force = (voltage * np.sin(0.92 * s) / (1 - x[0])) ** 2 - 0.04 * x[1] - x[0]
        return [x[1], force + slides * (3.17 + 0.2 * force), slides * (-3.17 - 0.2 * force)]

    _, s, x, _ = flown(field, s, x, end, [lambda s, x: x[0] - 0.5])
    x, slides = np.array([0.5, -0.8 * x[1], 0.3 * x[1]]), 1.0
    _, s, x, _ = flown(field, s, x, end, [lambda s, x: -x[2]])
    x[2], slides = 0.0, 0.0
    _, _, x, turned = flown(field, s, x, end, [], lambda s, x: -x[1])
    if turns is not None:
        turns += [there[0] for there in turned]
    return x[:2]


@pytest.mark.exhaustive
def test_an_impactor_that_makes_its_base_slide():
    start = tuple(map(jnp.array, (0.1166, 0.189, 0.0)))
    orbit = vi.find_orbit(Impactor(), start, throw=True)
    branch = vi.continue_orbit(orbit, parameter="voltage", bounds=(0.3, 0.8))
    assert branch.ends == ("bounds", "grazing")
    *doublings, graze = branch.special
    assert [point.kind for point in doublings] == ["period-doubling"] * 3

    def room(voltage, x, matrix):
        """Before the second impact that the motion has beyond the grazing."""
        turns = []
        after_a_cycle(voltage, x, turns)
        return max(turns) - 0.5

    for point in branch.special:
        x = [float(a) for a in point.orbit.state[:2]]
        condition = room if point is graze else doubling
        truth = zero_along(after_a_cycle, condition, x, point.parameter)
        assert point.parameter == pytest.approx(truth, abs=1e-8)
    i = len(branch.parameter) // 2
    x = [float(branch.column(f"section_{k}")[i]) for k in (0, 1)]
    _, matrix = fixed_point(lambda x: after_a_cycle(branch.parameter[i], x), x)
    expected = np.append(np.linalg.eigvals(matrix), 0.0)
    np.testing.assert_allclose(
        np.sort_complex(branch.multipliers[i]), np.sort_complex(expected), atol=1e-8
    )


class Inside:
    """The mass in a capsule that rubs on the ground (`vi.machines.Capsule` with its default
    numbers), from event to event: its place and speed, the capsule's speed, at phase -1 of the
    force, where the capsule slides back. Once a cycle the mass hits the stop, the capsule slides
    on, comes to stand, and is pulled back."""

    spring, ratio, gap, restitution = 0.1, 5.0, 0.5, 0.6

    def __init__(self, amplitude):
        self.amplitude = amplitude

    def pull(self, x):
        return x[0] + self.spring * x[1]

    def field(self, mode):
        def field(s, x):
            capsule = (self.pull(x) - mode) / self.ratio if mode else 0.0
            return [x[1], self.amplitude * np.cos(s) - self.pull(x) - capsule, capsule]

        return field

    def cycle(self, x):
        """The state a cycle later; the `impact`'s phase, the `capsule`'s speed before it, and how
        far from the stop the mass turns after it (`room`)."""
        _, s, x, _ = flown(self.field(-1.0), -1.0, x, 3.0, [lambda s, x: x[0] - self.gap])
        self.impact, self.capsule, self.room, mode = s, x[2], np.inf, 1.0
        gained = (1 + self.restitution) * x[1]
        x = x + np.array([0.0, -gained, gained / (1 + self.ratio)])
        while s < 2 * np.pi - 1.0:

            def ends(s, x, mode=mode):
                return -mode * x[2] if mode else abs(self.pull(x)) - 1.0

            ended, s, x, turned = flown(
                self.field(mode), s, x, 2 * np.pi - 1.0, [ends], lambda s, x: -x[1]
            )
            self.room = min([self.room, *(self.gap - there[0] for there in turned)])
            if ended is not None:
                mode, x[2] = 0.0 if mode else np.sign(self.pull(x)), 0.0
        return x


def settled(amplitude, x):
    """The motion after cycles as many as it takes to repeat."""
    motion = Inside(amplitude)
    for _ in range(60):
        before, x = x, motion.cycle(x)
        if np.abs(x - before).max() < 1e-13:
            break
    motion.x = x
    return motion


def capsule_from(orbit):
    return vi.continue_orbit(orbit, parameter="amplitude", bounds=(1.2, 4.0))


@pytest.mark.slow
def test_a_capsule_that_sticks_once_a_cycle():
    """What ends its branches: that it stands still as the mass hits it; that the mass hits it as a
    cycle begins, where the other branch goes on; that the mass comes to the stop a second time."""
    machine = vi.machines.Capsule(amplitude=1.6)  # pyright: ignore[reportCallIssue]
    orbit = vi.find_orbit(machine, vi.simulate(machine, machine.start(), 1, settle=300).last)
    first = capsule_from(orbit)
    branches = first, capsule_from(first.special[-1].switch())
    (stands, begins), (goes_on, touches) = (branch.special for branch in branches)
    back = goes_on.switch()
    np.testing.assert_array_less(back.machine.amplitude, goes_on.parameter)
    # It sticks where it stood still: an event less, that it comes to stand.
    assert float(stands.switch().machine.amplitude) < stands.parameter
    assert begins.parameter == pytest.approx(goes_on.parameter, abs=1e-10)
    assert touches.detail.startswith("touches a stop")
    x, motions = np.array([0.0, 1.0, -0.1]), {}
    for amplitude in np.arange(1.6, 2.81, 0.1):
        motions[round(amplitude, 1)] = motion = settled(amplitude, x)
        x = motion.x
    for point, begin, number in (
        (stands, 1.6, "capsule"), (begins, 2.1, "impact"), (touches, 2.8, "room"),
    ):  # fmt: skip
        near = point.parameter + np.array([-1e-6, 1e-6])
        truth = newton(
            lambda a, x=motions[begin].x, number=number: getattr(settled(a, x), number),
            near[0], x1=near[1], tol=1e-13,
        )  # fmt: skip
        assert point.parameter == pytest.approx(truth, abs=1e-8)
    for branch in branches:
        i = len(branch.parameter) // 2
        amplitude = branch.parameter[i]
        x = motions[round(amplitude, 1)].x
        _, matrix = fixed_point(lambda x, a=amplitude: Inside(a).cycle(x), settled(amplitude, x).x)
        expected = [*np.linalg.eigvals(matrix), 0.0, 0.0]
        mine = np.sort_complex(branch.multipliers[i])
        np.testing.assert_allclose(mine, np.sort_complex(expected), atol=1e-8)


def least_force(restitution=0.8, damping=0.1):
    """In closed form, the least force for which x'' + 0.1 x' + x = A cos t hits a stop at 1 once a
    cycle: as a function of the speed of the impact w the amplitude of the forced motion, whose sine
    and cosine at the impact are p and q, is the root of a quadratic polynomial."""
    decay, own, T = damping / 2, np.sqrt(1 - damping**2 / 4), 2 * np.pi
    # x = e^(-decay t) (a cos own t + b sin own t) + p cos t + q sin t from the impact on.
    c, s, fades = np.cos(own * T), np.sin(own * T), np.exp(-decay * T)
    rates = fades * np.array([-decay * c - own * s, -decay * s + own * c])
    rows = [
        [1, 0, 1, 0], [-decay, own, 0, 1], [fades * c, fades * s, 1, 0], [*rates, 0, 1],
    ]  # fmt: skip
    at_rest = np.linalg.solve(rows, [1, 0, 1, 0])[2:]
    by_speed = np.linalg.solve(rows, [0, -restitution, 0, 1])[2:]
    # The force is `damping` times the amplitude at resonance.
    w = -at_rest @ by_speed / (by_speed @ by_speed)
    return damping * np.linalg.norm(at_rest + w * by_speed), w


@pytest.mark.slow
def test_an_impact_oscillator_at_resonance():
    """COCO's `hspo`: the motion with one impact a cycle folds right before it grazes."""
    machine = vi.machines.Duffing(amplitude=1.0, two_sided=False)  # pyright: ignore
    orbit = vi.find_orbit(machine, machine.start(Y=0.87, V=1.7), throw=True)
    branch = vi.continue_orbit(orbit, parameter="amplitude", bounds=(0.02, 2.0))
    assert branch.ends == ("grazing", "bounds")
    graze, fold = branch.special
    least, speed = least_force()
    assert graze.parameter == pytest.approx(0.1, abs=1e-12)
    assert fold.kind == "fold" and fold.parameter == pytest.approx(least, abs=1e-12)
    assert float(fold.orbit.impact_speed[0]) == pytest.approx(speed, abs=1e-6)


class Driven:
    """The paper's machine under a strong motor, over the crank angle from π on, with one impact in
    a cycle. SciPy's explicit steps are short here, since what the motor's speed is off by fades
    within 1/700; its Radau's, at 1e-12, leave 1e-7 in the differences."""

    def __init__(self, scene):
        drive = scene.drive
        self.numbers = [float(x) for x in (drive.strength, drive.coupling, drive.slider_inertia)]
        self.damping, (stop,) = float(scene.damping_ratio), scene.stops
        self.gap, self.restitution = float(stop.gap), float(stop.restitution)

    def cycle(self, control, x):
        strength, coupling, inertia = self.numbers

        def field(s, x):
            slope = -np.sin(s)
            torque = strength * (control - x[2]) + coupling * slope * (x[0] - np.cos(s))
            torque += inertia * slope * np.cos(s) * x[2] ** 2
            pull = np.cos(s) - x[0] - 2 * self.damping * x[1]
            return np.array([x[1], pull, torque / (1 + inertia * slope**2)]) / x[2]

        wall = [lambda s, x: x[0] - self.gap]
        _, s, x, _ = flown(field, np.pi, x, 3 * np.pi, wall)
        x = np.array([x[0], -self.restitution * x[1], x[2]])
        return flown(field, s, x, 3 * np.pi, [])[2]


@pytest.mark.slow
def test_a_strong_motor_by_an_implicit_solver():
    """Its period doubling, between two values of the motor's control where the least multiplier is
    above and below -1."""
    scene = vi.Parameters(torque=1e4, control=0.9, gap=0.08).scene()
    scene = scene.at_section(np.pi)
    method = vi.Adaptive(diffrax.Kvaerno5(), rtol=1e-10)
    start = vi.simulate(scene, scene.start(), 1, settle=300, method=method).last
    orbit = vi.find_orbit(scene, start, method=method, throw=True)
    branch = vi.continue_orbit(orbit, parameter="drive.control", bounds=(0.8, 1.0), max_step=0.3)
    (point,) = branch.special
    assert point.kind == "period-doubling" and branch.ends == ("bounds", "bounds")
    state = point.orbit.state
    x = np.array([float(number) for number in (state.Y, state.V, state.W)])
    motor = Driven(scene)
    beside = []
    for control in point.parameter + np.array([-1e-6, 1e-6]):
        x, matrix = fixed_point(lambda x, c=control: motor.cycle(c, x), x, 3e-4)
        beside.append(np.linalg.eigvals(matrix).real.min() + 1)
    low, high = beside
    assert -1e-6 - low * 2e-6 / (high - low) == pytest.approx(0.0, abs=1e-8)
