"""Branches of oscillators known from elsewhere: grazing and folds beside codes of their own,
and of a motor."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from vi_jax.orbit import _problem

ZETA = "drive.frequency_ratio"


@pytest.mark.slow
def test_grazing_of_the_classic_impact_oscillator():
    """The motion that stays off the stop has the amplitude 1/√((1 - ζ²)² + (2ξζ)²); it grazes
    where that is the gap (Shaw and Holmes 1983; Nordmark 1991)."""
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
    # Beyond it an impact is gained: the closed form knows that motion.
    gained = grazing.switch()
    assert int(gained.impacts) == 1 and float(gained.impact_speed[0]) > 0
    there = vi.Scene.ideal(
        frequency_ratio=gained.machine.drive.frequency_ratio, restitution=0.8, gap=gap,
        damping_ratio=xi,
    )  # fmt: skip
    closed = vi.closed_form_orbits(there)
    assert np.nanmin(np.abs(closed.impact_speed - gained.impact_speed[0])) < 1e-9
    # In ζ and d the grazing is the resonance curve itself.
    curve = vi.boundary(grazing, parameter="stops.0.gap", bounds=((0.3, 0.95), (1.1, 3.0)))
    zeta, d = curve.parameters.T
    np.testing.assert_allclose(1 / np.hypot(1 - zeta**2, 2 * xi * zeta), d, rtol=1e-9)
    assert np.ptp(d) > 1


class Duffing(vi.AbstractMachine):
    """Y'' + 2ξY' + Y + γY³ = F cos(Ωt), over the cycles of its force."""

    stops: tuple[vi.RigidStop, ...]
    frequency: jax.Array
    cubic: jax.Array
    force: jax.Array
    damping: jax.Array

    @property
    def cycle(self):
        return 2 * np.pi

    def field(self, s, state):
        pull = self.force * jnp.cos(s) - 2 * self.damping * state.V - state.Y
        pull = pull - self.cubic * state.Y**3
        return vi.OscillatorState(state.V / self.frequency, pull / self.frequency)


