"""Extrema of quantities along a branch, compared with closed forms."""

import numpy as np
import pytest
import vi_jax as vi

ZETA, XI = "drive.frequency_ratio", 0.1


@pytest.fixture(scope="module")
def orbit():
    """Return the orbit of a linear oscillator whose stop is out of reach."""
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=20.0, damping_ratio=XI)
    return vi.find_orbit(scene, scene.start(), throw=True)


def test_unknown_names_raise(orbit):
    for names in ("speed", ("y_min", "speed")):
        with pytest.raises(ValueError, match=r"`extrema` must be one of .*'y_max'"):
            vi.continue_orbit(orbit, parameter=ZETA, bounds=(0.4, 1.6), extrema=names)


@pytest.mark.slow
def test_extrema_of_the_linear_oscillator(orbit):
    """The amplitude is 1/√((1 - ζ²)² + (2ξζ)²). The section values are the real parts of the
    complex response and of its velocity."""
    sought = ("y_max", "y_min", "section_Y", "section_V", "clearance", "multiplier", "duration")
    free = vi.continue_orbit(orbit, parameter=ZETA, bounds=(0.5, 1.5), extrema=sought)
    places = free.to_xarray(along="special").to_dataframe()
    assert (places.special_kind == "extremum").sum() == len(free.special)
    at = {name: [p for p in free.special if p.quantity == name] for name in free.column_names}
    peak, size = np.sqrt(1 - 2 * XI**2), 1 / (2 * XI * np.sqrt(1 - XI**2))
    for name, value in (("y_max", size), ("y_min", -size), ("clearance", 20 - size)):
        (point,) = at[name]
        assert point.kind == "extremum" and point.parameter == pytest.approx(peak, abs=1e-11)
        assert float(getattr(point.orbit, name)) == pytest.approx(value, abs=1e-12)
        assert f"is the {'largest' if name == 'y_max' else 'least'} nearby" in str(point)
    # Re 1/(1 - ζ² + 2iξζ) is extreme at ζ² = 1 ∓ 2ξ.
    places = [point.parameter for point in at["section_Y"]]
    np.testing.assert_allclose(places, np.sqrt([1 - 2 * XI, 1 + 2 * XI]), atol=1e-11)
    (fastest,) = at["section_V"]  # Re iζ/(1 - ζ² + 2iξζ)
    assert fastest.parameter == pytest.approx(1.0, abs=1e-11)
    assert not at["duration"] and not at["multiplier"]  # both are monotonic
