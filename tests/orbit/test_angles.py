"""Orbits, branches, regimes and basins of a rotating pendulum, modulo whole turns."""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

DAMPING, TORQUE = 0.3, 0.9


class Pendulum(vi.AbstractMachine):
    """A driven pendulum. `zero` is the origin of its angle, the second name in sorted order."""

    amplitude: float = 1.6
    zero: float = 0.0
    cycle = 2 * np.pi
    renewed = vi.wrap_angles("phi")

    def field(self, t, z):
        drive = TORQUE + self.amplitude * jnp.cos(t)
        return {"phi": z.dphi, "dphi": drive - jnp.sin(z.phi + self.zero) - DAMPING * z.dphi}

    def start(self):
        return vi.State(phi=0.1, dphi=1.0)


def cycle_by_scipy(amplitude, phi, v):
    def field(t, x):
        return [x[1], TORQUE + amplitude * np.cos(t) - np.sin(x[0]) - DAMPING * x[1]]

    span = (0, 2 * np.pi)
    return solve_ivp(field, span, [phi, v], method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


@pytest.fixture(scope="module")
def orbit():
    machine = Pendulum()
    return vi.find_orbit(machine, vi.simulate(machine, machine.start(), 100).last)


def test_a_rotation_is_periodic(orbit):
    """Compare three turns per cycle with SciPy, and the determinant with Liouville's formula."""
    phi, v = float(orbit.state.phi), float(orbit.state.dphi)
    later = cycle_by_scipy(1.6, phi, v)
    np.testing.assert_allclose(later, [phi + 6 * np.pi, v], atol=1e-8)
    assert np.prod(orbit.multipliers) == pytest.approx(np.exp(-2 * np.pi * DAMPING), abs=1e-8)


@pytest.mark.slow
def test_a_branch_passes_half_a_turn(orbit):
    """The section angle passes ±π, where it wraps. Compare the last orbit with SciPy."""
    branch = vi.continue_orbit(orbit, parameter="amplitude", bounds=(0.5, 6.0))
    assert branch.ends == ("bounds", "bounds") and np.ptp(branch.sections["phi"]) > 6
    end = branch.orbit(-1)
    assert float(end.machine.amplitude) == pytest.approx(6.0)
    later = cycle_by_scipy(6.0, float(end.state.phi), float(end.state.dphi))
    turns = (later[0] - float(end.state.phi)) / (2 * np.pi)
    assert turns == pytest.approx(round(turns), abs=1e-8) and round(turns) != 0
    assert later[1] == pytest.approx(float(end.state.dphi), abs=1e-8)
    ax = vi.plot_branch(branch, y="section_phi", special=False)
    drawn = [line.get_ydata() for line in ax.lines if len(line.get_ydata()) > 1]
    assert max(np.abs(np.diff(y)).max() for y in drawn) < 1 < sum(map(len, drawn)) / 20
    plt.close(ax.figure)


class LockedMotor(vi.AbstractMachine):
    """A motor locked to a rotating field: phi = t + ψ, torque = 0.3 - 0.2 sin ψ."""

    torque: float = 0.25
    cycle = 2 * np.pi
    renewed = vi.wrap_angles("phi")

    def field(self, t, z):
        return {"phi": z.dphi, "dphi": self.torque - DAMPING * z.dphi + 0.2 * jnp.sin(z.phi - t)}


@pytest.mark.slow
def test_branch_of_a_locked_motor_is_closed():
    """The phase ψ turns by 2π along the branch, and each fold is listed once."""
    machine = LockedMotor()
    start = vi.State(phi=np.pi - np.arcsin(0.25), dphi=1.0)
    orbit = vi.find_orbit(machine, vi.simulate(machine, start, 20).last, throw=True)
    branch = vi.continue_orbit(orbit, parameter="torque", bounds=(0.0, 0.6), progress=False)
    assert branch.ends == ("closed", "closed")
    folds = sorted(point.parameter for point in branch.special)
    assert [point.kind for point in branch.special] == ["fold", "fold"]
    np.testing.assert_allclose(folds, [DAMPING - 0.2, DAMPING + 0.2], atol=1e-10)
    phase = np.unwrap(branch.sections["phi"])
    assert abs(phase[-1] - phase[0]) == pytest.approx(2 * np.pi, abs=1e-8)
    np.testing.assert_allclose(branch.parameter, DAMPING - 0.2 * np.sin(phase), atol=1e-9)


@pytest.mark.slow
def test_an_orbit_with_its_section_at_half_a_turn_is_counted_once(orbit):
    """Rounding puts the section angle near π or near -π."""
    machine = Pendulum(zero=float(orbit.state.phi) - np.pi)
    speeds = jnp.linspace(2.5, 3.5, 16)
    data = vi.scan(machine, {"start.dphi": speeds}, measure="regime", progress=False)
    assert (data["period"].values == 1).all()
    region = {"start.phi": (-3.0, 3.0), "start.dphi": (-2.0, 2.0)}
    basins = vi.basins(machine, region, resolution=6, progress=False)
    assert len(basins.attractors) == 1


REST = np.arcsin(0.3)


class Hanging(Pendulum):
    """A pendulum that settles at rest or in rotation. The inverted rest is a saddle between."""

    cycle = 2.0

    def field(self, t, z):
        return {"phi": z.dphi, "dphi": 0.3 - jnp.sin(z.phi + self.zero) - 0.1 * z.dphi}


@pytest.mark.slow
def test_an_edge_state_at_half_a_turn():
    """The edge state is the inverted pendulum, with multipliers in closed form. Its unstable
    manifold does not depend on the origin of the angle."""
    rates, ends = np.roots([1.0, 0.1, np.cos(np.pi - REST)]), []
    for zero in (-REST, np.pi / 2):
        machine, rest = Hanging(zero=zero), vi.State(phi=REST - zero, dphi=0.0)
        edge = vi.edge_state(machine, rest, rest.replace(dphi=6.0), settle=200, progress=False)
        assert edge.kind == "saddle" and len(edge.sections.phi) < 20
        np.testing.assert_allclose(np.sort(edge.orbit.multipliers), np.sort(np.exp(2 * rates)))
        found = vi.manifold(edge.orbit, which="unstable", length=1.0, progress=False)
        assert max(float(np.nanmax(abs(jnp.diff(x.phi)))) for x in found.branches) < 0.1
        ends.append(sorted((float(x.dphi[-1]), np.sin(x.phi[-1] + zero)) for x in found.branches))
    np.testing.assert_allclose(*ends, atol=1e-9)
