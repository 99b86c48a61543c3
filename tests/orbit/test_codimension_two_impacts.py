"""Points of codimension two of oscillators with a stop, beside closed forms and SciPy's flights."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq, fsolve

from grazings import grazing_of
from one_impact import degenerate, one_impact

pytestmark = pytest.mark.slow


def the(curve, kind):
    (point,) = (point for point in curve.special if point.kind == kind)
    return point


# ω* = 2√(1 - ζ²) at ζ = .05, and the coefficients of both curves there (computed with 40 digits).
MEETS, FOLD, DOUBLING = 1.99749843554, -33.9869, 2.443565


def grazes(omega):
    """F at which x'' + 0.1x' + x = F cos ωt just reaches x = 1."""
    return np.hypot(1 - omega**2, 0.1 * omega)


def coefficient_at(omega, curve, reach):
    """c of F = F_graze (1 + c (ω - ω*)²) on a curve in (F, ω), from points near ω* to it."""
    near = np.abs(curve.parameters[:, 1] - omega)
    near = curve.parameters[(near > 1e-3) & (near < reach)]
    away = near[:, 1] - omega
    assert len(away) > 6
    share = (near[:, 0] / grazes(near[:, 1]) - 1) / away**2
    return np.polynomial.Polynomial.fit(away, share, 5)(0.0)


@pytest.mark.parametrize(
    ("kind", "frequency", "coefficient"),
    [("fold", 1.95, FOLD), ("period-doubling", 2.04, DOUBLING)],
)
def test_a_fold_and_a_doubling_graze_where_a_grazing_is_resonant(kind, frequency, coefficient):
    """Of x'' + 0.1x' + x = F cos ωt with k = 0.8 the motion with one impact a cycle folds at one
    side of ω* and doubles at the other, at F = F_graze (1 + c (ω - ω*)²)."""

    machine = vi.machines.Duffing(
        amplitude=0.9 * grazes(frequency), frequency=frequency, damping=0.1, gap=1.0,
        restitution=0.8, two_sided=False,
    )  # fmt: skip
    point = grazing_of(machine, "amplitude", (0.5, 5.0))
    branch = vi.continue_orbit(point.switch(), parameter="amplitude", bounds=(0.5, 5.0))
    (special,) = (point for point in branch.special if point.kind == kind)
    bounds = ((0.5, 5.0), (1.8, 2.2))
    curve = vi.boundary(special, parameter="frequency", bounds=bounds, max_step=0.01)
    assert "grazing" in curve.ends
    end = the(curve, "grazing")
    np.testing.assert_allclose(end.parameters, [grazes(MEETS), MEETS], atol=1e-8)
    assert "is lost" in end.detail and end.impact == 0
    assert coefficient_at(MEETS, curve, 3e-2) == pytest.approx(coefficient, rel=1e-4)
    other = vi.boundary(end.switch(), parameter="frequency", bounds=bounds)
    assert other.kind == "grazing"
    force, omega = other.parameters.T
    np.testing.assert_allclose(force, grazes(omega), rtol=1e-11)
    meets = the(other, "resonant-grazing")
    np.testing.assert_allclose(meets.parameters, [grazes(MEETS), MEETS], atol=1e-10)
    assert meets.detail.endswith("with one impact in 1 period")


def section_of(found, force, omega, cycles):
    """x and x' at ωt = 0 of the faster motion with one impact in so many periods."""
    A = np.array([[0.0, 1.0], [-1.0, -0.1]])
    swing = force / (1 - omega**2 + 0.1j * omega)
    v = found.speed[1].real
    g = np.linalg.solve(np.eye(2) - expm(A * 2 * np.pi * cycles / omega), [0.0, -1.8])
    turned = (1.0 - v * g[0]) - 1j * v * (1 - g[1] - 1.8) / omega
    phase = np.mod(np.angle(turned / swing), 2 * np.pi)
    after = np.array([1.0 - turned.real, -0.8 * v - (1j * omega * turned).real])
    ahead = expm(A * (2 * np.pi - phase) / omega) @ after
    return ahead + np.array([swing.real, (1j * omega * swing).real])


