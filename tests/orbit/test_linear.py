"""Linear algebra of small matrices, the root finder's steps, zeros; double multipliers."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax.orbit.conditions import is_defective
from vi_jax.orbit.linear import solve, svd
from vi_jax.orbit.locate import bracketed_zero
from vi_jax.orbit.root_finders import _dogleg


def test_singular_values_of_matrices_that_are_not_finite():
    matrices = np.random.default_rng(0).normal(size=(3, 4, 4)).astype(np.float32)
    matrices[1, 2, 0] = np.inf
    left, values, right = svd(matrices)
    product = (left * values[:, None]) @ right
    np.testing.assert_allclose(product[[0, 2]], matrices[[0, 2]], atol=1e-5)
    assert np.isnan(product[1]).all()
    assert {x.dtype for x in (left, values, right)} == {np.dtype(np.float32)}


def test_steps_within_a_trust_region():
    """A radius of 1 gives the smallest solution. The longer a step, the less remains."""
    draw = np.random.default_rng(1)
    jacobians, residuals = draw.normal(size=(64, 3, 3)), draw.normal(size=(64, 3))
    jacobians[:8, :, 0] = jacobians[:8, :, 1]  # singular
    step = lambda radius: _dogleg(jacobians, residuals, np.full(64, radius))[0]
    newton = -np.stack([np.linalg.pinv(J) @ r for J, r in zip(jacobians, residuals, strict=True)])
    np.testing.assert_allclose(step(1.0), newton, rtol=1e-9, atol=1e-12)
    lengths = np.linalg.norm(newton, axis=1)
    np.testing.assert_allclose(np.linalg.norm(step(0.3), axis=1), 0.3 * lengths, rtol=1e-9)
    left = lambda x: np.linalg.norm(residuals + np.einsum("nij,nj->ni", jacobians, x), axis=1)
    remain = [left(step(radius)) for radius in (0.0, 1e-3, 0.1, 0.3, 0.9, 1.0)]
    assert (np.diff(remain, axis=0) <= 1e-12).all()


def test_zeros_between_two_places():
    calls = []
    for function, zero in (
        (lambda x: x**3 - 2, 2 ** (1 / 3)), (lambda x: np.exp(40 * x) - 3, np.log(3) / 40),
        (lambda x: np.sign(x - 0.3), 0.3), (lambda x: x, 0.0),
    ):  # fmt: skip
        counted = lambda x, f=function: calls.append(x) or f(x)
        assert abs(bracketed_zero(counted, 2.0, -1.0, tolerance=1e-14) - zero) < 2e-14
    assert len(calls) < 100
    with pytest.raises(ArithmeticError):
        bracketed_zero(lambda x: x**2 + 1, 0.0, 1.0, tolerance=1e-9)


def test_solutions_and_their_derivatives():
    draw = np.random.default_rng(0)
    matrices, right_side = draw.normal(size=(2, 3, 3)), draw.normal(size=3)
    norm = lambda solver: lambda matrix: jnp.sum(solver(matrix, right_side) ** 2)
    for transform in (lambda f: f, jax.hessian):
        ours, theirs = (
            jax.vmap(transform(norm(solver)))(matrices) for solver in (solve, jnp.linalg.solve)
        )
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    matrices[0] = 1.0
    found = jax.jit(jax.vmap(solve, (0, None)))(matrices, np.eye(3))
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1], np.linalg.inv(matrices[1]), rtol=1e-12)


PAIR = [[1.0, 0.0], [0.0, 1.0]]
BLOCK = [[1.0, 0.3], [0.0, 1.0]]


@pytest.mark.parametrize("large", [2.0, 7e4, 1e8])
@pytest.mark.parametrize(
    ("plane", "defective"), [([[1.0, 0.0], [0.0, 0.4]], True), (PAIR, False), (BLOCK, True)]
)
def test_a_large_multiplier_does_not_matter(plane, defective, large):
    """Near a grazing a multiplier is large, and the others are as they were."""
    M, rng = np.zeros((4, 4)), np.random.default_rng(0)
    M[:2, :2], M[2, 2], M[3, 3] = plane, large, -0.2
    basis = np.linalg.qr(rng.normal(size=(4, 4)))[0] + 0.1 * rng.normal(size=(4, 4))
    M = basis @ M @ np.linalg.inv(basis)
    for sizes in ([1.0, 1, 1, 1, 1], [1.0, 1e6, 1, 1e-6, 1]):
        scaled = M * np.array(sizes)[1:, None] / np.array(sizes)[1:]
        step = SimpleNamespace(observed=SimpleNamespace(monodromy=scaled))
        assert is_defective(SimpleNamespace(sizes=sizes), step, 1.0) == defective
