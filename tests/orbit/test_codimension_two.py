"""Codimension-two points on boundaries of maps, compared with their closed forms."""

import dataclasses
import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from kicked import at, polynomial

pytestmark = pytest.mark.slow

FREE = ((-6.0, 6.0), (-4.0, 4.0))
FADES = {(0, 1, 0, 0): 0.3}


def special_of(machine, start, kind):
    """Return the special points of a kind on the branch in the parameter a."""
    orbit = vi.find_orbit(machine, at(*start), throw=True)
    branch = vi.continue_orbit(orbit, parameter="a", bounds=FREE[0])
    found = [point for point in branch.special if point.kind == kind]
    assert found, branch
    return found


def kinds_of(curve):
    return [point.kind for point in curve.special]


def only(curve, kind):
    (point,) = (point for point in curve.special if point.kind == kind)
    return point


def test_folds_meet_in_a_cusp():
    """x ← x + (a - 0.2 + (b - 0.1) x - x³)/10: folds at b - 0.1 = 3x², a - 0.2 = -2x³."""
    terms = {
        (0, 0, 0, 0): -0.02, (0, 0, 1, 0): 0.1, (1, 0, 0, 0): 0.99, (1, 0, 0, 1): 0.1,
        (3, 0, 0, 0): -0.1,
    }  # fmt: skip
    first, _ = special_of(polynomial(0.2, 0.4, terms, FADES), (0.0, 0.0), "fold")
    curve = vi.boundary(first, parameter="b", bounds=FREE)
    a, b = curve.parameters.T
    np.testing.assert_allclose((a - 0.2) ** 2 / 4, ((b - 0.1) / 3) ** 3, atol=1e-10)
    assert a.min() < -2 and a.max() > 2 and kinds_of(curve) == ["cusp"]
    cusp = only(curve, "cusp")
    np.testing.assert_allclose(cusp.parameters, [0.2, 0.1], atol=1e-10)
    assert float(cusp.orbit.state[0]) == pytest.approx(0, abs=1e-8)
    with pytest.raises(ValueError, match=r"at a cusp of a curve of fold\. .* has: fold-flip, "):
        cusp.switch()


def test_a_doubling_becomes_degenerate():
    """x ← -(1 + a - 0.1b²) x + x² + b x³. In the half cycles before and after, x' = -decay x³ gives
    x - decay x³/2 + … The motion doubles at a = 0.1b², to stable motions where
    (f''/2)² + f'''/6 = 1 + b + decay is positive."""
    decay = 1.0
    terms = {
        (1, 0, 0, 0): -1.0, (1, 0, 1, 0): -1.0, (1, 0, 0, 2): 0.1, (2, 0, 0, 0): 1.0,
        (3, 0, 0, 1): 1.0,
    }  # fmt: skip
    machine = polynomial(0.2, 0.5, terms, FADES, decay=decay)
    (doubling,) = special_of(machine, (0.0, 0.0), "period-doubling")
    assert doubling.parameter == pytest.approx(0.025, abs=1e-10)
    curve = vi.boundary(doubling, parameter="b", bounds=((-1.0, 1.0), (-3.0, 3.0)))
    np.testing.assert_allclose(curve.parameters[:, 0], 0.1 * curve.parameters[:, 1] ** 2, atol=1e-9)
    assert kinds_of(curve) == ["degenerate-doubling"]
    wanted = np.array([0.1 * (1 + decay) ** 2, -1 - decay])
    np.testing.assert_allclose(curve.special[0].parameters, wanted, atol=1e-9)


def test_folds_meet_doublings():
    """x ← x + (x² + a)/5, y ← -(0.7 + b + x) y: folds at a = 0, doublings at a = -(0.3 - b)²."""
    rows = (
        {(1, 0, 0, 0): 1.0, (2, 0, 0, 0): 0.2, (0, 0, 1, 0): 0.2},
        {(0, 1, 0, 0): -0.7, (0, 1, 0, 1): -1.0, (1, 1, 0, 0): -1.0},
    )
    (fold,) = special_of(polynomial(-0.25, 0.0, *rows), (-0.5, 0.0), "fold")
    fold = pickle.loads(pickle.dumps(fold))
    curve = vi.boundary(fold, parameter="b", bounds=((-1.0, 1.0), (-1.0, 1.0)))
    # A pickled curve has the same points and switches as the original.
    curve = dataclasses.replace(pickle.loads(pickle.dumps(curve)), ends=("bounds", "bounds"))
    assert kinds_of(curve) == ["fold-flip"]
    (meets,) = curve.special
    np.testing.assert_allclose(meets.parameters, [0.0, 0.3], atol=1e-10)
    other = vi.boundary(meets.switch(), parameter="b", bounds=((-1.0, 1.0), (-0.5, 1.0)))
    assert other.kind == "period-doubling" and "fold-flip" in kinds_of(other)
    a, b = other.parameters.T
    np.testing.assert_allclose(a, -((0.3 - b) ** 2), atol=1e-10)
    np.testing.assert_allclose(only(other, "fold-flip").parameters, [0.0, 0.3], atol=1e-9)
    again = only(other, "fold-flip").switch()
    back = vi.boundary(again, parameter="b", bounds=((-1.0, 1.0), (-1.0, 1.0)))
    assert back.kind == "fold"
    np.testing.assert_allclose(back.parameters[:, 0], 0, atol=1e-9)