@pytest.mark.exhaustive
@pytest.mark.parametrize("cycles", [2, 3])
@pytest.mark.parametrize(
    ("kind", "side", "away"), [("fold", -0.05, 0.5), ("period-doubling", 0.04, 2)]
)
def test_motions_of_several_cycles_have_theirs_as_well(kind, side, away, cycles):
    """With one impact in n cycles at 2n√(1 - ζ²), with the coefficients of one cycle: its curves
    there, and all along them the closed form of the motion."""
    meets, c = cycles * MEETS, {"fold": FOLD, "period-doubling": DOUBLING}[kind]
    omega = meets + side
    force = grazes(omega) * (1 + away * c * side**2)
    given = {"damping": 0.05, "restitution": 0.8, "gap": 1.0, "cycles": cycles}
    machine = vi.machines.Duffing(
        amplitude=force, frequency=omega, damping=0.1, gap=1.0, restitution=0.8, two_sided=False
    )
    Y, V = section_of(one_impact(omega, force, **given), force, omega, cycles)
    # Of three long cycles the steps' own error is more than the usual tolerance.
    newton = vi.Newton(tolerance=1e-8)
    start = machine.start(Y=Y, V=V)
    orbit = vi.find_orbit(machine, start, cycles=cycles, throw=True, root_finder=newton)
    assert int(orbit.impacts) == 1 and bool(orbit.stable)
    bounds = (0.5 * force, 1.5 * force)
    branch = vi.continue_orbit(orbit, parameter="amplitude", bounds=bounds)
    (special,) = (point for point in branch.special if point.kind == kind)
    frequencies = (meets - 0.2, meets + 0.2)
    curve = vi.boundary(special, parameter="frequency", bounds=(bounds, frequencies), max_step=0.04)
    end = the(curve, "grazing")
    np.testing.assert_allclose(end.parameters, [grazes(meets), meets], rtol=1e-9)
    assert coefficient_at(meets, curve, 5e-2) == pytest.approx(c, rel=1e-4)
    for F, w in curve.parameters[np.abs(curve.parameters[:, 1] - meets) > 1e-2]:
        found = one_impact(w, F, **given)
        if kind == "fold":
            assert abs(found.speed[1] - found.speed[0]) < 1e-4 * abs(found.speed[1])
        else:
            assert abs(found.trace[1] + 1 + found.determinant) < 1e-6


class Fed(vi.AbstractMachine):
    """x'' - 0.04 x' + x = cos ωt against a stop at x = 0, by the phase ωt."""

    frequency: jax.Array = eqx.field(converter=jnp.asarray)
    restitution: jax.Array = eqx.field(converter=jnp.asarray)

    @property
    def stops(self):
        return (vi.RigidStop(0.0, self.restitution),)

    @property
    def cycle(self):
        return 2 * np.pi

    def field(self, s, x):
        push = jnp.cos(s) + 0.04 * x.V - x.Y
        return vi.OscillatorState(x.V / self.frequency, push / self.frequency)


@pytest.fixture(scope="module")
def fed():
    """The Neimark–Sacker points of the motion with one impact a cycle, which is fed as much between
    impacts as these take."""
    start = vi.OscillatorState(jnp.asarray(-0.5), jnp.asarray(-0.5))
    start = vi.simulate(Fed(1.8, 0.8), start, 1, settle=400).last
    orbit = vi.find_orbit(Fed(1.8, 0.8), start, throw=True)
    assert int(orbit.impacts) == 1
    branch = vi.continue_orbit(orbit, parameter="restitution", bounds=(0.5, 0.99))
    (point,) = (point for point in branch.special if point.kind == "neimark-sacker")
    assert point.parameter == pytest.approx(balanced(1.8), abs=1e-10)
    return vi.boundary(point, parameter="frequency", bounds=((0.5, 0.99), (1.0, 1.9)))


def balanced(frequency):
    """k at which det M = k² exp(0.04 T) is 1."""
    return np.exp(-0.02 * 2 * np.pi / frequency)


