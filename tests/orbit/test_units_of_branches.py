"""The same machine in other units of length and time has the same orbits and special points."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from own_units import Cranked, variants

pytestmark = pytest.mark.slow
UNITS = ((1.0, 1.0), (1e-6, 1e-3), (1.0, 1e6))


class Struck(vi.AbstractMachine):
    """x'' + 0.1 x' + x + c x³ = f cos ws with a stop, in given units of length and time."""

    length: float
    time: float
    force: float = 1.0
    frequency: float = 0.8
    cubic: float = 0.0
    gap: float = 1.0

    @property
    def cycle(self):
        return 2 * np.pi * self.time / self.frequency

    def field(self, s, state):
        x = state.x / self.length
        pull = self.force * jnp.cos(self.frequency * s / self.time) - x - self.cubic * x**3
        v = state.v
        return {"x": v, "v": pull * self.length / self.time**2 - 0.1 * v / self.time}

    @property
    def contacts(self):
        return (vi.RigidStop(self.gap * self.length, restitution=0.7, on=("x", "v")),)

    def start(self):
        return vi.State(x=0.0, v=0.0)


class Rubbed(Struck):
    """The same body with dry friction instead of a stop. It sticks twice a cycle, or never."""

    @property
    def contacts(self):
        return (vi.DryFriction(on="v", level=self.length / self.time**2 / 3),)


class Sliding(Struck):
    """The same friction as a switch."""

    contacts, events = (), vi.Switch(lambda m, s, x: x.v, slides=True)

    def field(self, s, state, side):
        drag = side * self.length / self.time**2 / 3
        return {"x": state.v, "v": super().field(s, state)["v"] - drag}


class Heated(Struck):
    """The impact is a reset that heats the body. Heat has a third unit."""

    reset = lambda m, s, x: {"v": -0.6 * x.v, "heat": x.heat + (x.v * m.time / m.length**2) ** 2}
    contacts, events = (), vi.Reset(lambda m, s, x: x.x - m.gap * m.length, reset)

    def field(self, s, state):
        return super().field(s, state) | {"heat": -0.2 * state.heat / self.time}

    def start(self):
        return vi.State(x=0.0, v=0.0, heat=0.0)


CASES = {
    "impacts": (Struck, {"frequency": 0.6, "gap": 0.5}, "frequency", (0.5, 1.2)),
    "bends": (Struck, {"cubic": 1.0, "gap": 9.0, "force": 0.4}, "frequency", (0.6, 3.0)),
    "rubs": ((Rubbed, Sliding), {"frequency": 0.5}, "frequency", (0.2, 0.9)),
    "heats": (Heated, {"frequency": 0.6}, "gap", (0.1, 2.0)),
}


@pytest.mark.parametrize(
    "case", [pytest.param(x, marks=[pytest.mark.exhaustive] * (x == "rubs")) for x in CASES]
)
def test_a_branch_is_the_same_in_all_units(case):
    """Friction gives the same branch as a contact and as a switch that slides. A branch, computed
    from event to event, contains the orbit found by the cycle map."""
    kinds, numbers, parameter, bounds = CASES[case]
    kinds = kinds if isinstance(kinds, tuple) else (kinds,)
    found, searched = [], []
    for kind, (length, time) in itertools.product(kinds, UNITS):
        machine = kind(length=length, time=time, **numbers)
        settled = vi.simulate(machine, machine.start(), 1, settle=60).last
        orbit = vi.find_orbit(machine, settled, throw=True)
        sizes = np.abs(orbit.multipliers)
        searched.append([orbit.state.x / length, orbit.state.v * time / length, *sizes[:2]])
        branch = vi.continue_orbit(orbit, parameter=parameter, bounds=bounds, progress=False)
        assert branch.admissible.all()
        i = np.abs(branch.parameter - getattr(machine, parameter)).argmin()
        np.testing.assert_allclose(np.abs(branch.multipliers[i]), sizes, rtol=0, atol=1e-6)
        assert branch.y_max[i] / length == pytest.approx(float(orbit.y_max) / length, abs=1e-8)
        points = {p.kind: p for p in branch.special}
        names = branch.ends, [p.kind for p in branch.special]
        found.append((names, [p.parameter for p in branch.special]))
        if case == "heats" and length == 1:  # the curve is a line, since motions scale
            at = points["period-doubling"]
            curve = vi.boundary(at, parameter="force", bounds=(bounds, (0.5, 2.0)), max_points=20)
            gap, force = curve.parameters.T
            np.testing.assert_allclose(gap / force, at.parameter, rtol=1e-9)
            assert not curve.special, str(curve)
        if case == "impacts" and length == 1:  # the parameter changes the period
            assert vi.grazing(points["grazing"], progress=False).agreement == 1
    assert found[0][1]
    np.testing.assert_allclose(searched, [searched[0]] * len(searched), rtol=0, atol=1e-8)
    for names, places in found:
        assert names == found[0][0]
        np.testing.assert_allclose(places, found[0][1], rtol=1e-9, atol=1e-9)


def test_manifolds_and_exponents_are_the_same_in_all_units():
    curves = []
    for length, time in UNITS[:2]:
        machine = Struck(length=length, time=time, cubic=1.0, gap=9.0, force=0.4, frequency=1.6)
        guess = vi.State(x=-1.106 * length, v=1.224 * length / time)
        found = vi.manifold(vi.find_orbit(machine, guess), length=0.6, spacing=0.1, progress=False)
        assert found.lengths == pytest.approx((0.6, 0.6))
        curve = [[x.x / length, x.v * time / length] for x in found.branches]
        exponents = vi.lyapunov(machine, guess, 16, settle=20).exponents * time
        curves.append((curve, exponents))
    for other in curves[1:]:
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6), other, curves[0])


def test_all_orbits_distinguishes_small_motions():
    """Regression: orbits of equal period were merged."""
    found = []
    numbers = {"frequency": 0.9, "damping": 0.04, "stiffness": 1.0, "cubic": 0.0}
    for size in (1.0, 1e-6):
        machine = vi.machines.Duffing(
            amplitude=size, gap=2.0 * size, restitution=0.5, two_sided=False, **numbers
        )
        region = {"start.Y": (-3 * size, 2 * size), "start.V": (-3 * size, 3 * size)}
        all_of_them = vi.all_orbits(machine, 2, region=region, starts=64)
        rows = zip(all_of_them.orbits, all_of_them.found.tolist(), strict=True)
        found.append([[int(orbit.impacts), *row] for orbit, row in rows])
    assert found[0] == found[1] and len(found[0]) == 4


def test_errors_of_methods_are_the_same_in_all_units():
    """Lengths are compared with lengths only, not with the crank's speed."""
    errors = []
    for machine in variants(Cranked):
        tried = vi.suggest_method(machine, cycles=4, lanes=2).tried
        errors.append(max(x.error for x in tried if x.name.startswith("FixedStep")))
    np.testing.assert_allclose(errors, errors[0], rtol=1e-3)
