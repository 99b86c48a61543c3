"""Scenes with and without motions in closed form."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.orbit.closed_form import closed_form_orbits

from closed_forms import ideal


def driven_by_a_motor():
    motor = vi.Motor(strength=1.0, control=1.0, coupling=0.01, slider_inertia=0.01)
    return vi.Scene(0.0, motor, (vi.RigidStop(2.0, 0.5),))


def stopped_on_the_left():
    stop = vi.RigidStop(2.0, 0.5, side="left")
    return vi.Scene(0.0, vi.IdealDrive(0.9), (stop,))


class Doubled(vi.CosineCrank):
    """A crank of twice the throw."""

    def slide(self, phase):
        return vi.CosineCrank().slide(phase)._replace(U=2 * jnp.cos(phase))


class Hardening(vi.Scene):
    """A scene with an additional cubic spring."""

    def field(self, s, state, *modes):
        flow = super().field(s, state, *modes)
        return vi.OscillatorState(flow.Y, flow.V - 0.3 * state.Y**3)


def scene_of(kind=vi.Scene, crank=None, stop=None):
    crank, stop = crank or vi.CosineCrank(), stop or vi.RigidStop(1.5, 0.9)
    return kind(0.05, vi.IdealDrive(0.9), (stop,), crank)


def falling(approach):
    return 0.9 / (1 + 0.3 * approach)


@pytest.mark.slow
def test_exact_flight_is_used_only_where_it_applies():
    """Flights with another law of restitution agree with adaptive steps. Other equations raise
    (`flow/test_changed_parts.py`)."""
    law = scene_of(stop=vi.RigidStop(1.5, falling))
    exact, stepped = (
        vi.simulate(law, law.start(), 8, method=method, record="sections")
        for method in (vi.ExactFlight(), vi.Adaptive(rtol=1e-11))
    )
    assert int(exact.impacts.sum()) > 5
    np.testing.assert_allclose(exact.sections.Y, stepped.sections.Y, atol=1e-9)


@pytest.mark.parametrize(
    "scene, message",
    [
        (lambda: scene_of(crank=Doubled()), "`scene`.*`CosineCrank`.*Doubled"),
        (lambda: scene_of(Hardening), "`scene`.*Hardening` has another `field`"),
        (lambda: scene_of(stop=vi.RigidStop(1.5, falling)), "`scene`.*has a law"),
        (driven_by_a_motor, "`scene`.*IdealDrive.*Motor"),
        (lambda: ideal(crank=vi.SliderCrank(1 / 3)), "`scene`.*CosineCrank.*SliderCrank"),
        (stopped_on_the_left, r"`scene`.*on the right.*\['left'\]"),
        (lambda: ideal(gap=None), r"`scene`.*exactly one stop.*\[\]"),
        (lambda: ideal(frequency_ratio=jnp.array([0.8, 0.9])), r"`scene`.*vmap.*\(2,\)"),
    ],
)
def test_scenes_without_closed_form_raise(scene, message):
    with pytest.raises(ValueError, match=message):
        closed_form_orbits(scene())


def test_zero_cycles_raise():
    with pytest.raises(ValueError, match="`cycles` must be at least 1, but got 0"):
        closed_form_orbits(ideal(), cycles=0)
