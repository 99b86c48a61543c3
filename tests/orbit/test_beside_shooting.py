"""Compare branches with impacts and stick-slip with independent shooting: SciPy from event to
event, multipliers by differences."""

import numpy as np
import pytest
import vi_jax as vi
from scipy.optimize import newton

from shooting import fixed_point, flown


class Capsule:
    """`vi.machines.Capsule` with its default parameters, from event to event. The state is the
    relative position and velocity of the mass, and the velocity of the capsule. A cycle begins at
    phase -1 of the force, where the capsule slides backwards. Then the mass hits the stop, and the
    capsule slides forwards, sticks, and slides back."""

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
        """Return the state after a cycle. Set `impact`, its phase; `capsule`, the capsule's
        velocity before it; and `room`, the mass's least distance from the stop where it turns."""
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
    """Return the motion once it repeats, after at most 60 cycles."""
    motion = Capsule(amplitude)
    for _ in range(60):
        before, x = x, motion.cycle(x)
        if np.abs(x - before).max() < 1e-13:
            break
    motion.x = x
    return motion


def follow_capsule(orbit):
    return vi.continue_orbit(orbit, parameter="amplitude", bounds=(1.2, 4.0))


@pytest.mark.exhaustive
def test_a_capsule_that_sticks_once_a_cycle():
    """One branch ends where the capsule is at rest at the impact, and where the impact is on the
    section. The other one goes on from there, until the mass touches the stop a second time."""
    machine = vi.machines.Capsule(amplitude=1.6)  # pyright: ignore[reportCallIssue]
    orbit = vi.find_orbit(machine, vi.simulate(machine, machine.start(), 1, settle=300).last)
    first = follow_capsule(orbit)
    branches = first, follow_capsule(first.special[-1].switch())
    (stands, begins), (goes_on, touches) = (branch.special for branch in branches)
    back = goes_on.switch()
    np.testing.assert_array_less(back.machine.amplitude, goes_on.parameter)
    # Beyond, the capsule sticks where it was at rest, so that its stopping is no event.
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
        _, matrix = fixed_point(lambda x, a=amplitude: Capsule(a).cycle(x), settled(amplitude, x).x)
        expected = [*np.linalg.eigvals(matrix), 0.0]
        mine = np.sort_complex(branch.multipliers[i])
        np.testing.assert_allclose(mine, np.sort_complex(expected), atol=1e-8)
