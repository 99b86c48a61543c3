"""Manifolds of saddles, compared with closed forms and with boundaries of basins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from kicked import at, polynomial

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("which", ["stable", "unstable"])
@pytest.mark.parametrize("growth", [2.0, -2.0])
def test_curved_manifolds_agree_with_closed_forms(which, growth):
    """Manifolds of (x, y) → (g x + b y², y/2 + c x²) are x = b y²/(1/4 - g) if c = 0, and
    y = c x²/(g² - 1/2) if b = 0. A branch stays on one side, even if its multiplier is negative."""
    bent, straight = {(0, 2, 0, 0): 0.8}, {(2, 0, 0, 0): 0.8}
    bends = (bent, {}) if which == "stable" else ({}, straight)
    rows = {(1, 0, 0, 0): growth} | bends[0], {(0, 1, 0, 0): 0.5} | bends[1]
    saddle = vi.find_orbit(polynomial(0.0, 0.0, *rows), at(0.0, 0.0), throw=True)
    found = vi.manifold(saddle, which=which, length=1.5, spacing=0.1)
    assert found.lengths == pytest.approx((1.5, 1.5), abs=1e-9)
    sides = []
    for branch in found.branches:
        x, y = map(np.asarray, branch)
        off = x - 0.8 * y**2 / (0.25 - growth) if which == "stable" else y - 0.8 * x**2 / 3.5
        assert np.abs(off).max() < 1e-9
        assert np.hypot(np.diff(x), np.diff(y)).max() < 0.1 + 1e-9
        along = np.sign((y if which == "stable" else x)[1:])
        assert (along == along[0]).all()
        sides.append(along[0])
    assert sides[0] * sides[1] < 0


@pytest.fixture(scope="module")
def saddle():
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)
    return vi.find_orbit(scene, scene.start(Y=1.26, V=1.086), cycles=2)


def test_the_stable_manifold_is_a_basin_boundary(saddle):
    """Starts 1e-6 from the manifold settle on one impact on one side and on two on the other."""
    machine = saddle.machine

    def one(row):
        run = vi.simulate(machine, machine.start(Y=row[0], V=row[1]), 2, settle=400)
        return jnp.sum(run.impacts)

    impacts = vi.jit(jax.vmap(one))
    found = vi.manifold(saddle, length=2.0)
    assert found.lengths == pytest.approx((2.0, 2.0))
    for branch in found.branches:
        rows = np.stack([branch.Y, branch.V], axis=1)
        along = rows[2:] - rows[:-2]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        aside = 1e-6 * np.stack([-along[:, 1], along[:, 0]], axis=1)
        sides = np.sort([np.asarray(impacts(rows[1:-1] + x)) for x in (aside, -aside)], axis=0)
        assert len(rows) > 40
        np.testing.assert_array_equal(sides, np.repeat([[1], [2]], len(rows) - 2, axis=1))


def test_the_unstable_manifold_ends_at_the_two_attractors(saddle):
    found = vi.manifold(saddle, which="unstable")
    ends = sorted(float(branch.Y[-1]) for branch in found.branches)
    np.testing.assert_allclose(ends, [1.28266, 1.52828], atol=1e-3)
    ax = vi.plot_manifold(found)
    assert len(ax.lines) == 3 and ax.get_xlabel() and ax.get_ylabel()


def test_invalid_arguments_raise(saddle):
    with pytest.raises(ValueError, match="`which` must be one of"):
        vi.manifold(saddle, which="center")
    with pytest.raises(ValueError, match="`orbit` must be a saddle"):
        vi.manifold(vi.find_orbit(saddle.machine, saddle.machine.start(Y=1.283, V=1.007), 2))
