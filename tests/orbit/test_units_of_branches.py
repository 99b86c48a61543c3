"""The same machine in other units of length and time has the same special points."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

UNITS = ((1.0, 1.0), (1e-6, 1e-3), (1e6, 1e3), (1e-6, 1e6))


class Struck(vi.AbstractMachine):
    """x'' + 0.1 x' + x + c x³ = f cos ws with a stop, in a unit of length and one of time."""

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
    """The same with dry friction in place of the stop: it sticks twice a cycle, or not at all."""

    @property
    def contacts(self):
        return (vi.DryFriction(on=("x", "v"), level=self.length / self.time**2 / 3),)


class Swinging(vi.AbstractMachine):
    """The van der Pol oscillator."""

    length: float
    time: float
    growth: float = 0.5

    # A cycle begins where the position is least.
    cycle = vi.rising("v", usual=lambda machine: 6.3 * machine.time)

    def field(self, s, state):
        x, v = state.x / self.length, state.v
        pull = -x * self.length / self.time**2 + (self.growth - x * x) * v / self.time
        return {"x": v, "v": pull}

    def start(self):
        return vi.State(x=-1.0 * self.length, v=0.0)


CASES = {
    "impacts": (Struck, {"frequency": 0.6, "gap": 0.5}, "frequency", (0.5, 1.2)),
    "bends": (Struck, {"cubic": 1.0, "gap": 9.0, "force": 0.4}, "frequency", (0.6, 3.0)),
    "rubs": (Rubbed, {"frequency": 0.5}, "frequency", (0.2, 0.9)),
    "swings": (Swinging, {}, "growth", (-0.5, 0.6)),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_branch_is_the_same_in_all_units(case):
    kind, numbers, parameter, bounds = CASES[case]
    found = []
    # In the fourth units the body that rubs is slower than what counts as sticking.
    units = [at for at in UNITS if (kind, at) != (Rubbed, UNITS[3])]
    for length, time in units:
        machine = kind(length=length, time=time, **numbers)
        settled = vi.simulate(machine, machine.start(), 1, settle=60).last
        orbit = vi.find_orbit(machine, settled, throw=True)
        branch = vi.continue_orbit(orbit, parameter=parameter, bounds=bounds, progress=False)
        # At its ends the body that rubs is only just held: a force, which no length is a scale for.
        assert branch.admissible[1:-1].all()
        found.append((branch.ends, [(p.kind, p.parameter) for p in branch.special], branch))
    assert found[0][1], found[0][2]
    if case == "impacts":  # the parameter changes how long a cycle takes
        touch = next(p for p in found[0][2].special if p.kind == "grazing")
        assert vi.grazing(touch, progress=False).agreement == 1
    for ends, special, branch in found[1:]:
        assert ends == found[0][0] and [k for k, _ in special] == [k for k, _ in found[0][1]], (
            str(found[0][2]), str(branch),
        )  # fmt: skip
        np.testing.assert_allclose(
            [at for _, at in special], [at for _, at in found[0][1]], rtol=1e-9, atol=1e-9
        )


@pytest.mark.slow
def test_manifolds_and_exponents_are_the_same_in_all_units():
    curves = []
    for length, time in UNITS[:3]:
        machine = Struck(length=length, time=time, cubic=1.0, gap=9.0, force=0.4, frequency=1.6)
        guess = vi.State(x=-1.106 * length, v=1.224 * length / time)
        found = vi.manifold(vi.find_orbit(machine, guess), length=0.6, spacing=0.1, progress=False)
        assert found.lengths == pytest.approx((0.6, 0.6))
        curve = [[x.x / length, x.v * time / length] for x in found.branches]
        exponents = vi.lyapunov(machine, guess, 16, settle=20).exponents * time
        curves.append((curve, exponents))
    for other in curves[1:]:
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6), other, curves[0])
