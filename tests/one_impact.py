"""Motions of x'' + 2ξx' + x = F cos ωt with one impact on x = gap in n periods of the force, in
closed form, apart from the package: ξ of either sign."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm


class OneImpact(NamedTuple):
    """Both motions: the slower one first; complex where there is none."""

    speed: np.ndarray
    """Of approach."""
    trace: np.ndarray
    """Of the monodromy matrix, whose determinant is `determinant`."""
    determinant: float


def one_impact(frequency, force, *, damping, restitution, gap, cycles) -> OneImpact:
    """Between impacts w = (x, x') = h + p with the steady vibration p = Re P exp(iωt). A period T
    later h is what it was: h⁺ = E h⁺ + J, J = (0, -(1 + k)v), so that h⁺ = v g. With x = gap and
    x' = v before the impact, (gap - v g₁)² + (v (1 - g₂ - (1 + k))/ω)² = |P|²."""
    A = np.array([[0.0, 1.0], [-1.0, -2 * damping]])
    period = 2 * np.pi * cycles / frequency
    E, k = expm(A * period), restitution
    g = np.linalg.solve(np.eye(2) - E, [0.0, -(1 + k)])
    swing = force / abs(1 - frequency**2 + 2j * damping * frequency)
    rest = (1 - g[1] - (1 + k)) / frequency
    speed = np.roots([g[0] ** 2 + rest**2, -2 * gap * g[0], gap**2 - swing**2]).astype(complex)
    speed = np.sort_complex(speed)
    # P exp(iωt) at the impact, and with it the force and both accelerations.
    turned = (gap - speed * g[0]) - 1j * speed * rest
    pushed = turned * (1 - frequency**2 + 2j * damping * frequency)
    if np.isreal(speed).all():
        pushed = pushed.real
    before = pushed - gap - 2 * damping * speed
    after = pushed - gap + 2 * damping * k * speed
    # The saltation matrix of x' ← -k x' is [[-k, 0], [(after + k before)/v, -k]].
    trace = -k * np.trace(E) + (after + k * before) / speed * E[0, 1]
    return OneImpact(speed, trace, float(k**2 * np.linalg.det(E)))
