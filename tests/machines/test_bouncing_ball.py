"""The branch of a ball that bounces once a cycle, in closed form."""

import numpy as np
import pytest
import vi_jax as vi


@pytest.mark.slow
def test_fold_and_period_doubling_of_a_bounce_match_closed_forms():
    e = 0.5
    w = np.pi * (1 - e) / (1 + e)
    table = 1.3 * w
    # Impacts repeat at one phase: a flight of 2π needs the table's speed Γ sin s to be w.
    at = np.pi - np.arcsin(w / table)
    left, since = e * (np.pi + w), 2 * np.pi - at
    ball = vi.machines.BouncingBall(acceleration=table, restitution=e)
    start = ball.start(
        height=left * since - since**2 / 2 + table * (1 - np.cos(at) + np.sin(at) * since),
        speed=left - since + table * np.sin(at),
    )
    orbit = vi.find_orbit(ball, start, throw=True)
    assert float(orbit.impact_speed[0]) == pytest.approx(np.pi + w, abs=1e-10)
    assert float(orbit.impact_phase[0]) == pytest.approx(at, abs=1e-10)
    branch = vi.continue_orbit(orbit, parameter="acceleration", bounds=(0.05, 2.0))
    (fold,) = (p for p in branch.special if p.kind == "fold")
    (doubling,) = (p for p in branch.special if p.kind == "period-doubling")
    assert fold.parameter == pytest.approx(w, abs=1e-9)
    doubles = np.hypot(w, 2 * (1 + e**2) / (1 + e) ** 2)
    assert doubling.parameter == pytest.approx(doubles, abs=1e-9)
    assert doubles == pytest.approx(1.5268237005, abs=1e-10)
