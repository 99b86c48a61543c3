"""Linear algebra of small matrices agrees with NumPy's LAPACK; double multipliers."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax.orbit.conditions import is_defective
from vi_jax.orbit.linear import solve, svd


@pytest.mark.parametrize("n", [1, 2, 5])
def test_singular_vectors_of_regular_and_singular_matrices(n):
    draw, decompose = np.random.default_rng(n), jax.jit(svd)
    for rank in {n, max(n - 1, 1), 1}:
        rows = draw.normal(size=(n, rank)) * 10.0 ** draw.uniform(-3, 3, (n, 1))
        matrix = rows @ draw.normal(size=(rank, n))
        left, values, right = map(np.asarray, decompose(matrix))
        exact = np.linalg.svd(matrix)[1]
        np.testing.assert_allclose(values, exact, atol=1e-14 * exact[0])
        np.testing.assert_allclose(left * values @ right, matrix, atol=1e-14 * exact[0])
        for vectors in (left, right):
            np.testing.assert_allclose(vectors @ vectors.T, np.eye(n), atol=1e-14)
    assert all(np.isnan(decompose(np.full((n, n), np.nan))[1]))


def test_solutions_and_their_derivatives():
    draw = np.random.default_rng(0)
    matrices, right_side = draw.normal(size=(2, 3, 3)), draw.normal(size=3)
    norm = lambda solver: lambda matrix: jnp.sum(solver(matrix, right_side) ** 2)
    for transform in (lambda f: f, jax.hessian):
        ours, theirs = (
            jax.vmap(transform(norm(solver)))(matrices) for solver in (solve, jnp.linalg.solve)
        )
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)


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
