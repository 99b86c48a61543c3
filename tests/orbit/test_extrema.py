"""Numbers that are largest or least along a branch, beside closed forms."""

import jax
import numpy as np
import pytest
import vi_jax as vi
from scipy.optimize import brentq

ZETA, XI = "drive.frequency_ratio", 0.1


@pytest.fixture(scope="module")
def free():
    """The branch of the linear oscillator, out of reach of its stop."""
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=20.0, damping_ratio=XI)
    sought = ("y_max", "y_min", "section_Y", "section_V", "clearance", "multiplier", "duration")
    orbit = vi.find_orbit(scene, scene.start(), throw=True)
    return vi.continue_orbit(orbit, parameter=ZETA, bounds=(0.5, 1.5), extrema=sought)


@pytest.mark.slow
def test_of_the_linear_oscillator(free):
    """Resonance of the amplitude 1/√((1 - ζ²)² + (2ξζ)²), and of what is seen on the section, its
    real part and that of its velocity."""
    at = {name: [p for p in free.special if p.quantity == name] for name in free.column_names}
    peak, size = np.sqrt(1 - 2 * XI**2), 1 / (2 * XI * np.sqrt(1 - XI**2))
    for name, value in (("y_max", size), ("y_min", -size), ("clearance", 20 - size)):
        (point,) = at[name]
        assert point.kind == "extremum" and point.parameter == pytest.approx(peak, abs=1e-11)
        assert float(getattr(point.orbit, name)) == pytest.approx(value, abs=1e-12)
        assert f"is {'largest' if name == 'y_max' else 'least'} of all" in str(point)
    # Re 1/(1 - ζ² + 2iξζ) is extreme at ζ² = 1 ∓ 2ξ.
    places = [point.parameter for point in at["section_Y"]]
    np.testing.assert_allclose(places, np.sqrt([1 - 2 * XI, 1 + 2 * XI]), atol=1e-11)
    (fastest,) = at["section_V"]  # Re iζ/(1 - ζ² + 2iξζ)
    assert fastest.parameter == pytest.approx(1.0, abs=1e-11)
    assert not at["duration"] and not at["multiplier"]  # both change one way


def closed(zeta):
    return vi.closed_form_orbits(vi.Scene.ideal(frequency_ratio=zeta, restitution=0.5))


@pytest.mark.exhaustive
def test_of_a_motion_with_one_impact():
    """Where the derivative of the closed form of Eq. 14 to 21 vanishes."""
    scene, near = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5), closed(0.9)
    orbit = vi.find_orbit(scene, scene.start(Y=near.Y[0] - 1e-3, V=near.V[0]), throw=True)
    sought = ("fastest_impact", "y_min", "y_max", "multiplier")
    branch = vi.continue_orbit(orbit, parameter=ZETA, bounds=(0.72, 1.51), extrema=sought)

    rates = {
        "fastest_impact": jax.jit(jax.grad(lambda zeta: closed(zeta).impact_speed[0])),
        "y_min": jax.jit(jax.grad(lambda zeta: closed(zeta).y_min[0])),
    }
    for name, low, high, kind in (
        ("fastest_impact", 1.45, 1.5, "largest"), ("y_min", 0.75, 0.8, "largest"),
        ("y_min", 1.48, 1.51, "least"),
    ):  # fmt: skip
        at = brentq(lambda zeta, name=name: float(rates[name](zeta)), low, high, xtol=1e-14)
        (point,) = (p for p in branch.special if p.quantity == name and f"is {kind}" in p.detail)
        assert point.parameter == pytest.approx(at, abs=1e-10)
    assert not [p for p in branch.special if p.quantity == "y_max"]  # which is the stop's place
    places = branch.to_xarray(along="special").to_dataframe()
    assert (places.special_kind == "extremum").sum() >= 3


@pytest.mark.parametrize("names", ["speed", ("y_min", "speed")])
def test_unknown_names_are_refused(free, names):
    with pytest.raises(ValueError, match=r"`extrema` must be one of .*'fastest_impact'|'y_max'"):
        vi.continue_orbit(free.orbit(3), parameter=ZETA, bounds=(0.4, 1.6), extrema=names)
