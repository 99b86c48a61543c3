"""Contents of a run, and representations as text."""

import pickle
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.flow._simulate import _by_cycle
from vi_jax.machine import by_name, unit_of

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


def test_a_log_in_intervals_has_the_first_entries_of_each_cycle():
    """With room for three entries, in cycles of four intervals."""
    log = np.full((8, 2, 3), np.nan)
    for interval, entries in {0: [1.0], 2: [2.0, 3.0, 4.0], 3: [5.0], 7: [6.0, 7.0]}.items():
        log[interval, :, : len(entries)] = entries
    (found, _) = _by_cycle(SimpleNamespace(cycles=2, parts=4), jnp.asarray(log), used=1)
    np.testing.assert_array_equal(found, [[1.0, 2.0, 3.0], [6.0, 7.0, np.nan]])


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


M = vi.machines
MACHINES = [
    vi.Scene.ideal(frequency_ratio=0.9, gap=1.25, damping_ratio=0.0625),
    vi.Parameters().scene(crank="slider"),
    M.UnbalancedRotor(gap=1.0), M.Woodpecker(), vi.SoftStop(1.5, stiffness=30.0), vi.Parameters(),
]  # fmt: skip


@pytest.mark.parametrize("thing", MACHINES, ids=lambda x: type(x).__name__)
def test_numbers_are_shown_with_their_units(thing):
    shown = [thing, thing.start()] if isinstance(thing, vi.AbstractMachine) else [thing]
    for x in shown:
        units = getattr(x, "units", {})
        text = repr(x)
        assert str(x) == text and text.startswith(f"{type(x).__name__}(") and "f64[" not in text
        for name, number in by_name(x).items():
            unit = unit_of(units, name)
            told = f"{float(number):.9g}{'' if unit in ('', '1') else ' ' + unit}"
            assert f"{name.split('.')[-1]}={told}" in text


def test_runs_and_exponents_have_text():
    run = vi.simulate(MACHINES[0], MACHINES[0].start(), 5)
    assert repr(run) == str(run) and f"V = {float(run.last.V):.9g} a ω" in repr(run)
    assert f"{float(run.y_max[-1]):.6g}] a" in repr(run)
    both = jax.tree.map(lambda x: jnp.stack([x, x]), run)
    assert repr(both) == "Run of 2 lanes (2,), 2 successful"
    rates = vi.Lyapunov(
        jnp.asarray([0.1, -0.3]), jnp.asarray([0.2, -0.6]), jnp.asarray(0.01), run.last,
        run.result, unit="ω",
    )  # fmt: skip
    assert "0.1, -0.3 ω" in repr(rates)
    more = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), rates)
    assert "lanes (2,), 2 successful; greatest: [0.1, 0.2] ω" in repr(more)


def test_reasons_print_their_names():
    def one(gap):
        scene = vi.Scene.ideal(frequency_ratio=0.9, gap=gap, damping_ratio=0.05)
        return vi.simulate(scene, scene.start(), 1).result

    found = jax.vmap(one)(jnp.asarray([1.0, -1.0]))
    assert str(found) == "RESULTS[successful, bad_start]"
    first = found[0]
    assert repr(first) == repr(vi.RESULTS.successful) == "RESULTS.successful"
    assert [vi.RESULTS[x] for x in found] == ["", vi.RESULTS[found[-1]]] != ["", ""]
    with pytest.raises(TypeError, match="must get one lane, but got 2"):
        vi.RESULTS[found]
    assert str(pickle.loads(pickle.dumps(first))) == "RESULTS.successful"
    np.testing.assert_array_equal(found == vi.RESULTS.bad_start, [False, True])
    many = jax.tree.map(lambda x: jnp.tile(x, (20, 1)), found)
    assert str(many) == "RESULTS[20 bad_start, 20 successful; shape (20, 2)]"
    chosen = jax.jit(lambda x: vi.RESULTS.where(x, vi.RESULTS.stalled, vi.RESULTS.chatter))
    assert str(chosen(True)) == "RESULTS.stalled" and "chatter" in vi.RESULTS[chosen(False)]
    told = []
    jax.jit(lambda x: told.append(str(x)) or x)(first)
    assert told == ["RESULTS<traced>"] and isinstance(first, vi.RESULTS)
    assert str(vi.STABILITY.fold) == "STABILITY.fold"
