"""Sweeps: the state carried from value to value, and the text about large changes."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.scans import moved_by_stops

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.01)


def test_a_sweep_moves_the_body_with_an_approaching_stop():
    gaps = [2.0, 1.2, 0.5, -0.5, 0.5, 2.0]
    sweep = vi.sweep(SCENE, "stops.0.gap", gaps, settle=50, cycles=8)
    assert bool(sweep.successful.all())
    assert (np.asarray(sweep.y_max) <= np.array(gaps) + 1e-12).all()
    moved = moved_by_stops(SCENE, SCENE.start(Y=3.0, V=-0.7))
    assert (float(moved.Y), float(moved.V)) == (2.0, -0.7)
    with pytest.raises(ValueError, match="beyond a stop"):
        vi.sweep(SCENE, "stops.0.gap", gaps, start=SCENE.start(Y=3.0))
    with pytest.raises(ValueError, match="in one row"):
        vi.sweep(SCENE, "stops.0.gap", [])


@pytest.mark.slow
def test_a_sweep_stays_on_its_branch_wherever_the_section_is():
    """Two motions of two cycles exist, with one impact and with two. Just before an impact the stop
    overtakes the body, which approaches it; just after, the body leaves it."""
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)
    orbit = vi.find_orbit(scene, scene.start(Y=1.2827, V=1.0074), 2, throw=True)
    motion, speeds = vi.simulate(scene, orbit.state, 1, samples=500).samples, []
    for offset in (-1.0, -1e-4, 1e-4):
        phase = float(orbit.impact_phase[0] + offset) % (2 * np.pi)
        i = round(phase / (2 * np.pi) * 500)
        near = scene.start(Y=motion.state.Y[i], V=motion.state.V[i])
        moved = scene.at_section(phase)
        start = vi.find_orbit(moved, near, 2, throw=True).state
        options = {"start": start, "settle": 200, "cycles": 8, "progress": False}
        sweep = vi.sweep(moved, "stops.0.gap", [2.0, 1.994, 1.988], **options)
        assert sweep.impacts.tolist() == [1, 1, 1] and sweep.period.tolist() == [2, 2, 2]
        speeds.append(sweep.impact_speed)
    np.testing.assert_allclose(speeds, [speeds[0]] * 3, rtol=1e-9)


def _described(y_min, period, impacts, zeta=None):
    size = len(y_min)
    zeros = jnp.zeros(size)
    sweep = vi.Sweep(
        parameter="drive.control", values=1 + 0.1 * jnp.arange(size, dtype=float),
        y_min=jnp.array(y_min), y_max=zeros, period=jnp.array(period), impacts=jnp.array(impacts),
        frequency_ratio=None if zeta is None else jnp.array(zeta), impact_speed=zeros,
        impact_energy=zeros, sections=None, result=vi.RESULTS.successful, labels=SCENE.labels,
        periods=tuple(f"{2 * n}π" for n in range(1, 9)), units=tuple(SCENE.units.items()),
    )  # fmt: skip
    return str(sweep).splitlines()[1:]


def test_the_text_of_a_sweep_reports_large_changes():
    # The period is constant, but the motion jumps.
    lost = _described([-3.3, -3.4, -0.7, -0.68], [1] * 4, [1.0, 1.0, 0.0, 0.0], [1.0, 1, 1.3, 1.3])
    assert lost == [
        "  2π with 1 impact from 1",
        "  2π with 0 impacts from 1.2, large change since 1.1: min Y -3.4 → -0.7 a, ζ 1 → 1.3 ω",
    ]
    # A jump to another branch with the same period and impacts.
    other = _described([-1.0, -1.05, -1.1, -2.0, -2.04, -2.08], [2] * 6, [3.0] * 6)
    assert (
        other[1] == "  still 4π with 3 impacts from 1.3, large change since 1.2: min Y -1.1 → -2 a"
    )
    # Neither a steep steady change nor chaos is reported.
    assert len(_described([-1.0, -2.0, -3.0, -4.2], [1] * 4, [1.0] * 4)) == 1
    assert (
        len(_described([-1.0, -1.01, -2.3, -2.31, -1.2], [-2] * 5, [0.4, 0.5, 0.6, 0.3, 0.4])) == 1
    )
    failed = _described([-1.0, np.nan, -1.0], [1, -3, 1], [1.0, np.nan, 1.0])
    assert [line.split(" from ")[0].strip() for line in failed][1] == "failed: successful"
    many = _described([-1.0, -1.1] * 20, [1, 2] * 20, [1.0] * 40)
    assert len(many) == 13 and many[-1] == "  28 further changes"
