"""Compare branches of oscillators with closed forms, and of a motor with SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from vi_jax.orbit import from_orbit

pytestmark = pytest.mark.slow

ZETA = "drive.frequency_ratio"


def test_grazing_of_the_classic_impact_oscillator():
    """The motion without impacts has amplitude 1/√((1 - ζ²)² + (2ξζ)²). It grazes where this
    equals the gap (Shaw and Holmes 1983; Nordmark 1991)."""
    xi, gap = 0.05, 1.5
    scene = vi.Scene.ideal(frequency_ratio=0.3, restitution=0.8, gap=gap, damping_ratio=xi)
    rest = vi.find_orbit(scene, scene.start(), throw=True)
    assert int(rest.impacts) == 0
    branch = vi.continue_orbit(rest, parameter=ZETA, bounds=(0.2, 0.9))
    wanted = brentq(lambda z: (1 - z * z) ** 2 + (2 * xi * z) ** 2 - gap**-2, 0.3, 0.9)
    assert branch.ends == ("bounds", "grazing") and branch.stable.all()
    grazing = branch.special[-1]
    assert grazing.kind == "grazing" and grazing.parameter == pytest.approx(wanted, abs=1e-9)
    amplitude = 1 / np.hypot(1 - branch.parameter**2, 2 * xi * branch.parameter)
    np.testing.assert_allclose(branch.y_max, amplitude, rtol=1e-10)
    # Beyond, the motion has gained an impact. Compare with the closed form.
    gained = grazing.switch()
    assert int(gained.impacts) == 1 and float(gained.impact_speed[0]) > 0
    there = vi.Scene.ideal(
        frequency_ratio=gained.machine.drive.frequency_ratio, restitution=0.8, gap=gap,
        damping_ratio=xi,
    )  # fmt: skip
    closed = vi.closed_form_orbits(there)
    assert np.nanmin(np.abs(closed.impact_speed - gained.impact_speed[0])) < 1e-9


def test_the_only_special_point_without_damping_is_a_touch_on_the_section():
    """The body turns on the section, where its velocity is rounding, and its multipliers have
    modulus 1 to rounding. Neither may displace the grazing, A = 1/(1 - ζ²) = 2 at ζ = √½."""
    for start in (0.6, 0.65, 0.68):
        scene = vi.Scene.ideal(frequency_ratio=start, restitution=0.5, gap=2.0, damping_ratio=0.0)
        orbit = vi.find_orbit(scene, scene.start(Y=1 / (1 - start**2), V=0.0), throw=True)
        branch = vi.continue_orbit(orbit, parameter=ZETA, bounds=(0.55, 0.9))
        (point,) = branch.special
        assert point.kind == "grazing" and branch.ends == ("bounds", "grazing")
        assert point.parameter == pytest.approx(np.sqrt(0.5), abs=1e-12)


def test_a_weak_motor_whose_crank_slows_down_within_a_turn(monkeypatch):
    """Steps chosen for the crank's speed on the section are too few: they gave false branch points
    and a false torus. Compare the grazing and the fold with SciPy, which integrates in time. A
    branch with too few steps gives a warning."""
    scene = vi.Scene(
        damping_ratio=0.02,
        drive=vi.Motor(strength=0.08, control=0.9, coupling=0.35, slider_inertia=0.02),
        stops=(vi.RigidStop(1.0, 0.8),),
    )
    orbit = vi.find_orbit(scene, scene.start(Y=0.2815, V=-0.08345, W=0.8382), throw=True)
    branch = vi.continue_orbit(orbit, parameter="drive.control", bounds=(0.5, 1.2))
    kinds = [point.kind for point in branch.special]
    assert kinds == ["grazing", "fold", "period-doubling", "grazing"]

    def field(time, y, control):
        Y, V, W, angle = y
        U, first, second = np.cos(angle), -np.sin(angle), -np.cos(angle)
        shaft = 0.08 * (control - W) + 0.35 * first * (Y - U) - 0.02 * first * second * W * W
        return [V, U - Y - 0.04 * V, shaft / (1 + 0.02 * first * first), W]

    slowest = 1.0
    for point in branch.special[:2]:
        state = point.orbit.state
        y = np.array([float(state.Y), float(state.V), float(state.W), 0.0])
        for angle in (float(point.orbit.impact_phase[0]), 2 * np.pi):

            def there(time, y, control, angle=angle):
                return y[3] - angle

            there.terminal = True
            flight = solve_ivp(
                field, (0.0, 1e3), y, "DOP853", args=(point.parameter,), events=there, rtol=1e-12,
                atol=1e-13,
            )  # fmt: skip
            slowest, y = min(slowest, flight.y[2].min()), flight.y[:, -1]
            if angle < 6.28:
                assert y[0] == pytest.approx(1.0, abs=1e-8)
                y[1] *= -0.8
        np.testing.assert_allclose(y[:3], [state.Y, state.V, state.W], atol=1e-8)
    assert slowest < 0.2
    monkeypatch.setattr(from_orbit, "_MOST", 0)
    with pytest.warns(UserWarning, match="twice as many change its states by"):
        vi.continue_orbit(orbit, parameter="drive.control", bounds=(0.5, 1.2), max_points=3)


def test_a_period_doubling_right_before_an_impact_is_lost():
    """In the closed form one multiplier passes -1 near the grazing, and tends to -∞ there. A step
    that spans both detects the doubling only by the side from which it reaches the grazing."""

    def scene_at(zeta):
        return vi.Scene.ideal(frequency_ratio=zeta, restitution=0.8, gap=1.2, damping_ratio=0.2)

    def beyond(zeta):
        return float(vi.closed_form_orbits(scene_at(zeta)).multipliers[0].real.min()) + 1

    wanted = brentq(beyond, 0.4315, 0.44, xtol=1e-13)
    exact = vi.closed_form_orbits(scene_at(0.5))
    orbit = vi.find_orbit(scene_at(0.5), scene_at(0.5).start(Y=exact.Y[0], V=exact.V[0]))
    for step, max_step in ((0.01, 0.05), (0.5, 0.5)):
        steps = {"step": step, "max_step": max_step}
        branch = vi.continue_orbit(orbit, parameter=ZETA, bounds=(0.3, 0.6), **steps)
        grazing, doubling = branch.special
        assert (grazing.kind, doubling.kind) == ("grazing", "period-doubling")
        assert doubling.parameter == pytest.approx(wanted, abs=1e-10)
        assert branch.multipliers[0, 0].real < -1e4 and not branch.stable[0]
        assert branch.to_xarray().stability[0] == "period_doubling"
        assert int(grazing.orbit.impacts) == 1 and grazing.orbit.multipliers[0].real < -1e4


class Pressed(vi.Mechanical):
    """A body that rubs on a wall, pressed on by a force that is least at t = π."""

    q = ("x",)
    mass = (1.0,)
    press: float = 0.6
    cycle = 2 * np.pi

    def force(self, t, q, v):
        return dict(x=-0.3 * q.x - 0.1 * v.x + 2 * jnp.cos(t - 1))

    @property
    def contacts(self):
        return vi.DryFriction(0.3, on="x", load=lambda t, z: self.press + 0.5 * jnp.cos(t))


def test_a_branch_ends_where_the_load_of_a_friction_becomes_negative():
    machine = Pressed()
    orbit = vi.find_orbit(machine, vi.simulate(machine, machine.at(), 1, settle=60).last)
    branch = vi.continue_orbit(orbit, parameter="press", bounds=(0.45, 0.65))
    assert branch.ends == ("jammed", "bounds")
    # It is asked at steps of 2π/20 and shorter: at most 0.5 (1 - cos(π/20)) late.
    assert 0.5 - 0.0062 < branch.parameter.min() <= 0.5 + 1e-9
