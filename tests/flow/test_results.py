"""Contents of a run: samples, logs, counts and extremes."""

import numpy as np
import pytest
import vi_jax as vi

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)


@pytest.mark.parametrize("method", [vi.ExactFlight(), vi.Adaptive(rtol=1e-11)])
def test_samples_refine_the_sections(method):
    plain = vi.simulate(SCENE, SCENE.start(V=1.0), 6, method=method, impact_log=2)
    dense = vi.simulate(SCENE, SCENE.start(V=1.0), 6, method=method, impact_log=2, samples=50)
    samples = dense.samples
    assert samples.state.Y.shape == (301,) and dense.sections.Y.shape == (7,)
    np.testing.assert_allclose(samples.state.Y[::50], plain.sections.Y, atol=1e-8)
    np.testing.assert_allclose(samples.time, samples.cycles * 2 * np.pi / 0.9, rtol=1e-13)
    np.testing.assert_allclose(dense.y_max, plain.y_max, atol=1e-8)
    np.testing.assert_allclose(dense.y_min, plain.y_min, atol=1e-8)
    np.testing.assert_array_equal(dense.impacts, plain.impacts)
    np.testing.assert_allclose(dense.impact_log.phase, plain.impact_log.phase, atol=1e-8)
    np.testing.assert_allclose(dense.impact_speed, plain.impact_speed, atol=1e-8)
    speeds = np.asarray(plain.impact_log.speed)
    np.testing.assert_allclose(
        np.where(np.isnan(speeds), 0.0, speeds).max(axis=1), plain.impact_speed, atol=1e-12
    )


def test_sections_only():
    full = vi.simulate(SCENE, SCENE.start(), 9)
    lean = vi.simulate(SCENE, SCENE.start(), 9, record="sections")
    assert lean.y_max is None and lean.impact_speed is None and lean.frequency_ratio is None
    np.testing.assert_array_equal(lean.impacts, full.impacts)
    np.testing.assert_allclose(lean.sections.Y, full.sections.Y, atol=1e-7)
    assert int(lean.steps) < int(full.steps)


def test_impact_log_has_crank_angles_in_both_clocks():
    scene = vi.Scene.ideal(frequency_ratio=0.4, restitution=0.5, gap=0.8, damping_ratio=0.05)
    logs = [
        vi.simulate(scene, scene.start(), 3, clock=clock, impact_log=6).impact_log
        for clock in ("phase", "time")
    ]
    assert np.isfinite(logs[0].phase).sum() > 3
    np.testing.assert_allclose(logs[1].phase, logs[0].phase, atol=1e-9)
    assert np.nanmax(logs[1].phase) <= 2 * np.pi


@pytest.mark.parametrize(
    "method",
    [vi.ExactFlight(), vi.Adaptive(rtol=1e-11), vi.Taylor(20, 8)],
    ids=lambda method: type(method).__name__,
)
def test_turning_points_are_located_only_when_recorded(method):
    """Settling takes fewer steps than recording, and the recorded extremes are the same."""
    scene = vi.Scene.ideal(frequency_ratio=0.6, gap=None, damping_ratio=0.05)
    options = {"method": method, "record": "motion"}
    whole = vi.simulate(scene, scene.start(V=1.0), 24, **options)
    settled = vi.simulate(scene, scene.start(V=1.0), 4, settle=20, **options)
    assert int(settled.steps) < int(whole.steps)
    np.testing.assert_allclose(settled.y_max, whole.y_max[-4:], atol=1e-9)
    np.testing.assert_allclose(settled.y_min, whole.y_min[-4:], atol=1e-9)
