"""Branches of bouncing balls and impact pairs in closed form."""

import numpy as np
import pytest
import vi_jax as vi

PI = np.pi
BALL, PAIR = vi.machines.BouncingBall, vi.machines.ImpactPair


def sigma(e):
    return (1 - e) / (1 + e)


@pytest.fixture(scope="module")
def restitution():
    return 0.5


@pytest.fixture(scope="module")
def bounces(restitution):
    """The branch of one bounce a cycle, found from its closed form."""
    w, e = PI * sigma(restitution), restitution
    table = 1.3 * w
    # Impacts repeat at one phase: a flight of 2π needs the table's speed Γ sin s to be w.
    at = PI - np.arcsin(w / table)
    left, since = e * (PI + w), 2 * PI - at
    ball = BALL(acceleration=table, restitution=e)
    start = ball.start(
        height=left * since - since**2 / 2 + table * (1 - np.cos(at) + np.sin(at) * since),
        speed=left - since + table * np.sin(at),
    )
    orbit = vi.find_orbit(ball, start, throw=True)
    assert float(orbit.impact_speed[0]) == pytest.approx(PI + w, abs=1e-10)
    assert float(orbit.impact_phase[0]) == pytest.approx(at, abs=1e-10)
    return vi.continue_orbit(orbit, parameter="acceleration", bounds=(0.05, 2.0))


@pytest.mark.slow
def test_fold_and_period_doubling_of_a_bounce_match_closed_forms(bounces, restitution):
    e, born = restitution, PI * sigma(restitution)
    (fold,) = (p for p in bounces.special if p.kind == "fold")
    (doubling,) = (p for p in bounces.special if p.kind == "period-doubling")
    assert fold.parameter == pytest.approx(born, abs=1e-9)
    doubles = np.hypot(born, 2 * (1 + e**2) / (1 + e) ** 2)
    assert doubling.parameter == pytest.approx(doubles, abs=1e-9)
    assert doubles == pytest.approx(1.5268237005, abs=1e-10)


@pytest.fixture(scope="module")
def symmetric(restitution):
    """The branch of the symmetric motion, found from its closed form at λ = 2."""
    e, half = restitution, 2.0
    a, b, c = PI**2 / 4 + sigma(e) ** 2, -PI * half, half**2 - 1
    w = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
    pair = PAIR(half_gap=half, restitution=e)
    # The ball meets the left wall at sin s = λ - πw/2, and flies to the right at speed w.
    at = np.mod(np.arctan2(half - PI * w / 2, sigma(e) * w), 2 * PI)
    place, speed = -half + np.sin(at) + w * (2 * PI - at), w
    if at < PI:  # at the section the ball flies back
        place, speed = half - np.sin(at) - w * (PI - at), -w
    orbit = vi.find_orbit(pair, pair.at(place=place, v={"place": speed - 1}), throw=True)
    np.testing.assert_allclose(orbit.impact_speed, 2 * w / (1 + e), atol=1e-10)
    return vi.continue_orbit(orbit, parameter="half_gap", bounds=(1.05, 20.0))


@pytest.mark.slow
def test_fold_and_symmetry_breaking_of_an_impact_pair_match_closed_forms(symmetric, restitution):
    special = {p.kind: p.parameter for p in symmetric.special}
    s = sigma(restitution)
    assert special["fold"] == pytest.approx(np.sqrt(1 + PI**2 / (4 * s * s)), abs=1e-9)
    breaks = (PI / 2 - 2 / PI) / np.sqrt(4 / PI**2 + s * s)
    assert special["symmetry-breaking"] == pytest.approx(breaks, abs=1e-9)
    assert breaks == pytest.approx(1.2999827618, abs=1e-10)