def trace(frequency, restitution=None):
    k = balanced(frequency) if restitution is None else restitution
    return one_impact(
        frequency, 1.0, damping=-0.02, restitution=k, gap=0.0, cycles=1
    ).trace[1].real  # fmt: skip


def test_neimark_sacker_points_of_an_oscillator_that_is_fed(fed):
    k, frequency = fed.parameters.T
    np.testing.assert_allclose(k, balanced(frequency), atol=1e-10)
    np.testing.assert_allclose(
        2 * np.cos(fed.angle), [trace(omega) for omega in frequency], atol=1e-7
    )
    assert sorted(fed.ends) == ["bounds", "resonance-1:2"]
    wanted = [
        ("resonance-1:2", brentq(lambda w: trace(w) + 2, 1.2, 1.3, xtol=1e-14)),
        ("resonance-1:3", brentq(lambda w: trace(w) + 1, 1.3, 1.5, xtol=1e-14)),
        ("resonance-1:4", brentq(trace, 1.5, 1.6, xtol=1e-14)),
    ]
    found = sorted(fed.special, key=lambda point: point.parameters[1])
    assert [point.kind for point in found] == [kind for kind, _ in wanted]
    for point, (_, omega) in zip(found, wanted, strict=True):
        np.testing.assert_allclose(point.parameters, [balanced(omega), omega], atol=1e-8)


def test_doublings_from_a_resonance(fed):
    point = next(p for p in fed.special if p.kind == "resonance-1:2")
    curve = vi.boundary(point.switch(), parameter="frequency", bounds=((0.5, 0.99), (1.0, 1.9)))
    assert curve.kind == "period-doubling"
    for k, omega in curve.parameters[1:-1]:
        determinant = k**2 * np.exp(0.04 * 2 * np.pi / omega)
        assert trace(omega, k) + 1 + determinant == pytest.approx(0, abs=1e-7)
    near = [p.parameters for p in curve.special if p.kind == "resonance-1:2"]
    assert min(np.abs(p - point.parameters).max() for p in near) < 1e-8


# x'' + 0.1 x' + x + 0.1 x³ = F cos ωt, without impacts.
DAMPING, CUBIC = 0.1, 0.1


def flown(start, force, omega):
    """SciPy's state after a period, and the derivative by the state."""

    def field(t, x):
        A = np.array([[0, 1], [-1 - 3 * CUBIC * x[0] ** 2, -DAMPING]])
        push = force * np.cos(omega * t) - x[0] - CUBIC * x[0] ** 3 - DAMPING * x[1]
        return np.concatenate([[x[1], push], (A @ x[2:].reshape(2, 2)).ravel()])

    begin = np.concatenate([start, np.eye(2).ravel()])
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    end = solve_ivp(field, (0, 2 * np.pi / omega), begin, **options).y[:, -1]
    return end[:2], end[2:].reshape(2, 2)


def lacks_of_a_cusp(unknowns):
    """What state, F and ω lack to be those of a cusp: a periodic motion with a multiplier 1, and
    beside it, along that one's vector, to second order as well."""
    start, force, omega = unknowns[:2], *unknowns[2:]

    def critical(x):
        M = flown(x, force, omega)[1]
        return np.linalg.det(M - np.eye(2))

    end, M = flown(start, force, omega)
    vector = np.linalg.svd(M - np.eye(2))[2][-1]
    h = 4e-3
    ahead = [critical(start + n * h * vector) for n in (-2, -1, 1, 2)]
    slope = np.dot(ahead, [1, -8, 8, -1]) / (12 * h)
    return [*(end - start), critical(start), slope]


@pytest.fixture(scope="module")
def bent():
    """A fold of a Duffing oscillator in its force, far from its stop."""
    machine = vi.machines.Duffing(
        amplitude=0.1, frequency=1.4, damping=DAMPING, cubic=CUBIC, gap=8.0, two_sided=False
    )
    orbit = vi.find_orbit(machine, machine.start(), throw=True)
    branch = vi.continue_orbit(orbit, parameter="amplitude", bounds=(0.05, 2.0))
    folds = [point for point in branch.special if point.kind == "fold"]
    assert len(folds) == 2
    return max(folds, key=lambda point: float(point.orbit.y_max))


