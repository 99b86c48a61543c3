"""User-defined parts of a machine: a drive, a contact law and a friction law."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from event_by_event import followed
from rubbing import Rubbing
from thrown import thrown

CLOSE = vi.Adaptive(rtol=1e-12)
REACH, XI = 1.3, 0.05


class Clockwork(vi.AbstractDrive):
    """A wound spring turns the crank, and a fan brakes it: W' = q T - b W + e U_φ (Y - U),
    T' = -W."""

    stiffness: jax.Array = eqx.field(converter=jnp.asarray)
    fan: jax.Array = eqx.field(converter=jnp.asarray)
    coupling: jax.Array = eqx.field(converter=jnp.asarray)
    components: ClassVar = {"W": 1.0, "wound": 400.0}

    def field(self, scene, s, state, pushes):
        timed = scene.clock_name == "time"
        slide = scene.crank.slide(scene.phase_at(state.phase if timed else s))
        stretch = slide.U - state.Y
        turns = self.stiffness * state.wound - self.fan * state.W
        shaft = turns - self.coupling * slide.U_phi * stretch
        pull = scene.pull(stretch, state.V, pushes)
        rates = {"Y": state.V, "V": pull, "W": shaft, "wound": -state.W}
        if timed:
            return rates | {"phase": state.W}
        return {name: rate / state.W for name, rate in rates.items()}

    def rate(self):
        return self.fan


def clockwork(**options):
    return vi.Scene(
        damping_ratio=XI, drive=Clockwork(0.004, 1.5, 0.05),
        stops=(vi.RigidStop(REACH, 0.6),), **options,
    )  # fmt: skip


def wound_down(turns):
    """Return the state after some turns from SciPy, in time and from impact to impact."""

    def field(_, x):
        Y, V, W, T, phase = x
        stretch = np.cos(phase) - Y
        shaft = 0.004 * T - 1.5 * W + 0.05 * np.sin(phase) * stretch
        return [V, stretch - 2 * XI * V, shaft, -W, W]

    meets = lambda t, x: x[0] - REACH, lambda t, x: [REACH, -0.6 * x[1], *x[2:]]
    ends = lambda t, x: x[4] - 2 * np.pi * turns, lambda t, x: None
    start = (0.3, 0.0, 1.0, 380.0, 0.0)
    return followed(field, start, 1e4, [meets, ends], rtol=1e-12, atol=1e-13)[1]


@pytest.mark.parametrize("clock", ["phase", "time"])
def test_own_drive_matches_scipy(clock):
    scene = clockwork()
    start = scene.start(Y=0.3, wound=380.0)
    assert float(start.W) == 1
    run = vi.simulate(scene, start, 6, clock=clock, method=CLOSE)
    assert int(run.impacts.sum()) > 3
    last, truth = run.last, wound_down(6)
    np.testing.assert_allclose([last.Y, last.V, last.W, last.wound], truth[:4], rtol=1e-9)
    vi.plot_sketch(scene, start)


@pytest.mark.parametrize("rate", [25.0, np.asarray(25.0)])
def test_the_decay_of_a_drive_limits_steps(rate):
    class Stiff(vi.IdealDrive):
        def rate(self):
            return rate

    scene = vi.Scene(0.05, Stiff(0.9))
    found = scene.relaxation(jnp.asarray(0.0), scene.start())
    assert float(found) == pytest.approx(0.9 / 25)


def test_wrong_starts_and_drives_raise():
    with pytest.raises(ValueError, match=r"`torque` must be left out.*has Y, V, W, wound"):
        clockwork().start(torque=1.0)
    with pytest.raises(TypeError, match="drive"):
        vi.Scene(0.1, "motor")


class Hardening(vi.AbstractContactLaw):
    """K δ + β δ³, without damping."""

    cubic: jax.Array = eqx.field(kw_only=True, converter=jnp.asarray)

    def force(self, stiffness, damping, depth, rate):
        return stiffness * depth + self.cubic * depth**3


@pytest.mark.parametrize("cubic", [0.0, 3e4])
def test_own_contact_law_conserves_energy(cubic):
    law = Hardening(cubic=cubic)
    speed, length = jnp.asarray(2.0), jnp.asarray(1.0)
    stop = vi.SoftStop(0.2, 100.0, law=law)
    run = thrown(stop, speed, length)
    depth = float(run.y_max[0]) - 0.2
    assert 0.5 * 2.0**2 == pytest.approx(50 * depth**2 + 0.25 * cubic * depth**4, rel=1e-9)
    assert float(run.last.V) == pytest.approx(-2.0, rel=1e-9)
    steeper = eqx.tree_at(lambda x: x.law.cubic, stop, cubic + 1.0)
    assert float(thrown(steeper, speed, length).y_max[0]) - 0.2 < depth


def test_wrong_contact_laws_raise():
    law = Hardening(cubic=1.0)
    with pytest.raises(ValueError, match="`restitution` must be given without `damping`"):
        vi.SoftStop(0.2, 100.0, law=law, restitution=0.5)
    with pytest.raises(TypeError, match="law"):
        vi.SoftStop(0.2, 100.0, law=lambda depth: depth)  # pyright: ignore


def pressed(varies):
    """Return x'' = -x - friction with the limit μ (1 + c cos 2s), in time."""

    def load(machine, s, x):
        return 1 + machine.numbers["varies"] * jnp.cos(2 * s)

    return Rubbing(lambda machine, s, x: -x.Y, 0.1, {"varies": varies}, load)


@pytest.mark.parametrize("varies", [-0.5, 0.8])
def test_friction_follows_its_load(varies):
    """From rest at 1, x = μ (1 - (c/3) cos 2s) + A cos s until the body stops at s = π."""
    start = vi.OscillatorState(jnp.asarray(1.0), jnp.asarray(0.0))
    run = vi.simulate(pressed(varies), start, 1, method=CLOSE, event_log=2)
    assert float(run.event_log.phase[0, 0]) == pytest.approx(np.pi, rel=1e-9)
    place = 0.2 - 1 - 0.2 * varies / 3
    assert float(run.y_min[0]) == pytest.approx(place, rel=1e-9)
    assert float(run.event_log.value[0, 0]) == 1.0  # pulled harder than friction holds


def test_friction_releases_the_body_as_its_load_falls():
    """The pull is 0.12; the limit of friction varies from 0.02 to 0.18."""
    start = vi.OscillatorState(jnp.asarray(-0.12), jnp.asarray(0.0))
    run = vi.simulate(pressed(0.8), start, 1, method=CLOSE, event_log=1)
    # 0.1 (1 + 0.8 cos 2s) = 0.12
    assert float(run.event_log.phase[0, 0]) == pytest.approx(0.5 * np.arccos(0.25), rel=1e-9)
