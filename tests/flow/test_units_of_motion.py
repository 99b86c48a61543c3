"""A machine in other units of time and length gives the same motion after conversion back."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from own_units import MACHINES, Belted, Cranked, Sliding, Struck, in_units

pytestmark = pytest.mark.slow

# Units of time and of length. Parameters are given in the first.
UNITS = np.array(
    [(1, 1), *((10.0**t, 1) for t in (-9, -5, -2, 3, 6, 9)),
     *((1, 10.0**n) for n in (-9, -6, -3, 3, 6)), (1e-9, 1e-9), (1e9, 1e6), (1e-4, 1e-7),
     (1e-3, 1e-6)]
)  # fmt: skip


def in_all_units(lane, numbers):
    """Return `lane(numbers, unit)` for every row of numbers in every unit."""
    inner = jax.vmap(lane, (None, 0))
    return jax.jit(jax.vmap(inner, (0, None)))(jnp.asarray(numbers), jnp.asarray(UNITS))


def assert_equal_in_all_units(found, successful, tolerance):
    """Compare arrays of shape (machines, units, …) in every unit with the first unit."""
    assert bool(jnp.all(successful))
    for x in found:
        np.testing.assert_allclose(x, np.broadcast_to(x[:, :1], x.shape), rtol=0, atol=tolerance)


class Stack(vi.Mechanical):
    """Two balls under a ceiling, which both come to rest."""

    q = ("a", "b")
    mass = (1.0, 2.0)
    unit: Any
    restitution: Any
    shaken: Any

    @property
    def cycle(self):
        return 2 * jnp.pi * self.unit[0]

    @property
    def contacts(self):
        return (
            vi.RigidStop(1.0 * self.unit[1], self.restitution, on="b"),
            vi.RigidStop(0.0, self.restitution, on=lambda q: q.a - q.b),
        )

    def force(self, t, q, v):
        time, length = self.unit
        a = 1 + 0.3 * jnp.sin(t / time)
        b = a + self.shaken * jnp.sin(3 * t / time)
        return {"a": a * length / time**2, "b": 2 * b * length / time**2}


def test_colliding_bodies():
    def lane(numbers, unit):
        time, length = unit
        machine = Stack((time, length), *numbers)
        start = machine.at(a=0.1 * length, b=0.5 * length, v={"a": 0.2 * length / time})
        run = vi.simulate(machine, start, 3, method=vi.Adaptive(), record="sections")
        z = run.sections
        places, speeds = (z.a / length, z.b / length), (z.v.a, z.v.b)
        return (*places, *(x * time / length for x in speeds)), run.impacts, run.successful

    # Some of the last four once failed as chatter, in milliseconds and micrometres too.
    rows = np.array([
        (0.0, 0.0), (0.3, 0.0), (0.5, 0.0), (0.7, 0.0), (0.217, 0.41), (0.34, 0.743),
        (0.623, 0.193), (0.614, 0.648),
    ])  # fmt: skip
    found, impacts, successful = in_all_units(lane, rows)
    assert_equal_in_all_units(found, successful, 1e-8)
    assert np.all(impacts[:, 0].sum(axis=1) > 0)


def test_structure_of_two_masses_in_closed_form():
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
    assert_equal_in_all_units(found, successful, 1e-9)
    np.testing.assert_array_equal(impacts, np.broadcast_to(impacts[:, :1], impacts.shape))
    assert np.all(impacts[:, 0].sum(axis=1) > 3)


IMPLICIT = vi.Adaptive(diffrax.Kvaerno5(), rtol=1e-12)


class Resting(Struck):
    """A load that varies holds the body on its stop for a part of each cycle."""

    value = 0.2

    def rates(self, t, x, u, q, w):
        rate, push, *others = super().rates(t, x, u, q, w)
        return rate, push + 0.8 + 0.5 * jnp.cos(0.8 * t), *others


# Each machine with steps by a tolerance, and each other method with one of impacts, of friction or
# of masses. With the tolerance 1e-10 of `Taylor`, a pressure of 1e8 allowed errors of 2e-6 in the
# others.
KINDS = [*MACHINES, Resting]
OTHERS = [
    pytest.param(method, kind, marks=[] if kind is few else pytest.mark.exhaustive)
    for method, few in (
        (vi.FixedStep(), Struck),
        (IMPLICIT, Belted),
        (vi.Taylor(rtol=1e-10), Cranked),
    )
    for kind in KINDS
    if kind is not Sliding or not isinstance(method, vi.Taylor)  # a blend of fields has no series
]


@pytest.mark.parametrize(("method", "kind"), [*((vi.Adaptive(), kind) for kind in KINDS), *OTHERS])
def test_each_component_has_a_unit_of_its_own(method, kind):
    first, rtol = None, 1e-11 if method is IMPLICIT else 0.0  # its tolerance is that of 300 degrees
    for machine in in_units(kind):
        run = vi.simulate(machine, machine.start(), 8, method=method, event_log=10)
        assert bool(run.successful)
        found = machine.row(run.sections), run.event_log.phase / machine.time
        first = first or (*found, run.event_log.number)
        for x, y in zip(found, first[:2], strict=True):
            np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-9, err_msg=str(machine))
        np.testing.assert_array_equal(run.event_log.number, first[2])
    assert np.count_nonzero(first[2] >= 0) > 3
