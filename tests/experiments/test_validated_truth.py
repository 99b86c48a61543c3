"""Recompute the numbers that the page of other codes' examples attributes to SciPy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve
from validated._comparison import last_digit

from gallery_page import rows, sections

pytestmark = pytest.mark.slow
CLOSE = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}


def published(script):
    """Return the other code's numbers by quantity; the first one for equal names."""
    return {row[0]: row[1] for row in reversed(rows(sections()[script]))}


def agree(printed, computed):
    assert abs(float(printed) - computed) <= 1.5 * last_digit(printed)


def crossing(function, direction):
    function.terminal, function.direction = True, direction
    return function


def test_balls_in_a_row():
    def rate(t, z):
        x, v = z[:10], z[10:]
        push = np.maximum(x[:-1] - x[1:], 0) ** 1.5
        return np.concatenate([v, -np.diff(push, prepend=0, append=0)])

    v = solve_ivp(rate, (0, 60), np.eye(20)[10], **CLOSE).y[10:, -1]
    known = published("siconos_chain")
    for name, i in (("the first", 0), ("the ninth", 8), ("the last", 9)):
        agree(known[f"by SciPy: {name}"], v[i])


def valve_cycle(flow_rate, y):
    """Integrate the valve between two maxima of its lift; return state, time and impacts."""

    def rate(t, y):
        falls = y[0] * np.sqrt(y[2])
        return [y[1], y[2] - 1.25 * y[1] - y[0] - 10, 20 * (flow_rate - falls)]

    greatest = crossing(lambda t, y: y[1], -1)
    seat = crossing(lambda t, y: y[0], -1)
    out = solve_ivp(rate, (0, 1e-3), y, **CLOSE)
    hits = 0
    while True:
        out = solve_ivp(rate, (out.t[-1], 50), out.y[:, -1], events=(greatest, seat), **CLOSE)
        if len(out.t_events[0]):
            return out.y[:, -1], out.t[-1], hits
        out.y[:2, -1] = 0.0, -0.8 * out.y[1, -1]
        hits += 1


@pytest.mark.parametrize(
    ("flow_rate", "guess", "hits", "lift"),
    [
        (3.0, (2.5, 1.53), 1, "greatest lift, q = 3, one impact a cycle"),
        (7.8, (7.39, 1.12), 0, "greatest lift, q = 7.8, no impact"),
    ],
)
def test_a_relief_valve(flow_rate, guess, hits, lift):
    def left(x):
        return valve_cycle(flow_rate, (x[0], 0, x[1]))[0][[0, 2]] - x

    x = fsolve(left, guess, xtol=1e-10)
    _, time, struck = valve_cycle(flow_rate, (x[0], 0, x[1]))
    assert struck == hits
    printed = rows(sections()["mpgos_valve"])
    known = {row[0]: row[1] for row in (printed[:3] if hits else printed[3:])}
    agree(known[lift], x[0])
    agree(known["time of a cycle"], time)
    if hits:
        agree(known["pressure there"], x[1])


def half_period(omega, z):
    """Integrate the two masses for half a period and reverse the sign."""

    def rate(t, z):
        x, y, u, v = z
        pull = 0.952**2 * (x - y) + 2 * 0.127 * (u - v) + 0.1 * (x - y) ** 3
        return [u, v, np.cos(omega * t) - x - 2 * 0.02 * u - 0.1 * x**3 - 0.05 * pull, pull]

    ends = [crossing(lambda t, z, s=s: s * (z[1] - z[0]) - 1, 1) for s in (1, -1)]
    t, z = 0.0, np.array(z)
    while t < np.pi / omega:
        out = solve_ivp(rate, (t, np.pi / omega), z, events=ends, **CLOSE)
        t, z = out.t[-1], out.y[:, -1]
        if t < np.pi / omega:
            mean = 1.9 * (z[2] + 0.05 * z[3]) / 1.05
            z[2:] = mean - 0.9 * z[2:]
    return -z


def multipliers_of_half_period(omega, z):
    """Return the multipliers by central differences."""
    steps = 1e-5 * np.eye(4)
    slopes = [(half_period(omega, z + e) - half_period(omega, z - e)) / 2e-5 for e in steps]
    return np.linalg.eigvals(np.transpose(slopes))


def test_stability_limits_of_the_two_masses():
    """At a fold a multiplier is 1; at a Neimark–Sacker point a pair has modulus 1."""
    *_, fold, _, first, second = [row[1] for row in rows(sections()["pwsdde_pair"])]

    def residual(x):
        det = np.prod(multipliers_of_half_period(x[4], x[:4]) - 1).real
        return [*(half_period(x[4], x[:4]) - x[:4]), det]

    near = [-1.80955, -2.78315, 0.18278, 2.18286, 1.29897]
    agree(fold, fsolve(residual, near, xtol=1e-11)[4])
    for printed, low, high, near in (
        (first, 1.9764, 1.9767, (-0.2794, -0.9533, 0.0951, -1.3286)),
        (second, 2.0948, 2.0951, (-0.2376, -0.8723, 0.0954, -1.3877)),
    ):

        def beyond(omega, near=near):
            z = fsolve(lambda z: half_period(omega, z) - z, near, xtol=1e-12)
            largest = multipliers_of_half_period(omega, z)
            assert abs(largest[np.argmax(np.abs(largest))].imag) > 0.01
            return np.abs(largest).max() - 1

        assert beyond(low) * beyond(high) < 0
        agree(printed, brentq(beyond, low, high, xtol=1e-11))


def test_two_masses():
    known, guess = published("pwsdde_pair"), np.array([-0.686, -1.514, 0.1256, -1.2246])

    def orbit(omega, guess):
        return fsolve(lambda z: half_period(omega, z) - z, guess, xtol=1e-12)

    z = orbit(1.5, guess)
    agree(known["x1 at phase 0, ω = 1.5"], z[0])
    agree(known["x2"], z[1])
    for omega in (1.47, 1.45):
        z = orbit(omega, z)

    def above(omega):
        """Return a number that is zero at the symmetry breaking (multiplier -1)."""
        return multipliers_of_half_period(omega, orbit(omega, z)).real.min() + 1

    # Central differences have an error of 1e-9.
    agree(known["ω of the symmetry-breaking"], brentq(above, 1.438, 1.441, xtol=1e-11))
