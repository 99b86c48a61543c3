"""Manifolds of saddles, beside closed forms and beside the basins whose boundary they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

pytestmark = pytest.mark.slow


class Bent(vi.AbstractMachine):
    """x' = x + b y², y' = -y + c x²: with c = 0 the stable manifold of the origin is x = -b y²/3,
    with b = 0 the unstable one is y = c x²/3."""

    b: jax.Array | float = 0.0
    c: jax.Array | float = 0.0

    @property
    def cycle(self):
        return 1.0

    def field(self, s, z):
        return vi.OscillatorState(z.Y + self.b * z.V**2, -z.V + self.c * z.Y**2)


@pytest.fixture(scope="module")
def method():
    return vi.Adaptive(rtol=1e-11)


@pytest.mark.parametrize(("which", "bend"), [("stable", 0.8), ("unstable", 0.8)])
def test_bent_manifolds_of_a_machine_with_closed_forms(which, bend, method):
    stable = which == "stable"
    machine = Bent(b=bend if stable else 0.0, c=0.0 if stable else bend)
    saddle = vi.find_orbit(
        machine, vi.OscillatorState(jnp.asarray(0.0), jnp.asarray(0.0)), method=method
    )
    found = vi.manifold(saddle, which=which, length=1.5, spacing=0.1)
    assert found.lengths == pytest.approx((1.5, 1.5), abs=1e-9)
    ends = []
    for branch in found.branches:
        Y, V = np.asarray(branch.Y), np.asarray(branch.V)
        off = Y + bend * V**2 / 3 if stable else V - bend * Y**2 / 3
        assert np.abs(off).max() < 1e-9
        assert np.hypot(np.diff(Y), np.diff(V)).max() < 0.1 + 1e-9
        ends.append((V if stable else Y)[-1])
    assert ends[0] * ends[1] < 0  # one to each side


@pytest.fixture(scope="module")
def saddle():
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)
    return vi.find_orbit(scene, scene.start(Y=1.26, V=1.086), cycles=2)


def test_the_stable_manifold_is_the_boundary_of_basins(saddle):
    """On its two sides, 1e-6 away, starts settle on motions with one impact and with two."""
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


def test_the_unstable_manifold_leads_to_the_motions_on_both_sides(saddle):
    found = vi.manifold(saddle, which="unstable")
    ends = sorted(float(branch.Y[-1]) for branch in found.branches)
    np.testing.assert_allclose(ends, [1.28266, 1.52828], atol=1e-3)
    ax = vi.plot_manifold(found)
    assert len(ax.lines) == 3 and ax.get_xlabel() and ax.get_ylabel()


def test_what_has_no_manifolds(saddle):
    with pytest.raises(ValueError, match="`which` must be one of"):
        vi.manifold(saddle, which="center")
    scene = saddle.machine
    with pytest.raises(ValueError, match="`orbit` must be a saddle"):
        vi.manifold(vi.find_orbit(scene, scene.start(Y=1.283, V=1.007), 2))
