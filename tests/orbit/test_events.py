"""Exponents of a relief valve, and the methods that branches accept."""

import equinox as eqx
import numpy as np
import pytest
import vi_jax as vi


@pytest.mark.slow
def test_an_autonomous_motion_has_a_zero_exponent():
    """A perturbation along an autonomous motion neither grows nor decays."""
    machine = vi.machines.ReliefValve(flow_rate=5.0)
    settled = vi.simulate(machine, machine.start(), 1, settle=300).last
    found = vi.lyapunov(machine, settled, 400, settle=20)
    assert bool(found.successful)
    assert abs(float(found.exponents[0])) < 1e-4
    orbit = vi.find_orbit(machine, settled)
    slowest = np.log(np.abs(complex(orbit.multipliers[0]))) / float(orbit.duration)
    assert float(found.exponents[1]) == pytest.approx(slowest, abs=1e-3)
    assert float(orbit.trajectory(samples=64).duration.sum()) == pytest.approx(
        float(orbit.duration), abs=1e-9
    )


class Counted(vi.AbstractMethod):
    """A user's method of equal steps."""

    steps_per_cycle: int = eqx.field(static=True, default=20)  # pyright: ignore

    @property
    def inner(self):
        return vi.FixedStep(steps_per_cycle=self.steps_per_cycle)

    def step(self, smooth, s0, s1, state, beside):
        return self.inner.step(smooth, s0, s1, state, beside)

    def tighter(self):
        return Counted(2 * self.steps_per_cycle)


DUFFING = vi.machines.Duffing(
    amplitude=0.6, frequency=0.7, damping=0.05, stiffness=1.0, cubic=0.3, gap=0.8, restitution=0.6,
)  # fmt: skip


@pytest.mark.slow
def test_a_branch_uses_the_method_of_its_orbit_or_the_argument():
    """Accept a user's method and `Taylor` without a tolerance. Methods with a tolerance raise."""
    start = DUFFING.start(Y=0.709689275, V=0.323053158)
    options = {"parameter": "frequency", "bounds": (0.69, 0.71), "max_points": 2}
    orbit = vi.find_orbit(DUFFING, start, method=Counted(60))
    for method, given in ((Counted(60), None), (vi.Taylor(20, 40), vi.Taylor(20, 40))):
        branch = vi.continue_orbit(orbit, **options, method=given)
        (same,) = branch.at(0.7)
        assert branch.problem.method == method
        assert float(same.state.Y) == pytest.approx(float(orbit.state.Y), abs=1e-12)
        np.testing.assert_allclose(same.multipliers, orbit.multipliers, rtol=1e-9)
    for method in (vi.Adaptive(), vi.Taylor(rtol=1e-12)):
        with pytest.raises(ValueError, match="`method` must be of fixed steps"):
            vi.continue_orbit(orbit, **options, method=method)
