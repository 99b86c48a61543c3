"""Manifolds, exponents, lists of orbits and errors of methods do not depend on units."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from own_units import Cranked, variants

pytestmark = pytest.mark.slow


class Hardening(vi.AbstractMachine):
    """x'' + 0.1 x' + x + x³ = 0.4 cos 1.6 s, in given units of length and time."""

    length: float
    time: float

    @property
    def cycle(self):
        return 2 * np.pi * self.time / 1.6

    def field(self, s, state):
        x, v = state.x / self.length, state.v
        pull = 0.4 * jnp.cos(1.6 * s / self.time) - x - x**3
        return {"x": v, "v": pull * self.length / self.time**2 - 0.1 * v / self.time}


def test_manifolds_and_exponents_are_the_same_in_all_units():
    curves = []
    for length, time in ((1.0, 1.0), (1e-6, 1e-3)):
        machine = Hardening(length=length, time=time)
        guess = vi.State(x=-1.106 * length, v=1.224 * length / time)
        found = vi.manifold(vi.find_orbit(machine, guess), length=0.6, spacing=0.1, progress=False)
        assert found.lengths == pytest.approx((0.6, 0.6))
        curve = [[x.x / length, x.v * time / length] for x in found.branches]
        exponents = vi.lyapunov(machine, guess, 16, settle=20).exponents * time
        curves.append((curve, exponents))
    for other in curves[1:]:
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6), other, curves[0])


def test_all_orbits_distinguishes_small_motions():
    """Regression: orbits of equal period were merged."""
    found = []
    numbers = {"frequency": 0.9, "damping": 0.04, "stiffness": 1.0, "cubic": 0.0}
    for size in (1.0, 1e-6):
        machine = vi.machines.Duffing(
            amplitude=size, gap=2.0 * size, restitution=0.5, two_sided=False, **numbers
        )
        region = {"start.Y": (-3 * size, 2 * size), "start.V": (-3 * size, 3 * size)}
        all_of_them = vi.all_orbits(machine, 2, region=region, starts=64)
        rows = zip(all_of_them.orbits, all_of_them.found.tolist(), strict=True)
        found.append([[int(orbit.impacts), *row] for orbit, row in rows])
    assert found[0] == found[1] and len(found[0]) == 4


def test_errors_of_methods_are_the_same_in_all_units():
    """Lengths are compared with lengths only, not with the crank's speed."""
    errors = []
    for machine in variants(Cranked):
        tried = vi.suggest_method(machine, cycles=4, lanes=2).tried
        errors.append(max(x.error for x in tried if x.name.startswith("FixedStep")))
    np.testing.assert_allclose(errors, errors[0], rtol=1e-3)
