"""The unbalanced motor, compared with its angle as the clock."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

pytestmark = pytest.mark.slow

ROTOR = vi.machines.UnbalancedRotor


class ByAngle(vi.AbstractMachine):
    """The same motor with its angle as the clock, so its section needs no event. Impacts conserve
    the momentum P = W - ε V sin φ of the shaft."""

    of: ROTOR
    state: ClassVar = ("Y", "V", "P")
    cycle: ClassVar = 2 * np.pi

    @property
    def contacts(self):
        return tuple(
            vi.RigidStop(x.gap, x.restitution, x.side, on=("Y", "V")) for x in self.of.contacts
        )

    def speed(self, s, z):
        return z.P + self.of.coupling * z.V * jnp.sin(s)

    def pace(self, s, z):
        W = self.speed(s, z)
        return jnp.where(W > 0, 1 / W, jnp.nan)

    def field(self, s, z):
        n, W, sine = self.of, self.speed(s, z), jnp.sin(s)
        motor = n.strength * (n.control - W / n.no_load_speed)
        force = W * W * jnp.cos(s) - z.Y - 2 * n.damping_ratio * z.V
        push = (force + sine * motor) / (1 - n.coupling * sine**2)
        twist = motor - n.coupling * z.V * W * jnp.cos(s)
        return dict(Y=z.V / W, V=push / W, P=twist / W)

    def mirrored(self, z):
        return z.replace(Y=-z.Y, V=-z.V)

    def convert_start(self, z):
        return vi.State(Y=z.Y, V=z.v.Y, P=z.v.phi)


def find_both_orbits(rotor, cycles=400):
    """Return the settled orbit, and that of the machine with its angle as the clock."""
    settled = vi.simulate(rotor, rotor.start(), 1, settle=cycles).last
    other = ByAngle(rotor)
    return vi.find_orbit(rotor, settled), vi.find_orbit(other, other.convert_start(settled))


def test_random_motors_equal_those_with_their_angle_as_the_clock():
    draw = np.random.default_rng(5).uniform
    ranges = {"strength": (0.05, 1), "control": (0.6, 1.8), "no_load_speed": (0.8, 1.2),
              "coupling": (0.01, 0.3), "damping_ratio": (0.01, 0.2), "gap": (1, 2.5),
              "restitution": (0.3, 0.9)}  # fmt: skip
    starts = {"Y": (-0.8, 0.8), "V": (-0.5, 0.5), "W": (0.7, 1.3)}
    numbers, begin = (
        {name: jnp.asarray(draw(*ends, 24)) for name, ends in x.items()} for x in (ranges, starts)
    )

    def runs(numbers, begin):
        rotor = ROTOR(two_sided=True, **numbers)
        start, other, method = rotor.start(**begin), ByAngle(rotor), vi.Adaptive(rtol=1e-12)
        one = vi.simulate(rotor, start, 4, method=method)
        return one, vi.simulate(other, other.convert_start(start), 4, method=method)

    one, other = vi.jit(jax.vmap(runs))(numbers, begin)
    assert bool(one.successful.all()) and bool(other.successful.all())
    for a, b in zip(jax.tree.leaves(ByAngle(ROTOR()).convert_start(one.sections)),
                    jax.tree.leaves(other.sections), strict=True):  # fmt: skip
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-8)
    np.testing.assert_allclose(one.duration, other.duration, rtol=1e-8)
    np.testing.assert_array_equal(one.impacts, other.impacts)
    assert int(one.impacts.sum()) > 24


def test_a_start_from_rest_passes_the_resonance_and_a_stalled_motor_ends_no_cycle():
    rotor = ROTOR(control=1.2, strength=0.3)
    run = vi.simulate(rotor, rotor.start(W=0.0), 60)
    assert bool(run.successful) and float(run.duration[0]) > 1.5 * float(run.duration[-1])
    slack = ROTOR(control=-0.5, strength=0.3)
    stalled = vi.simulate(slack, slack.start(W=0.5), 20, max_steps=500)
    assert bool(stalled.result == vi.RESULTS.max_steps)


def test_branches_pass_the_begin_of_a_cycle():
    """An impact passes the section without effect. Symmetry breaks at one gap in both clocks."""
    rotor, bounds = ROTOR(gap=1.0, two_sided=True), (0.7, 1.4)
    one, other = (
        vi.continue_orbit(orbit, parameter=name, bounds=bounds)
        for orbit, name in zip(find_both_orbits(rotor), ("gap", "of.gap"), strict=True)
    )
    assert one.ends == other.ends == ("bounds", "bounds")
    late, early = (one.at(gap)[0] for gap in (0.75, 0.8))
    assert late.impact_stop.tolist() == [1, 0] and early.impact_stop.tolist() == [0, 1]
    (here,), (there,) = one.special, other.special
    assert here.kind == there.kind == "symmetry-breaking"
    assert here.parameter == pytest.approx(there.parameter, rel=1e-8)
    a, b = here.orbit, there.orbit
    state = ByAngle(rotor).convert_start(a.state)
    for x, y in zip(jax.tree.leaves(state), jax.tree.leaves(b.state), strict=True):
        assert float(x) == pytest.approx(float(y), abs=1e-7)
    np.testing.assert_allclose(np.abs(a.multipliers)[:3], np.abs(b.multipliers), atol=1e-6)


@pytest.mark.exhaustive
def test_a_body_pressed_on_comes_to_rest_and_leaves():
    """The unbalance presses the body on while W² cos φ exceeds the gap, also as a cycle begins."""
    rotor = ROTOR(control=1.2, strength=2.0, gap=0.4, restitution=0.1, coupling=0.1,
                  damping_ratio=0.6)  # fmt: skip
    one, other = find_both_orbits(rotor)
    assert int(one.rests) == int(other.rests) == 1
    assert float(one.clearance) == pytest.approx(float(other.clearance), abs=1e-7)
    assert float(one.duration) == pytest.approx(float(other.duration), abs=1e-8)
    ends = [
        vi.continue_orbit(orbit, parameter=name, bounds=(0.38, 0.5))
        for orbit, name in ((one, "gap"), (other, "of.gap"))
    ]
    assert [branch.ends for branch in ends] == 2 * [("bounds", "rest")]
    here, there = (branch.special[-1].parameter for branch in ends)
    assert here == pytest.approx(there, rel=1e-8)
