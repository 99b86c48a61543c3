"""Grazings of soft stops, relaxed and prestressed."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.orbit.local_map import graze_at

from grazings import grazing_of


class Soft(vi.Mechanical):
    """A driven body with a soft stop."""

    q, mass, cycle = ("x",), (1.0,), 2 * jnp.pi
    stop: vi.SoftStop
    push: float = 1.0

    @property
    def contacts(self):
        return self.stop

    def force(self, t, q, v):
        return dict(x=self.push * jnp.cos(t) - 0.5 * q.x - 0.4 * v.x)


SWING = 1 / np.hypot(0.5, 0.4)


def soft_grazing(stiffness=30.0, **options):
    machine = Soft(vi.SoftStop(1.1 * SWING, stiffness, **options))
    return grazing_of(machine, "stop.gap", (0.9 * SWING, 1.2 * SWING))


@pytest.mark.slow
def test_orders_and_kicks_of_soft_stops():
    """Over a parabola of depth, a spring of stiffness K gives the impulse K (4/3) √(2/a) y³. At a
    prestress F0 the field jumps, and the body turns back with the acceleration a + F0. A dashpot
    that cannot pull gives an impulse of order y². A contact that is less deep than rounding is
    refused: regression, 5 % off at 1e9, and a damped one of another order."""
    for stiffness in (1e9, 1e8, 30.0):
        found = vi.grazing(soft_grazing(stiffness), check=False)
        assert found.order[0] == 1.5 and found.rate[0] == pytest.approx(SWING, rel=1e-9)
        impulse = -stiffness * 4 / 3 * np.sqrt(2 / SWING)
        np.testing.assert_allclose(found.kick[0], [0, impulse], rtol=2e-3, atol=2e-3 * -impulse)
    assert found.outcome == vi.SCENARIOS.persistence
    for stiffness, damping in ((1e10, 0.0), (1e9, 0.6)):
        with pytest.raises(ValueError, match=r"a stop that is less stiff: .* Take a `RigidStop`"):
            vi.grazing(soft_grazing(stiffness, damping=damping), check=False)
    found = vi.grazing(soft_grazing(prestress=2.0))
    assert found.order[0] == 0.5
    kick = -2 * 2.0 * np.sqrt(2 * SWING) / (SWING + 2.0)
    np.testing.assert_allclose(found.kick[0], [0, kick], rtol=1e-8, atol=1e-12)
    assert found.checked is not None and found.agreement > 0.9
    assert graze_at(soft_grazing(restitution=0.6, adhesive=False)).touches[0].kick.order == 1


@pytest.mark.slow
def test_grazings_from_the_side_of_contact():
    """Touch and release vanish together. Compare the push with that of the linear oscillator."""
    machine, bounds = Soft(vi.SoftStop(1.0, 20.0, restitution=0.8), 0.9), ((0.2, 1.0), (0.5, 1.5))
    start = vi.simulate(machine, machine.start(), 1, settle=200).last
    point = grazing_of(machine, "push", bounds[0], start)
    curve = vi.boundary(point, parameter="stop.gap", bounds=bounds)
    assert point.impact is not None and curve.ends == ("bounds", "bounds")
    np.testing.assert_allclose(*(curve.parameters / [1.0, SWING]).T, rtol=1e-12)
