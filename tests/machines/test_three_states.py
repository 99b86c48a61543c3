"""A cycle of three states with a reset, beside matrix exponentials."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.linalg import expm
from scipy.optimize import fsolve

from resets import A, ThreeStates


def three(b):
    """A cycle of `ThreeStates` by the matrix exponential: after its reset, and its length."""

    def left(u):
        x = expm(A * u[2]) @ np.array([1.0, u[0], u[1]])
        v = A[0] @ x
        return [x[0] - 1, x[1] - b * v - u[0], x[2] - 1.6 * v - u[1]]

    return fsolve(left, [0.7955, 0.23435, 6.69907], xtol=1e-14)


@pytest.fixture(scope="module")
def cycle():
    return vi.find_orbit(ThreeStates(1.8), tuple(map(jnp.asarray, (1.0, 0.7955, 0.2343))))


@pytest.mark.slow
def test_a_cycle_of_three_states_is_that_of_matrix_exponentials(cycle):
    found = [cycle.state[1], cycle.state[2], cycle.duration]
    np.testing.assert_allclose(found, three(1.8), atol=1e-10)


@pytest.mark.slow
def test_such_a_cycle_is_born_at_a_fold(cycle):
    branch = vi.continue_orbit(cycle, parameter="b", bounds=(1.75, 1.95))
    (fold,) = branch.special
    assert fold.kind == "fold" and fold.parameter == pytest.approx(1.78192697901, abs=1e-10)
    # At a fold all but the parameter is known to the root of its error.
    assert float(fold.orbit.duration) == pytest.approx(5.846868672, abs=1e-6)
