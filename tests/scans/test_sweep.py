"""Sweeps: the state carried from value to value, and the text about large changes."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.01)


def test_a_sweep_moves_the_body_with_an_approaching_stop():
    gaps = [2.0, 1.2, 0.5, -0.5, 0.5, 2.0]
    sweep = vi.sweep(SCENE, "stops.0.gap", gaps, settle=50, cycles=8)
    assert bool(sweep.successful.all())
    assert (np.asarray(sweep.y_max) <= np.array(gaps) + 1e-12).all()
    with pytest.raises(ValueError, match="beyond a stop"):
        vi.sweep(SCENE, "stops.0.gap", gaps, start=SCENE.start(Y=3.0))
    with pytest.raises(ValueError, match="in one row"):
        vi.sweep(SCENE, "stops.0.gap", [])


def _described(y_min, period, impacts, zeta=None):
    size = len(y_min)
    zeros = jnp.zeros(size)
    sweep = vi.Sweep(
        parameter="drive.control",
        values=1 + 0.1 * jnp.arange(size, dtype=float),
        y_min=jnp.array(y_min),
        y_max=zeros,
        period=jnp.array(period),
        impacts=jnp.array(impacts),
        frequency_ratio=None if zeta is None else jnp.array(zeta),
        impact_speed=zeros,
        impact_energy=zeros,
        sections=None,
        result=vi.RESULTS.successful,
        labels=SCENE.labels,
        periods=tuple(f"{2 * n}π" for n in range(1, 9)),
        units=tuple(SCENE.units.items()),
    )
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