def test_the_cusp_of_a_duffing_oscillator(bent):
    curve = vi.boundary(bent, parameter="frequency", bounds=((0.02, 2.0), (1.0, 1.6)))
    cusp = the(curve, "cusp")
    state = [float(cusp.orbit.state.Y), float(cusp.orbit.state.V)]
    root = fsolve(lacks_of_a_cusp, [*state, *cusp.parameters], xtol=1e-12)
    np.testing.assert_allclose(cusp.parameters, root[2:], atol=1e-8)
    np.testing.assert_allclose(state, root[:2], atol=1e-6)


def test_a_fold_that_touches_the_stop(bent):
    """It does where the gap is what its motion reaches without a stop."""
    high, force = float(bent.orbit.y_max), bent.parameter
    curve = vi.boundary(bent, parameter="gap", bounds=((0.05, 2.0), (1.0, 10.0)))
    end = the(curve, "grazing")
    np.testing.assert_allclose(end.parameters, [force, high], atol=1e-9)
    assert end.impact is None and "touches a stop" in end.detail
    touches = vi.boundary(end.switch(), parameter="gap", bounds=((0.05, 2.0), (0.5, 6.0)))
    assert touches.kind == "grazing"
    folds = [point for point in touches.special if point.kind == "fold"]
    assert min(np.abs(point.parameters - end.parameters).max() for point in folds) < 1e-8
    back = vi.boundary(folds[0].switch(), parameter="gap", bounds=((0.05, 2.0), (0.5, 10.0)))
    assert back.kind == "fold"


def test_a_doubling_of_the_paper_becomes_degenerate():
    """Beside the normal form of a map of closed forms, by differences, which are right to 1e-7."""
    scene = vi.Scene.ideal(frequency_ratio=0.78, restitution=0.5, gap=2.0, damping_ratio=0.12)
    closed = vi.closed_form_orbits(scene)
    start = scene.start(Y=closed.Y[0], V=closed.V[0])
    branch = vi.continue_orbit(
        vi.find_orbit(scene, start, throw=True), parameter="drive.frequency_ratio",
        bounds=(0.7, 0.9),
    )  # fmt: skip
    (point,) = (point for point in branch.special if point.kind == "period-doubling")
    curve = vi.boundary(
        point, parameter="oscillator.damping_ratio", bounds=((0.7, 0.9), (0.1, 0.2))
    )
    wanted = degenerate(lambda xi: (0.5, xi), 0.13, 0.145, (0.775, 0.795))
    np.testing.assert_allclose(the(curve, "degenerate-doubling").parameters, wanted, atol=5e-7)


@pytest.mark.exhaustive
def test_both_walls_of_a_box_grazed_at_once_are_two_touches():
    """Where half the gap is the box's amplitude the ball stands between both walls; an impact
    of depth one moves it by 2π(1 + e)√2 in each period after it, which vanishes nowhere."""
    pair = vi.machines.ImpactPair(half_gap=1.6, restitution=0.5)
    orbit = vi.find_orbit(pair, pair.start(place=-0.855516, speed=0.562099), throw=True)
    branch = vi.continue_orbit(orbit, parameter="half_gap", bounds=(0.9, 6.0))
    point = branch.special[-1]
    assert point.kind == "grazing" and point.parameter == pytest.approx(1.0, abs=1e-12)
    with pytest.raises(ValueError, match="no admissible motion with 0 impacts"):
        point.switch()  # beyond it the ball floats anywhere
    curve = vi.boundary(point, parameter="restitution", bounds=((0.5, 2.0), (0.4, 0.6)))
    np.testing.assert_allclose(curve.parameters[:, 0], 1.0, atol=1e-12)
    assert curve.special == ()
    found = vi.grazing(point, check=False)
    np.testing.assert_allclose(found.entries, 3 * np.pi * np.sqrt(2) * np.arange(1, 13), rtol=1e-9)
