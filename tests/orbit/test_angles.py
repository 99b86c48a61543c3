"""A driven pendulum that rotates: orbits, branches, regimes and basins up to whole turns."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

DAMPING, TORQUE = 0.3, 0.9


class Pendulum(vi.AbstractMachine):
    """Its angle is counted from `zero`."""

    amplitude: float = 1.6
    zero: float = 0.0
    cycle = 2 * np.pi
    renewed = vi.wrap_angles("phi")

    def field(self, t, z):
        drive = TORQUE + self.amplitude * jnp.cos(t)
        return {"phi": z.v, "v": drive - jnp.sin(z.phi + self.zero) - DAMPING * z.v}

    def start(self):
        return vi.State(phi=0.1, v=1.0)


def a_cycle_later(amplitude, phi, v):
    """By SciPy."""

    def field(t, x):
        return [x[1], TORQUE + amplitude * np.cos(t) - np.sin(x[0]) - DAMPING * x[1]]

    span = (0, 2 * np.pi)
    return solve_ivp(field, span, [phi, v], method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


@pytest.fixture(scope="module")
def orbit():
    machine = Pendulum()
    return vi.find_orbit(machine, vi.simulate(machine, machine.start(), 100).last)


def test_a_rotation_is_periodic(orbit):
    """Three turns a cycle; the product of the multipliers is Liouville's."""
    phi, v = float(orbit.state.phi), float(orbit.state.v)
    later = a_cycle_later(1.6, phi, v)
    np.testing.assert_allclose(later, [phi + 6 * np.pi, v], atol=1e-8)
    assert np.prod(orbit.multipliers) == pytest.approx(np.exp(-2 * np.pi * DAMPING), abs=1e-8)


@pytest.mark.slow
def test_a_branch_passes_half_a_turn(orbit):
    """Its section passes ±π, where the angle begins again; its end is SciPy's."""
    branch = vi.continue_orbit(orbit, parameter="amplitude", bounds=(0.5, 6.0))
    assert branch.ends == ("bounds", "bounds") and np.ptp(branch.sections["phi"]) > 6
    end = branch.orbit(-1)
    assert float(end.machine.amplitude) == pytest.approx(6.0)
    later = a_cycle_later(6.0, float(end.state.phi), float(end.state.v))
    turns = (later[0] - float(end.state.phi)) / (2 * np.pi)
    assert turns == pytest.approx(round(turns), abs=1e-8) and round(turns) != 0
    assert later[1] == pytest.approx(float(end.state.v), abs=1e-8)


class Locked(vi.AbstractMachine):
    """A motor that a rotating field keeps at its own speed: phi = t + ψ, torque = h - K sin ψ."""

    torque: float = 0.25
    cycle = 2 * np.pi
    renewed = vi.wrap_angles("phi")

    def field(self, t, z):
        return {"phi": z.v, "v": self.torque - DAMPING * z.v + 0.2 * jnp.sin(z.phi - t)}


@pytest.mark.slow
def test_a_motor_that_is_locked_lies_on_a_closed_curve():
    """Its phase makes a whole turn along the curve, and each fold is listed once."""
    machine = Locked()
    start = vi.State(phi=np.pi - np.arcsin(0.25), v=1.0)
    orbit = vi.find_orbit(machine, vi.simulate(machine, start, 20).last, throw=True)
    branch = vi.continue_orbit(orbit, parameter="torque", bounds=(0.0, 0.6), progress=False)
    assert branch.ends == ("closed", "closed")
    folds = sorted(point.parameter for point in branch.special)
    assert [point.kind for point in branch.special] == ["fold", "fold"]
    np.testing.assert_allclose(folds, [DAMPING - 0.2, DAMPING + 0.2], atol=1e-10)
    phase = np.unwrap(branch.sections["phi"])
    assert abs(phase[-1] - phase[0]) == pytest.approx(2 * np.pi, abs=1e-8)
    np.testing.assert_allclose(branch.parameter, DAMPING - 0.2 * np.sin(phase), atol=1e-9)


def test_a_section_at_half_a_turn_is_one_motion(orbit):
    """Rounding puts it on either side, a whole turn apart."""
    machine = Pendulum(zero=float(orbit.state.phi) - np.pi)
    speeds = jnp.linspace(2.5, 3.5, 16)
    data = vi.scan(machine, {"start.v": speeds}, measure="regime", progress=False)
    assert (data["period"].values == 1).all()
    region = {"start.phi": (-3.0, 3.0), "start.v": (-2.0, 2.0)}
    basins = vi.basins(machine, region, resolution=6, progress=False)
    assert len(basins.attractors) == 1


@pytest.mark.slow
def test_an_erosion_profile_passes_half_a_turn(orbit):
    zero = float(orbit.state.phi) - np.pi
    region = {"start.phi": (-3.0, 3.0), "start.v": (-2.0, 2.0)}
    profile = vi.integrity_profile(
        Pendulum(), "zero", [zero - 0.1, zero + 0.1], region, resolution=6, progress=False
    )
    assert profile.label.tolist() == [[0, 0]]
