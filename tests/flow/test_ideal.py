"""The ideal scene compared with the closed form, and its convergence to the 4π motion."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.linalg import expm
from vi_jax.flow.methods.exact import flight

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)

# Undamped, ζ = 0.9, k = 0.5, d = 2: cycles, Y, V, min Y, impact phase, V⁻ (independent values).
TABLE = [
    (1, 1.92303, -0.876442, -1.883583, 6.19998, 1.57475),
    (2, 1.609674, -1.943612, -3.254293, 12.37807, 3.54674),
]
DIGITS = [6e-6, 6e-7, 1e-6, 6e-6, 6e-6]  # half a unit of the digits printed (min Y: truncated)


@pytest.mark.parametrize("row", TABLE, ids=["2pi", "4pi"])
def test_table_of_values(row):
    cycles, *values = row
    orbit = vi.closed_form_orbits(SCENE, cycles=cycles)
    found = [orbit.Y, orbit.V, orbit.y_min, orbit.impact_phase, orbit.impact_speed]
    for value, number, digits in zip(found, values, DIGITS, strict=True):
        assert float(value[0]) == pytest.approx(number, abs=digits)
    start = SCENE.start(Y=orbit.Y[0], V=orbit.V[0])
    for method, tolerance in ((vi.ExactFlight(), 1e-12), (vi.Adaptive(rtol=1e-10), 1e-7)):
        run = vi.simulate(SCENE, start, cycles, method=method, impact_log=1)
        assert int(run.impacts.sum()) == 1
        measured = [
            run.sections.Y[-1],
            run.sections.V[-1],
            run.y_min.min(),
            run.impact_log.phase[-1, 0] + 2 * np.pi * (cycles - 1),
            run.impact_log.speed[-1, 0],
        ]
        for value, number in zip(measured, found, strict=True):
            assert float(value) == pytest.approx(float(number[0]), abs=tolerance)


@pytest.mark.parametrize(
    "method",
    [
        vi.ExactFlight(),
        vi.Adaptive(diffrax.Tsit5(), rtol=1e-9),
        vi.FixedStep(),
    ],
    ids=["ExactFlight", "Tsit5", "fixed Dopri8"],
)
def test_from_rest_settles_on_the_4pi_motion(method):
    run = vi.simulate(SCENE, SCENE.start(), 200, method=method)
    minima = sorted(np.asarray(run.y_min[-2:]))
    np.testing.assert_allclose(minima, [-3.254294, -1.544219], atol=2e-6)
    assert list(np.asarray(run.impacts[-4:])).count(1) == 2
    first = np.asarray(run.y_min[2:8])  # near the unstable 2π motion at first
    assert (first > -2.4).all()


def generator(zeta, xi):
    """Return the matrix A with dx/dτ = A x between impacts, for x = (Y, V, cos φ, sin φ)."""
    matrix = np.zeros((*np.shape(zeta), 4, 4))
    matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1] = 1.0, -1.0, -2 * xi
    matrix[..., 1, 2], matrix[..., 2, 3], matrix[..., 3, 2] = 1.0, -zeta, zeta
    return matrix


def test_flight_is_the_matrix_exponential():
    """Weak, critical and strong damping, resonance, and both sides of the switch near resonance."""
    zetas = [1e-3, 0.4, 1.0, 1 + 1e-9, 1 - 1e-6, 1.001, 0.991, 1.011, 30.0]
    zeta, xi = map(np.ravel, np.meshgrid(zetas, [0.0, 1e-4, 0.3, 1.0, 1.5, 10.0]))
    draw = np.random.default_rng(0)
    phase, (Y, V) = draw.uniform(0, 6.28), draw.normal(size=2)
    tau = 0.4 * np.pi / np.maximum(1.0, np.maximum(zeta, xi))
    found = jax.jit(jax.vmap(lambda z, x, t: flight(z, x, phase, Y, V, t)))(
        *map(jnp.asarray, (zeta, xi, tau))
    )
    truth = expm(generator(zeta, xi) * tau[:, None, None]) @ [Y, V, np.cos(phase), np.sin(phase)]
    np.testing.assert_allclose(np.stack(found, -1), truth[:, :2], atol=2e-13)