# x ← y, y ← a - bx - y² + R xy: at a fixed point the trace is (R - 2) x, the determinant b - R x.
R = 0.1
HENON = (
    {(0, 1, 0, 0): 1.0},
    {(0, 0, 1, 0): 1.0, (1, 0, 0, 1): -1.0, (0, 2, 0, 0): -1.0, (1, 1, 0, 0): R},
)


def parameters_at(x, b):
    """Return (a, b) for a fixed point at x."""
    return np.array([(b + 1) * x + (1 - R) * x**2, b])


def resonance(cosine):
    x = 2 * cosine / (R - 2)
    return parameters_at(x, 1 + R * x)


@pytest.fixture(scope="module")
def torus():
    """The curve of Neimark–Sacker points of the map."""
    a = parameters_at(0.3, 1.02)[0]
    (point,) = special_of(polynomial(a, 1.02, *HENON), (0.3, 0.3), "neimark-sacker")
    assert point.parameter == pytest.approx(parameters_at(0.2, 1.02)[0], abs=1e-9)
    return vi.boundary(point, parameter="b", bounds=FREE)


def test_neimark_sacker_points_and_their_resonances(torus):
    assert torus.kind == "neimark-sacker"
    assert sorted(torus.ends) == ["resonance-1:1", "resonance-1:2"]
    a, b = torus.parameters.T
    x = 2 * np.cos(torus.angle) / (R - 2)
    np.testing.assert_allclose(np.stack([a, b]), parameters_at(x, 1 + R * x), atol=1e-7)
    np.testing.assert_allclose(np.abs(torus.multipliers), 1, atol=1e-7)
    order = ["resonance-1:1", "resonance-1:4", "resonance-1:3", "resonance-1:2"]
    assert kinds_of(torus) in (order, order[::-1])
    for kind, cosine in zip(order, (1, 0, -0.5, -1), strict=True):
        found = only(torus, kind).parameters
        np.testing.assert_allclose(found, resonance(cosine), atol=1e-8)
    table = torus.to_xarray(along="point").to_dataframe()
    np.testing.assert_array_equal(table.angle, torus.angle)
    assert "resonance-1:3 at (" in str(torus)
    listed = torus.to_xarray(along="special").to_dataframe()
    assert listed.special_kind.tolist() == kinds_of(torus)
    np.testing.assert_array_equal(
        listed[["special_a", "special_b"]], [point.parameters for point in torus.special]
    )


@pytest.mark.parametrize(
    ("kind", "resonant", "cosine"),
    [("fold", "resonance-1:1", 1), ("period-doubling", "resonance-1:2", -1)],
)
def test_curves_on_which_neimark_sacker_points_begin(torus, kind, resonant, cosine):
    """Switch from a resonance to the curve of folds or doublings, and back."""
    bounds = ((-6.0, 6.0), (-2.0, 4.0))
    curve = vi.boundary(only(torus, resonant).switch(), parameter="b", bounds=bounds)
    assert curve.kind == kind
    a, b = curve.parameters.T
    x = (1 + b) / (2 * R - 2) if kind == "fold" else (1 + b) / 2
    assert np.ptp(b) > 1
    np.testing.assert_allclose(np.stack([a, b]), parameters_at(x, b), atol=1e-8)
    point = only(curve, resonant)
    np.testing.assert_allclose(point.parameters, resonance(cosine), atol=1e-8)
    again = vi.boundary(point.switch(), parameter="b", bounds=FREE)
    assert again.kind == "neimark-sacker" and sorted(again.ends) == sorted(torus.ends)


class Pitchfork(vi.AbstractMachine):
    """x' = (a - 0.1b²) x + (b - 0.5) x³ - x⁵, y' = -y: the rest x = 0 loses its symmetry at
    a = 0.1b², in a subcritical pitchfork where b > 0.5."""

    a: jax.Array = eqx.field(converter=jnp.asarray)
    b: jax.Array = eqx.field(converter=jnp.asarray)
    cycle = 1.0

    def field(self, s, x):
        grows = self.a - 0.1 * self.b**2 + (self.b - 0.5) * x[0] ** 2 - x[0] ** 4
        return grows * x[0], -x[1]

    def mirrored(self, x):
        return tuple(-y for y in x)


def test_a_loss_of_symmetry_becomes_degenerate():
    (point,) = special_of(Pitchfork(-0.5, 0.2), (0.0, 0.0), "symmetry-breaking")
    curve = vi.boundary(point, parameter="b", bounds=((-1.0, 1.0), (-1.0, 1.0)))
    assert kinds_of(curve) == ["degenerate-symmetry-breaking"]
    np.testing.assert_allclose(curve.special[0].parameters, [0.025, 0.5], atol=1e-9)
