"""Sliding bifurcations of a driven body with dry friction, from both sides, compared with SciPy.
`test_sliding_boundaries` has Den Hartog's closed form."""

import numpy as np
import pytest
from scipy.optimize import brentq

from rough_floor import SINCE, branch_of, on_both_sides, settled


def excess_force(omega, numbers, near):
    """Return the excess of the force over the friction level, where the body stops near a phase."""
    events = settled(omega, numbers["level"], numbers["second"], numbers["damping"])
    phase, Y, *_ = min(events, key=lambda e: abs((e[0] - SINCE) % (2 * np.pi) - near))
    force = np.cos(phase) + numbers["second"] * np.cos(2 * phase + 1) - Y
    return abs(force) - numbers["level"]


@pytest.mark.exhaustive
def test_a_slip_between_two_segments_of_sticking():
    """At phase 2π, where the drive is strongest, the force just reaches the friction level."""
    numbers = {"level": 0.5, "second": 0.0, "damping": 0.04}
    branch = branch_of("omega", (0.15, 0.7), omega=0.25, **numbers)
    point, last = branch.special
    assert branch.ends == ("adding-sliding", "crossing-sliding")
    assert last.kind == "crossing-sliding" and "floor is just held" in point.detail

    def excess(omega):
        """Return the excess of the force at phase 2π, on the body that stopped before."""
        events = settled(omega, **numbers)
        Y = [e[1] for e in events if e[3] == 0 and e[1] > 0]
        return 1.0 - Y[0] - 0.5 if Y[0] < 1 else Y[0] - 1.5

    truth = brentq(excess, point.parameter - 1e-5, point.parameter + 1e-5, xtol=1e-10)
    assert point.parameter == pytest.approx(truth, abs=1e-8)
    back = on_both_sides(point, "omega", (0.15, 0.2))
    assert back.kind == "adding-sliding" and "no longer" in back.detail
    assert back.parameter == pytest.approx(point.parameter, abs=1e-8)


@pytest.mark.slow
def test_the_first_of_several_changes_within_a_step():
    """A long step passes the point beyond which a turning body no longer sticks at once. It also
    passes a fold and a vanishing segment of solutions that are no motions."""
    omega, numbers = 0.2, {"level": 0.11102, "second": 0.9535, "damping": 0.1122}
    branch = branch_of("level", (0.01, 1.5), omega=omega, max_step=0.4, **numbers)
    point = branch.special[0]
    assert branch.ends[0] == point.kind == "switching-sliding"
    near = float(point.detail.split("clock ")[1].split()[0])
    # On this side friction holds the body, with a margin that falls linearly to zero.
    levels = point.parameter + np.array([1e-6, 2e-6])
    left = [excess_force(omega, {**numbers, "level": level}, near) for level in levels]
    assert max(left) < 0
    truth = levels[0] - left[0] * (levels[1] - levels[0]) / (left[1] - left[0])
    assert point.parameter == pytest.approx(truth, abs=1e-8)
