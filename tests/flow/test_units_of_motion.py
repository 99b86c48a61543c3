"""The same machine in other units of time and length gives the same numbers: the field, the stops
and the start are converted, and the motion is converted back."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

# Units of time and of length; the first are those in which the numbers are given.
UNITS = np.array(
    [(1, 1), *((10.0**t, 1) for t in (-9, -5, -2, 3, 6, 9)),
     *((1, 10.0**n) for n in (-9, -6, -3, 3, 6)), (1e-9, 1e-9), (1e9, 1e6), (1e-4, 1e-7)]
)  # fmt: skip


class Body(vi.AbstractMachine):
    """A body between two stops, with a force that is not linear."""

    unit: tuple
    spring: Any
    cubic: Any
    damping: Any
    weight: Any
    drive: Any
    frequency: Any
    right: Any
    left: Any
    restitution: Any

    @property
    def cycle(self):
        return 2 * jnp.pi / self.frequency * self.unit[0]

    @property
    def stops(self):
        gaps = {"right": self.right, "left": self.left}
        return tuple(
            vi.RigidStop(gap * self.unit[1], self.restitution, side) for side, gap in gaps.items()
        )

    def pull(self, s, x):
        time, length = self.unit
        y, v = x.Y / length, x.V * time / length
        push = self.weight + self.drive * jnp.cos(self.frequency * s / time)
        return (push - self.spring * y - self.cubic * y**3 - self.damping * v) * length / time**2

    def field(self, s, x):
        return vi.OscillatorState(x.V, self.pull(s, x))


# Spring, cubic, damping, weight, drive, frequency, gaps right and left, restitution; Y and V.
BODIES = np.array([
    (1, 0, 0.1, 0, 1, 0.9, 1.0, 9, 0.6, 0.1, 0.2),
    (1, 0, 0.1, 0, 1, 0.5, 0.3, 9, 0.5, 0.1, 0.2),  # comes to rest in each cycle
    (0, 0, 0, 1, 0, 1, 0, 9, 0.7, -1, 0),  # a ball that falls and stays
    (0, 0, 0, 1, 2.5, 1, 0, 9, 0.5, 0, 0),  # one on a shaken floor, from rest
    (0, 0, 0.05, 0, 1, 1, 0.5, 0.5, 0.8, 0, 0.3),
    (-1, 1, 0.5, 0, 0.3, 1, 1.2, 9, 0.7, 0.5, 0),
    (1, 0, 0.02, 0, 0.5, 1.3, 0, 1e9, 0.8, -0.3, 0),
    (4, 1, 0.3, -0.2, 1, 0.7, 0.2, 0.3, 0.4, 0, 0.1),
    (1, 0, 0.5, 0.8, 1.5, 0.4, 0.4, 9, 0.3, 0.1, 0),
    (1, 0, 0.1, 0, 1, 2.2, 9, 0.1, 0.9, 0, 0.5),
])  # fmt: skip


def in_all_units(lane, numbers):
    """`lane(number, unit)` of every number in every unit, but the first unit first."""
    inner = jax.vmap(lane, (None, 0))
    return jax.jit(jax.vmap(inner, (0, None)))(jnp.asarray(numbers), jnp.asarray(UNITS))


def assert_alike(found, successful, tolerance):
    """Of arrays (machines, units, …): the numbers of every unit beside those of the first."""
    assert bool(jnp.all(successful))
    for x in found:
        np.testing.assert_allclose(x, np.broadcast_to(x[:, :1], x.shape), rtol=0, atol=tolerance)


@pytest.mark.parametrize("method, tolerance", [(vi.Adaptive(), 1e-8), (vi.FixedStep(), 1e-11)])
def test_bodies_between_stops(method, tolerance):
    def lane(numbers, unit):
        time, length = unit
        machine = Body((time, length), *numbers[:9])
        start = vi.OscillatorState(numbers[9] * length, numbers[10] * length / time)
        run = vi.simulate(machine, start, 5, method=method)
        found = run.sections.Y / length, run.sections.V * time / length, run.y_max / length
        return found, run.impacts, run.successful

    found, impacts, successful = in_all_units(lane, BODIES)
    assert_alike(found, successful, tolerance)
    np.testing.assert_array_equal(impacts, np.broadcast_to(impacts[:, :1], impacts.shape))
    assert np.all(impacts[:, 0].sum(axis=1) > 0)


class Rubbed(Body):
    """A body that sticks and slides, with a counter of its ways through Y = 0 upwards."""

    level: Any = 0.3

    @property
    def switches(self):
        time, length = self.unit
        return (
            vi.DryFriction(
                self.level * length / time**2, velocity=lambda m, x: x[1],
                force=lambda m, s, x: m.pull(s, vi.OscillatorState(x[0], x[1])),
                stopped=lambda m, x: (x[0], 0.0 * x[1], x[2]),
            ),
        )  # fmt: skip

    @property
    def events(self):
        return (vi.Reset(lambda m, s, x, *_: x[0], lambda m, s, x, *_: (x[0], x[1], x[2] + 1)),)

    def position(self, x):
        return x[0]

    def velocity(self, x):
        return x[1]

    def placed(self, x, Y, V):
        return (Y, V, x[2])

    def field(self, s, x, mode):
        rub = self.switches[0].contribution(self, s, x, mode)
        return (x[1], self.pull(s, vi.OscillatorState(x[0], x[1])) + rub, jnp.zeros_like(x[2]))


def test_a_body_that_rubs_and_counts():
    def lane(numbers, unit):
        time, length = unit
        machine = Rubbed((time, length), *numbers[:9])
        start = (numbers[9] * length, numbers[10] * length / time, jnp.zeros(()))
        run = vi.simulate(machine, start, 5, method=vi.Adaptive())
        Y, V, count = run.sections
        return (Y / length, V * time / length, count), run.successful

    found, successful = in_all_units(lane, BODIES[[0, 1, 4, 9]])
    assert_alike(found, successful, 1e-8)
    assert np.all(found[2][:, 0, -1] > 0)


class Stack(vi.AbstractMachine):
    """Two balls above a floor, which both come to rest: stops limit a place and a difference."""

    unit: tuple
    restitution: Any

    @property
    def cycle(self):
        return 2 * jnp.pi * self.unit[0]

    @property
    def coordinates(self):
        def apart(x, Y, V):
            far, fast = 0.5 * (Y - (x[0] - x[1])), 0.5 * (V - (x[2] - x[3]))
            return (x[0] + far, x[1] - far, x[2] + fast, x[3] - fast)

        return (
            vi.Coordinate(lambda x: x[1], lambda x: x[3], lambda x, Y, V: (x[0], Y, x[2], V)),
            vi.Coordinate(lambda x: x[0] - x[1], lambda x: x[2] - x[3], apart, 0.5),
        )

    @property
    def stops(self):
        return (
            vi.RigidStop(1.0 * self.unit[1], self.restitution),
            vi.RigidStop(0.0, self.restitution, coordinate=1),
        )

    def field(self, s, x):
        time, length = self.unit
        push = 1 + 0.3 * jnp.sin(s / time)
        return (x[2], x[3], push * length / time**2, push * length / time**2)


def test_bodies_that_meet():
    def lane(restitution, unit):
        time, length = unit
        each = jnp.array([0.1, 0.5, 0.2, 0.0]) * jnp.array([length, length, *[length / time] * 2])
        machine = Stack((time, length), restitution)
        run = vi.simulate(machine, tuple(each), 3, method=vi.Adaptive(), record="sections")
        places = run.sections[0] / length, run.sections[1] / length
        speeds = run.sections[2] * time / length, run.sections[3] * time / length
        return (*places, *speeds), run.impacts, run.successful

    found, impacts, successful = in_all_units(lane, np.array([0.0, 0.3, 0.5, 0.7]))
    assert_alike(found, successful, 1e-8)
    assert np.all(impacts[:, 0].sum(axis=1) > 0)


def test_a_structure():
    """Two masses, in closed form."""

    def lane(restitution, unit):
        time, length = unit
        K = jnp.array([[2.0, -1.0], [-1.0, 1.5]]) / time**2
        machine = vi.machines.Structure(
            mass=jnp.array([[1.0, 0.2], [0.2, 2.0]]), damping=0.1 * K * time, stiffness=K,
            static_force=jnp.array([0.0, 0.3]) * length / time**2,
            force=jnp.array([1.0, 0.0]) * length / time**2, frequency=0.7 / time,
            contacts=(vi.RigidStop(0.3 * length, restitution, at=[0.0, 1.0]),),
        )  # fmt: skip
        run = vi.simulate(machine, machine.start(), 6, record="sections")
        found = run.sections.displacement / length, run.sections.velocity * time / length
        return found, run.impacts, run.successful

    found, impacts, successful = in_all_units(lane, np.array([0.2, 0.5, 0.8]))
    assert_alike(found, successful, 1e-9)
    np.testing.assert_array_equal(impacts, np.broadcast_to(impacts[:, :1], impacts.shape))
    assert np.all(impacts[:, 0].sum(axis=1) > 3)
