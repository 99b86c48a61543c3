"""Soft stops that are just touched, relaxed and prestressed."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.orbit._local_map import graze_at

from grazings import grazing_of


class Soft(vi.AbstractMachine):
    """A shaken body with a soft stop, by time."""

    stop: vi.SoftStop

    @property
    def contacts(self):
        return self.stop

    cycle = 2 * jnp.pi

    def field(self, s, x):
        return vi.OscillatorState(x.V, jnp.cos(s) - 0.5 * x.Y - 0.4 * x.V)

    def start(self):
        return vi.OscillatorState(jnp.asarray(0.0), jnp.asarray(0.0))


SWING = 1 / np.hypot(0.5, 0.4)


def soft_grazing(stiffness=30.0, **options):
    machine = Soft(vi.SoftStop(1.1 * SWING, stiffness, **options))
    return grazing_of(machine, "stop.gap", (0.9 * SWING, 1.2 * SWING))


@pytest.mark.slow
def test_soft_stops():
    """The impulse of a spring K over the parabola of the depth is K (4/3) √(2/a) y³. A prestressed
    one, at which the field jumps, turns the body back with a + F0 by its force F0. A dashpot that
    may not pull has an impulse of y²."""
    for stiffness in (1e-3, 1e8, 30.0):
        found = vi.grazing(soft_grazing(stiffness), check=False)
        assert found.order[0] == 1.5 and found.rate[0] == pytest.approx(SWING, rel=1e-9)
        impulse = -stiffness * 4 / 3 * np.sqrt(2 / SWING)
        np.testing.assert_allclose(found.kick[0], [0, impulse], rtol=2e-3, atol=2e-3 * -impulse)
    assert found.outcome == vi.SCENARIOS.persistence
    with pytest.raises(ValueError, match=r"a stop that is less stiff: .* Take a `RigidStop`"):
        vi.grazing(soft_grazing(1e10), check=False)
    found = vi.grazing(soft_grazing(prestress=2.0))
    assert found.order[0] == 0.5
    kick = -2 * 2.0 * np.sqrt(2 * SWING) / (SWING + 2.0)
    np.testing.assert_allclose(found.kick[0], [0, kick], rtol=1e-8, atol=1e-12)
    assert found.checked is not None and found.agreement > 0.9
    assert graze_at(soft_grazing(restitution=0.6, adhesive=False)).touches[0].kick.order == 1
