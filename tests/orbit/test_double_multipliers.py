"""Whether a double multiplier has two eigenvectors."""

from types import SimpleNamespace

import numpy as np
import pytest
from vi_jax.orbit._conditions import is_defective

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
