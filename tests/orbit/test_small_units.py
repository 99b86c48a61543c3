"""A machine written in micrometres has the same motions as one of size 1."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

pytestmark = pytest.mark.slow
SIZES = (1.0, 1e-6)


def test_all_orbits_are_told_apart():
    """Those of one period were one motion."""
    found = []
    numbers = {"frequency": 0.9, "damping": 0.04, "stiffness": 1.0, "cubic": 0.0}
    for size in SIZES:
        machine = vi.machines.Duffing(
            amplitude=size, gap=2.0 * size, restitution=0.5, two_sided=False, **numbers
        )
        region = {"start.Y": (-3 * size, 2 * size), "start.V": (-3 * size, 3 * size)}
        all_of_them = vi.all_orbits(machine, 2, region=region, starts=64)
        found.append([[int(orbit.impacts), *row] for orbit, row in zip(
            all_of_them.orbits, all_of_them.found.tolist(), strict=True
        )])  # fmt: skip
    assert found[0] == found[1] and len(found[0]) == 4


def test_what_follows_a_grazing_is_the_same():
    """Touches and impacts were told apart by lengths and speeds in the machine's units."""
    found = []
    for size in SIZES:
        machine = vi.machines.Duffing(
            amplitude=size, frequency=0.6, damping=0.1, stiffness=1.0, cubic=0.0, gap=2.0 * size,
            restitution=0.8, two_sided=False,
        )  # fmt: skip
        orbit = vi.find_orbit(machine, vi.simulate(machine, machine.start(), 100).last, throw=True)
        branch = vi.continue_orbit(
            orbit, parameter="gap", bounds=(size, 2.5 * size), progress=False
        )
        (point,) = branch.special
        found.append((vi.grazing(point, progress=False), size))
    (one, _), (other, size) = found
    assert one.value == pytest.approx(1 / np.hypot(0.64, 0.06), abs=1e-9)
    assert other.value == pytest.approx(size * one.value, rel=1e-9)
    assert (one.outcome == other.outcome) and one.windows is not None
    np.testing.assert_allclose(other.entries, np.sqrt(size) * one.entries, rtol=1e-6)
    np.testing.assert_array_equal(other.forecast.period, one.forecast.period)
    np.testing.assert_array_equal(other.machine.period, one.machine.period)
    np.testing.assert_allclose(other.checked, size * np.array(one.checked), rtol=1e-9)


class Tool(vi.Mechanical):
    """A motor's crank shakes a body against a stop. The angle has no unit of length."""

    size: float = 1.0
    control: float = 0.9
    q = ("y", "phi")
    cycle = vi.turn_of("phi", usual=0.45)

    @property
    def contacts(self):
        return vi.RigidStop(0.08 * self.size, 0.5, on="y")

    def mass(self, q):
        return 0.35, self.size**2 * (0.06 + 0.2 * (0.04 * jnp.sin(q.phi)) ** 2)

    def force(self, t, q, v):
        spring = 88.8 * (q.y - 0.04 * self.size * jnp.cos(q.phi))
        torque = 10.0 * self.size**2 * (self.control - v.phi / 15.93)
        return dict(y=-spring - 0.5 * v.y, phi=torque - 0.04 * self.size * spring * jnp.sin(q.phi))


def test_lengths_are_compared_with_lengths_only():
    """Motions of a machine of millimetres had a period, since lengths were compared with a speed in
    radians per second."""
    found, errors = [], []
    for size in (1.0, 1e-3, 1e3):
        tool = Tool(size=size)
        options = {"start": tool.at(v={"phi": 14.0}), "settle": 100}
        sweep = vi.sweep(tool, "control", np.linspace(0.7, 0.9, 5), **options)
        found.append(sweep.period.tolist())
        tried = vi.suggest_method(tool, start=options["start"], cycles=4, lanes=2).tried
        errors.append(max(x.error for x in tried if x.name.startswith("FixedStep")))
    assert found == [[1, 2, -2, -2, 1]] * 3
    np.testing.assert_allclose(errors, errors[0], rtol=1e-3)