@pytest.mark.slow
def test_folds_of_a_duffing_oscillator():
    """Jump frequencies of a hardening oscillator: up at 1 + ½ (3/2)^(4/3) γ^(1/3) F^(2/3) to first
    order in γ (Kovacic and Brennan, The Duffing Equation, 2011, section 5.3); and SciPy's word that
    at the folds a multiplier is 1."""
    gamma, force, xi = 1e-3, 0.2, 0.005
    scene = Duffing((), *(jnp.asarray(x) for x in (0.8, gamma, force, xi)))
    guess = vi.OscillatorState(jnp.asarray(force / (1 - 0.64)), jnp.asarray(0.0))
    orbit = vi.find_orbit(scene, guess, throw=True)
    branch = vi.continue_orbit(
        orbit, parameter="frequency", bounds=(0.7, 1.6), max_step=0.5, max_points=2000
    )
    folds = [p for p in branch.special if p.kind == "fold"]
    assert branch.ends == ("bounds", "bounds") and len(folds) == 2
    lower = min(p.parameter for p in folds)
    first_order = 1 + 0.5 * 1.5 ** (4 / 3) * gamma ** (1 / 3) * force ** (2 / 3)
    assert lower == pytest.approx(first_order, abs=0.01)
    for point in folds:
        state = np.array([float(point.orbit.state.Y), float(point.orbit.state.V)])
        omega = point.parameter

        def field(t, x, omega=omega):
            A = np.array([[0, 1], [-1 - 3 * gamma * x[0] ** 2, -2 * xi]])
            pull = force * np.cos(omega * t) - x[0] - gamma * x[0] ** 3 - 2 * xi * x[1]
            return np.concatenate([[x[1], pull], (A @ x[2:].reshape(2, 2)).ravel()])

        start = np.concatenate([state, np.eye(2).ravel()])
        end = solve_ivp(field, (0, 2 * np.pi / omega), start, rtol=1e-12, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(end[:2], state, atol=1e-7)
        assert np.abs(np.linalg.eigvals(end[2:].reshape(2, 2)) - 1).min() < 1e-4


@pytest.mark.exhaustive
def test_a_motor_hangs_at_resonance_below_a_certain_torque():
    """Without a stop the response folds where the motor's line, κ - ζ/w0 times τ0, is less steep
    than the averaged load's steepest fall: Table 1's to first order in the coupling is 0.75461, a
    torque of 11.49 N·m. There the two folds meet, at the top of their curve."""
    table = vi.Parameters(torque=8.0, control=0.8)
    scene = dataclasses.replace(table.scene(), stops=())
    branch = vi.continue_orbit(
        vi.find_orbit(scene, scene.start()), parameter="drive.control", bounds=(0.6, 1.6)
    )
    first, second = (point for point in branch.special if point.kind == "fold")
    assert first.parameter > second.parameter
    curve = vi.boundary(first, parameter="drive.strength", bounds=((0.6, 2.5), (0.3, 2.0)))
    top = curve.parameters[:, 1].max()
    assert top == pytest.approx(0.75461, rel=3e-3)
    assert 8.0 * top / float(scene.drive.strength) == pytest.approx(11.49, rel=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("start", [0.6, 0.65, 0.68])
def test_without_damping_the_touch_is_on_the_section_and_nothing_else_is_special(start):
    """The body turns where φ = 0, with a rate that is rounding, and its multipliers have modulus 1,
    to rounding: A = 1/(1 - ζ²) = 2 is at ζ = √½ whatever the signs of these are."""
    scene = vi.Scene.ideal(frequency_ratio=start, restitution=0.5, gap=2.0, damping_ratio=0.0)
    orbit = vi.find_orbit(scene, scene.start(Y=1 / (1 - start**2), V=0.0), throw=True)
    branch = vi.continue_orbit(orbit, parameter="drive.frequency_ratio", bounds=(0.55, 0.9))
    (point,) = branch.special
    assert point.kind == "grazing" and branch.ends == ("bounds", "grazing")
    assert point.parameter == pytest.approx(np.sqrt(0.5), abs=1e-12)


@pytest.mark.slow
def test_a_motor_branch_agrees_with_found_orbits():
    scene = vi.Parameters(torque=10.0, control=0.9, restitution=0.8, gap=0.08).scene(drive="motor")
    run = vi.simulate(scene, scene.start(), 200)
    last = jax.tree.map(lambda x: x[-1], run.sections)
    orbit = vi.find_orbit(scene, last, cycles=2)
    branch = vi.continue_orbit(orbit, parameter="drive.control", bounds=(0.88, 0.95))
    assert branch.ends == ("bounds", "bounds") and branch.stable.all()
    np.testing.assert_allclose(branch.parameter[[0, -1]], [0.88, 0.95], atol=1e-10)
    for end in (0, -1):
        there = eqx.tree_at(lambda s: s.drive.control, scene, jnp.asarray(branch.parameter[end]))
        found = vi.find_orbit(there, branch.orbit(end), cycles=2)
        assert float(found.y_min) == pytest.approx(float(branch.y_min[end]), abs=1e-9)
        np.testing.assert_allclose(found.multipliers, branch.multipliers[end], atol=1e-7)
        assert float(found.frequency_ratio) == pytest.approx(branch.frequency_ratio[end], abs=1e-9)


@pytest.mark.slow
def test_a_weak_motor_whose_crank_slows_down_within_a_turn(monkeypatch):
    """Equal steps of crank angle, enough for the crank's speed on the section, are too few then:
    with them the branch had points where branches cross and a torus. At the fold and the grazing
    SciPy's own flights come back to the state, by time, to 1e-8. A branch with too few says so."""
    scene = vi.Scene(
        oscillator=vi.Oscillator(0.02),
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
    monkeypatch.setattr(_problem, "_MOST", 0)
    with pytest.warns(UserWarning, match="twice as many change its states by"):
        vi.continue_orbit(orbit, parameter="drive.control", bounds=(0.5, 1.2), max_points=3)


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.01, 0.02, 0.5])
def test_a_period_doubling_right_before_an_impact_is_lost(step):
    """Of the closed form's multipliers one passes -1 beside the grazing, and goes to -∞ there; a
    step that spans both tells it from none only by the side from which the grazing is reached."""

    def scene_at(zeta):
        return vi.Scene.ideal(frequency_ratio=zeta, restitution=0.8, gap=1.2, damping_ratio=0.2)

    def beyond(zeta):
        return float(vi.closed_form_orbits(scene_at(zeta)).multipliers[0].real.min()) + 1

    wanted = brentq(beyond, 0.4315, 0.44, xtol=1e-13)
    exact = vi.closed_form_orbits(scene_at(0.5))
    orbit = vi.find_orbit(scene_at(0.5), scene_at(0.5).start(Y=exact.Y[0], V=exact.V[0]))
    branch = vi.continue_orbit(
        orbit, parameter=ZETA, bounds=(0.3, 0.6), step=step, max_step=max(step, 0.05)
    )
    grazing, doubling = branch.special
    assert (grazing.kind, doubling.kind) == ("grazing", "period-doubling")
    assert doubling.parameter == pytest.approx(wanted, abs=1e-10)
    assert branch.multipliers[0, 0].real < -1e4 and not branch.stable[0]
    assert branch.to_xarray().stability[0] == "period_doubling"
    assert int(grazing.orbit.impacts) == 1 and grazing.orbit.multipliers[0].real < -1e4
