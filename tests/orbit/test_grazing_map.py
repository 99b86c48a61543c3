"""The local map of a grazing: the square-root map, and the signs of its entries."""

import numpy as np
import pytest
from vi_jax.orbit.forecast import find_attractors, scenario_of, windows
from vi_jax.orbit.local_map import LocalMap


def root_map(share):
    """Return the map with one multiplier λ = `share` and the entries eₙ = λⁿ."""
    ones = np.ones((1, 1))
    return LocalMap(np.array([[[share]]]), ones, ones, np.array([0.5]), np.array([1.0]))


@pytest.mark.parametrize(
    ("share", "outcome", "least", "most"),
    [
        (0.15, "period_adding", 0.0, 0.017), (0.24, "period_adding", 0.0, 0.017),
        (0.26, "period_adding_with_chaos", 0.02, 0.04),
        (0.3, "period_adding_with_chaos", 0.04, 0.07),
        (0.5, "period_adding_with_chaos", 0.3, 0.4),
        (0.65, "period_adding_with_chaos", 0.8, 0.96), (0.68, "chaos", 0.96, 1.0),
        (0.8, "chaos", 0.99, 1.0),
    ],
)  # fmt: skip
def test_thresholds_of_the_root_map(share, outcome, least, most):
    """Thresholds are 1/4 and 2/3 (Nusse, Ott and Yorke 1994)."""
    local = root_map(share)
    offsets = -np.geomspace(1e-7, 1e-3, 1000) * share**2
    name, aperiodic = scenario_of(local, offsets, find_attractors(local, offsets))
    assert name == outcome and least <= aperiodic <= most


def test_windows_of_the_root_map_shrink_by_the_square_of_the_multiplier():
    found = windows(root_map(0.2), 4e-4, 6)
    edges = found.stable[2:, 0]
    np.testing.assert_allclose(edges[1:] / edges[:-1], 0.04, rtol=0.05)
    assert np.isnan(found.stable[0]).all()


def test_signs_of_the_entries_decide_the_outcome():
    """With one multiplier, a kick towards the stop leaves no attractor near. If the entries have a
    negative sum, the motion with an impact in each period is on the other side."""
    offsets = -np.geomspace(1e-7, 1e-3, 60) * 0.25
    ones, half = np.ones((1, 1)), np.array([0.5])
    away = LocalMap(np.array([[[0.5]]]), ones, -ones, half, np.ones(1))
    assert scenario_of(away, offsets, find_attractors(away, offsets))[0] == "nonsmooth_fold"
    back = windows(away, 1e-2, 1)
    assert back.exists[0].max() > 0
    turned = LocalMap(np.array([[[-0.5]]]), ones, -ones, half, np.ones(1))  # e₁ > 0 > e₂
    assert (find_attractors(turned, offsets).period < 0).any()
    smooth = LocalMap(np.array([[[-0.5]]]), ones, ones, np.array([1.5]), np.ones(1))
    assert scenario_of(smooth, offsets, find_attractors(smooth, offsets))[0] == "persistence"


def test_periods_of_a_strongly_unstable_motion():
    """Regression: a power of the matrix was singular to rounding, so `grazing` raised an error. In
    the matrix's eigenvectors the states are λʲ/(1 - λⁿ)."""
    values, vectors = np.array([60.0, 1e-3]), np.array([[1.0, 0.4], [-0.7, 1.0]])
    matrix = vectors @ np.diag(values) @ np.linalg.inv(vectors)
    kick = np.array([0.3, 1.0])
    one = np.ones(1)
    local = LocalMap(matrix[None], np.array([[1.0, 0.2]]), kick[None], 0.5 * one, one)
    for n in (1, 3, 16):
        powers = np.arange(n + 1)[:, None]
        shares = np.where(values > 1, -(values ** (powers - n)) / (1 - values**-n), values**powers)
        shares = np.where(values > 1, shares, shares / (1 - values**n))
        expected = (shares * np.linalg.solve(vectors, kick)) @ vectors.T
        np.testing.assert_allclose(local.kicked(n), expected, rtol=1e-12, atol=1e-14)
    assert np.isnan(windows(local, 1e-2, 16).stable).all()
    # Nothing stays near, not even the smooth motion on the other side, which is met exactly.
    offsets = np.geomspace(1e-6, 1e-2, 8)
    assert (find_attractors(local, np.append(offsets, -offsets)).period == -1).all()
