"""Scans against single runs; blocks, stores, devices, clusters; what is said of what goes wrong."""

import importlib
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
import xarray as xr
from vi_jax.scan.regime import least_period
from vi_jax.scan.store import ZarrStore

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.01)
AXES = {
    "drive.frequency_ratio": np.linspace(0.6, 1.4, 7),
    "start.Y": np.linspace(-1.0, 1.0, 5),
}
SCRIPT = Path(__file__).with_name("long_scan.py")


@pytest.fixture(scope="module")
def data():
    measure = ("extremes", "regime", "frequency_ratio", "power", "impact_rate", "sections", "steps")
    return vi.scan(SCENE, AXES, measure=measure, settle=100, cycles=130)


def test_every_lane_is_a_run(data):
    assert data.sizes["drive.frequency_ratio"] == 7 and data.sizes["start.Y"] == 5
    for i, j in [(0, 0), (3, 2), (6, 4)]:
        zeta, Y = AXES["drive.frequency_ratio"][i], AXES["start.Y"][j]
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=0.5, gap=2.0, damping_ratio=0.01)
        run = vi.simulate(scene, scene.start(Y=Y), 130, settle=100, method=vi.ExactFlight())
        lane = data.isel({"drive.frequency_ratio": i, "start.Y": j})
        assert float(lane.y_min) == pytest.approx(float(run.y_min.min()), abs=1e-9)
        assert float(lane.y_max) == pytest.approx(float(run.y_max.max()), abs=1e-9)
        assert float(lane.impact_speed) == pytest.approx(float(run.impact_speed.max()), abs=1e-9)
        assert float(lane.impact_rate) == pytest.approx(float(run.impacts.mean()), abs=1e-12)
        assert float(lane.frequency_ratio) == pytest.approx(zeta, rel=1e-12)
        np.testing.assert_allclose(lane.Y, run.sections.Y[-16:], atol=1e-9)
        assert int(lane.steps) == int(run.steps)


def test_power_is_what_the_impacts_take():
    orbit = vi.closed_form_orbits(SCENE, cycles=1)
    start = SCENE.start(Y=orbit.Y[0], V=orbit.V[0])
    scene = SCENE
    found = vi.scan(
        scene, {"stops.0.restitution": [0.5]}, start=start, measure="power", settle=0, cycles=40
    )
    expected = 0.5 * (1 - 0.25) * float(orbit.impact_speed[0]) ** 2 * 0.9 / (2 * np.pi)
    assert float(found.power[0]) == pytest.approx(expected, rel=1e-6)


def test_labels_units_and_origin(data):
    assert data.y_min.attrs["units"] == "a" and "long_name" in data.period.attrs
    assert data["drive.frequency_ratio"].attrs["units"] == "ω"
    assert "ExactFlight" in data.attrs["method"] and data.attrs["settle"] == 100
    assert set(data.Y.dims) == {"drive.frequency_ratio", "start.Y", "cycle"}
    assert data.result.attrs["flag_meanings"].split()[1] == "successful"


def _regimes_of(lanes, settle):
    zeta, k, xi = np.array(lanes).T
    axes = {
        "drive.frequency_ratio": zeta,
        "stops.0.restitution": k,
        "oscillator.damping_ratio": xi,
    }
    return vi.scan(SCENE, axes, measure="regime", settle=settle, paired=True)


def test_regime_tells_periods_chaos_and_what_does_not_settle():
    zetas = [0.65, 0.7, 0.9, 0.97, 1.1, 1.4]
    data = _regimes_of([(zeta, 0.8, 0.0) for zeta in zetas], settle=3000)
    period = dict(zip(zetas, np.asarray(data.period).tolist(), strict=True))
    assert period[0.9] == 2 and period[1.1] == 1
    assert period[0.7] == period[0.97] == vi.REGIMES.chaotic
    # A free motion without damping, off resonance, has two frequencies and repeats never.
    free = vi.Scene.ideal(frequency_ratio=0.77, gap=None)
    quiet = vi.scan(free, {"start.Y": [0.3]}, measure="regime", settle=10)
    assert int(quiet.period[0]) == vi.REGIMES.unsettled


def test_a_chaotic_transient_is_not_called_chaos():
    """Off the stop the motion is linear and fades at the rate ξ: nothing grows any more."""
    lanes = [(0.69, 0.7, 0.001), (0.69, 0.5, 0.003), (0.7, 0.8, 0.0), (0.97, 0.8, 0.0)]
    data = _regimes_of(lanes, settle=22)
    assert np.asarray(data.period).tolist() == [-4, -4, -1, -1]
    assert dict(
        zip(
            data.period.attrs["flag_meanings"].split(),
            data.period.attrs["flag_values"],
            strict=True,
        )
    ) == {x.name: int(x) for x in vi.REGIMES}

    @jax.jit
    @jax.vmap
    def looked_at(zeta, k, xi):
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, damping_ratio=xi)
        first = vi.lyapunov(scene, scene.start(), 256, settle=150, number=1).exponents[0]
        # Rounding says when the chaos ends; from then on the motion fades by 0.9 % a cycle.
        return first, vi.simulate(scene, scene.start(), 64, settle=12_000)

    first, run = looked_at(*np.array(lanes).T)
    assert (first > 5e-3).all()
    assert (np.asarray(run.impacts.sum(axis=1)) == 0).tolist() == [True, True, False, False]
    for (zeta, _, xi), Y in zip(lanes[:2], run.last.Y, strict=False):
        steady = (1 / (1 - zeta**2 + 2j * xi * zeta)).real
        assert float(Y) == pytest.approx(steady, abs=1e-9)


@pytest.mark.slow
def test_few_of_the_chaotic_lanes_are_transients():
    """Of 48 × 48 lanes from rest without damping, those called chaotic, much later."""

    def machine(zeta, k):
        return vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=2.0)

    axes = {"zeta": np.linspace(0.5, 0.705, 48), "k": np.linspace(0.05, 0.95, 48)}
    wrong, error = {}, {}
    later = vi.scan(machine, axes, measure=vi.Regime(lasting=0), settle=12_000)
    for lasting in (0, 4000):
        found = vi.scan(machine, axes, measure=vi.Regime(lasting=lasting), settle=400)
        chaotic = np.asarray(found.period) == vi.REGIMES.chaotic
        share = wrong[lasting] = float(np.mean(np.asarray(later.period)[chaotic] != -1))
        error[lasting] = np.sqrt(share * (1 - share) / chaotic.sum())
    # Seen: 20 % of 1,392 lanes, and 9 % of 1,178.
    assert wrong[0] - wrong[4000] > 3 * np.hypot(error[0], error[4000]), (wrong, error)
    assert wrong[4000] < 0.087 + 4 * error[4000], (wrong, error)


def test_blocks_do_not_change_numbers(data):
    same = vi.scan(SCENE, AXES, measure=("extremes", "regime"), settle=100, cycles=130, workers=3)
    xr.testing.assert_equal(same.y_min, data.y_min)
    rows = {
        "drive.frequency_ratio": np.repeat(AXES["drive.frequency_ratio"], 200),
        "start.Y": np.tile(np.linspace(-1, 1, 200), 7),
    }
    pair = vi.scan(SCENE, rows, measure="extremes", settle=20, paired=True, lanes=256)
    grid = vi.scan(
        SCENE, {**AXES, "start.Y": np.linspace(-1, 1, 200)}, measure="extremes", settle=20
    )
    assert pair.y_min.dims == ("sample",)
    np.testing.assert_array_equal(np.asarray(pair.y_min), np.asarray(grid.y_min).ravel())


def test_paired_lanes_are_checked_one_by_one():
    """No product of the rows: the least gap on one side stands beside a wide one on the other."""
    scene = vi.Scene(
        oscillator=vi.Oscillator(0.05),
        drive=vi.IdealDrive(0.9),
        stops=(vi.RigidStop(2.0, 0.5), vi.RigidStop(2.0, 0.5, side="left")),
    )
    rows = {"stops.0.gap": [-0.5, 1.0, 2.0], "stops.1.gap": [2.0, 1.0, -0.5]}
    start = {"start.Y": [-1.0, 0.0, 1.0]}
    options = {"measure": "extremes", "settle": 5, "cycles": 4, "paired": True}
    data = vi.scan(scene, {**rows, **start}, **options)
    assert np.asarray(data.result).tolist() == [0, 0, 0]
    assert (data.y_max <= np.array(rows["stops.0.gap"]) + 1e-12).all()
    for bad in ([-0.5, -1.0, 2.0], [-0.5, 1.0, np.nextafter(0.5, 0)]):
        with pytest.raises(ValueError, match="must leave room"):
            vi.scan(scene, {**rows, "stops.0.gap": bad, **start}, **options)


def test_other_numbers_compile_nothing(data):
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: compiled.append(name) if "backend_compile" in name else None
    )
    axes = {name: row[:-1] + 0.01 for name, row in AXES.items()}
    scene = vi.Scene.ideal(frequency_ratio=0.8, restitution=0.7, gap=1.5, damping_ratio=0.02)
    measure = ("extremes", "regime", "frequency_ratio", "power", "impact_rate", "sections", "steps")
    vi.scan(scene, axes, measure=measure, settle=77, cycles=130)
    assert not compiled


def test_own_measures_scenes_and_starts():
    def span(scene, run):
        return {"span": run.y_max[-1] - run.y_min[-1], "last": run.sections.Y[-3:]}

    def machine(kappa, torque):
        return vi.Parameters(torque=torque, control=kappa, gap=0.08).scene(drive="motor")

    data = vi.scan(
        machine, {"kappa": [0.8, 0.9], "torque": [10.0, 100.0], "start.Y": [0.0, 1.0]},
        measure=(span, "frequency_ratio"), settle=20, cycles=20,
    )  # fmt: skip
    assert data.span.shape == (2, 2, 2) and data.last.shape == (2, 2, 2, 3)
    scene = machine(0.9, 100.0)
    run = vi.simulate(scene, scene.start(Y=1.0), 20, settle=20, method=vi.FixedStep())
    lane = data.sel({"kappa": 0.9, "torque": 100.0, "start.Y": 1.0})
    np.testing.assert_allclose(lane["last"], run.sections.Y[-3:], atol=1e-9)
    speed = 2 * np.pi * 20 / float(run.duration.sum())
    assert float(lane.frequency_ratio) == pytest.approx(speed, rel=1e-9)


def test_derivatives_are_those_of_a_run():
    names = ("drive.frequency_ratio", "start.V", "stops.0.gap")
    data = vi.scan(
        SCENE, {"start.Y": [0.1, 0.4]}, measure="extremes", settle=5, cycles=1, derivatives=names
    )

    def y_min(zeta, V, gap):
        scene = vi.Scene.ideal(frequency_ratio=zeta, gap=gap, damping_ratio=0.01)
        start = scene.start(Y=0.4, V=V)
        return vi.simulate(scene, start, 1, settle=5, method=vi.ExactFlight()).y_min[0]

    numbers = np.array([0.9, 0.0, 2.0])
    for i, found in enumerate(np.asarray(data.d_y_min[1])):
        step = np.zeros(3)
        step[i] = 1e-6
        slope = (y_min(*(numbers + step)) - y_min(*(numbers - step))) / 2e-6
        assert found == pytest.approx(float(slope), rel=1e-5, abs=1e-7)


def test_failing_lanes_are_counted_and_harm_no_other():
    Y = [0.0, 5.0, 0.5]
    with pytest.warns(UserWarning, match=r"1 of 3 lanes failed \(bad_start: 1\)"):
        data = vi.scan(SCENE, {"start.Y": Y}, settle=10, cycles=128)
    assert np.asarray(data.result).tolist() == [0, 1, 0]
    assert np.isnan(data.y_min[1]) and int(data.period[1]) == vi.REGIMES.failed
    good = vi.scan(SCENE, {"start.Y": [0.0, 0.5]}, settle=10, cycles=128)
    np.testing.assert_array_equal(data.y_min[[0, 2]], good.y_min)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"axes": {"drive.freqency_ratio": [1.0]}}, "near names: drive.frequency_ratio"),
        ({"axes": {"start.W": [1.0]}}, "`axes` must be a number of the machine"),
        ({"axes": {"drive.frequency_ratio": [1.0, np.nan]}}, "finite"),
        ({"axes": {"stops.0.restitution": [0.5, 1.5]}}, r"`restitution`.*\[0, 1\]"),
        ({"axes": {}}, "`axes` must map"),
        ({"measure": "extreme"}, "near names: extremes"),
        ({"measure": ()}, "at least one"),
        ({"cycles": 12}, "at least 128 for the measure Regime"),
        ({"derivatives": ["stops.1.gap"]}, "near names: stops.0.gap"),
        ({"store": "/dev/null/x"}, "`store` must be a path"),
        ({"devices": 99}, "`devices` must be at most"),
        ({"paired": True}, "rows of one length"),
    ],
)
def test_what_cannot_be_run_is_said_before_any_work(change, message):
    arguments = {"axes": AXES, **change}
    with pytest.raises((ValueError, TypeError), match=message):
        vi.scan(SCENE, **arguments)


def test_a_store_is_resumed_and_guards_itself(tmp_path, monkeypatch):
    work = importlib.import_module("vi_jax.scan._work")
    axes = {"drive.frequency_ratio": np.linspace(0.6, 1.4, 40), "start.Y": np.linspace(-1, 1, 30)}
    options = {"settle": 20, "cycles": 128, "lanes": 256, "workers": 1}
    whole = vi.scan(SCENE, axes, **options)
    path = tmp_path / "new" / "store.zarr"
    done = []
    compute = work.compute

    def interrupted(*arguments):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(1)
        return compute(*arguments)

    monkeypatch.setattr(work, "compute", interrupted)
    with pytest.raises(KeyboardInterrupt):
        vi.scan(SCENE, axes, store=path, **options)
    half = xr.open_zarr(path, consolidated=False, chunks=None, mask_and_scale=False)
    assert 0 < int((half.result == 0).sum()) < half.result.size
    counted = []
    monkeypatch.setattr(work, "compute", lambda *a: counted.append(1) or compute(*a))
    rest = vi.scan(SCENE, axes, store=path, **options)
    assert len(counted) == 5 - len(done)
    for name in whole.data_vars:
        np.testing.assert_array_equal(rest[name].values, whole[name].values)
    with pytest.raises(ValueError, match="settle is 20, and now it is 21"):
        vi.scan(SCENE, axes, store=path, **{**options, "settle": 21})
    with pytest.raises(ValueError, match=r"axis start.Y is .*, and now it is"):
        vi.scan(SCENE, {**axes, "start.Y": np.linspace(-1, 1.1, 30)}, store=path, **options)
    other = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.1, damping_ratio=0.01)
    with pytest.raises(ValueError, match=r"machine stops\.0\.gap is 2\.0, and now it is 2\.1"):
        vi.scan(other, axes, store=path, **options)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("mine")
    with pytest.raises(ValueError, match="neither"):
        vi.scan(SCENE, axes, store=tmp_path / "full", **options)


def test_a_store_knows_functions_by_what_they_make(tmp_path):
    def maker(gap, factor):
        def machine(zeta):
            return vi.Scene.ideal(frequency_ratio=zeta, gap=gap, damping_ratio=0.02)

        def measure(scene, run):
            return {"depth": factor * run.y_min[-1]}

        return machine, measure

    def run(gap, factor, **options):
        machine, measure = maker(gap, factor)
        axes = {"zeta": [0.8, 1.2]}
        store = tmp_path / "s"
        return vi.scan(machine, axes, measure=measure, settle=5, cycles=4, store=store, **options)

    first = run(2.0, 1.0)
    np.testing.assert_array_equal(run(2.0, 1.0).depth, first.depth)
    with pytest.raises(ValueError, match=r"first stops\.0\.gap is 2\.0, and now it is 1\.5"):
        run(1.5, 1.0)
    with pytest.raises(ValueError, match=r"code of measure 1 is \w+, and now it is"):
        run(2.0, 3.0)
    with pytest.raises(ValueError, match="paired is False, and now it is True"):
        run(2.0, 1.0, paired=True)


def test_a_sweep_takes_the_body_along_with_a_stop_that_comes_nearer():
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
        sections=None,
        result=vi.RESULTS.successful,
        labels=SCENE.labels,
        units=tuple(SCENE.units.items()),
    )
    return str(sweep).splitlines()[1:]


def test_a_sweep_tells_what_happens_to_the_motion():
    # The period stays, and all else changes.
    lost = _described([-3.3, -3.4, -0.7, -0.68], [1] * 4, [1.0, 1.0, 0.0, 0.0], [1.0, 1, 1.3, 1.3])
    assert lost == [
        "  2π with 1 impact from 1",
        "  2π with 0 impacts from 1.2, jump since 1.1: min Y -3.4 → -0.7 a, ζ 1 → 1.3 ω",
    ]
    # A motion of the same kind on another branch.
    other = _described([-1.0, -1.05, -1.1, -2.0, -2.04, -2.08], [2] * 6, [3.0] * 6)
    assert other[1] == "  still 4π with 3 impacts from 1.3, jump since 1.2: min Y -1.1 → -2 a"
    # What goes on steadily, however steep, is none; nor is what chaos does from value to value.
    assert len(_described([-1.0, -2.0, -3.0, -4.2], [1] * 4, [1.0] * 4)) == 1
    assert (
        len(_described([-1.0, -1.01, -2.3, -2.31, -1.2], [-2] * 5, [0.4, 0.5, 0.6, 0.3, 0.4])) == 1
    )
    failed = _described([-1.0, np.nan, -1.0], [1, -3, 1], [1.0, np.nan, 1.0])
    assert [line.split(" from ")[0].strip() for line in failed][1] == "failed"
    many = _described([-1.0, -1.1] * 20, [1, 2] * 20, [1.0] * 40)
    assert len(many) == 13 and many[-1] == "  28 further changes"


@pytest.mark.slow
def test_a_weak_motor_that_comes_off_the_stop_is_told():
    motor = vi.Parameters(torque=2.0, restitution=0.5, gap=0.08, control=1.45).scene(drive="motor")
    sweep = vi.sweep(motor, "drive.control", [1.45, 1.5, 1.55, 1.6], start=motor.start(W=1.2))
    _, before, after = str(sweep).splitlines()
    assert before == "  2π with 1 impact from 1.45"
    assert after.startswith("  2π with 0 impacts from 1.55, jump since 1.5: min Y -3.47")
    # Off the stop it is driven vibration, of the amplitude of the speed told (to the motor's hum).
    zeta, xi = float(sweep.frequency_ratio[2]), float(motor.damping_ratio)
    amplitude = 1 / abs(1 - zeta**2 + 2j * xi * zeta)
    assert float(sweep.y_min[2]) == pytest.approx(-amplitude, rel=0.02)


def test_windows_of_periods_beside_a_grazing():
    """Beyond the grazing of a motion whose multiplier is 1/2 there are windows of longer and longer
    periods with one impact, with chaos between (Chin, Ott, Nusse and Grebogi, Phys. Rev. E 50,
    1994); the sections of a period differ by 1e-4 to 1e-6."""
    xi, ratio = 5.05, 0.2 * np.pi / np.log(2)
    amplitude = 1 / np.hypot(1 - ratio**2, 2 * xi * ratio)
    scene = vi.Scene.ideal(frequency_ratio=ratio, restitution=0.8, damping_ratio=xi)
    beyond = {7.1e-7: 8, 4.0e-6: 7, 1.5e-5: 6, 3.5e-5: vi.REGIMES.chaotic, 8.4e-5: 5}
    gaps = amplitude / (1 + np.array([*beyond])[::-1])
    data = vi.scan(scene, {"stops.0.gap": gaps}, measure=vi.Regime(lasting=0), settle=400)
    assert data["period"].values[::-1].tolist() == [*beyond.values()]
    periodic = data["period"] > 0
    np.testing.assert_array_equal(data["impacts"].values[periodic], 1)
    # The same seen value by value; short of the grazing it is the driven vibration.
    values = [gaps[0], amplitude / (1 - 1e-5)]
    assert vi.sweep(scene, "stops.0.gap", values, settle=400).period.tolist() == [5, 1]


def test_what_repeats_and_what_spirals_in():
    """Sections made by hand: how closely periods must fit, by what fits best and by the method."""
    n, one = jnp.arange(256), jnp.ones(256, int)

    judged = jax.jit(partial(least_period, longest=64))

    def period(sections, impacts=one, wander=0.0, **options):
        return int(judged({"Y": sections}, impacts, wander=wander, **options))

    none, split = vi.REGIMES.unsettled, 1e-7 * (-1.0) ** n
    spiral = 3e-5 * 0.999**n * jnp.cos(2 * jnp.pi * n / 7)
    noise = 1e-7 * jax.random.normal(jax.random.key(0), (256,))
    assert period(0.0 * n) == 1 and period(split) == 2
    assert period(0.0 * n, impacts=n % 3) == 3
    assert period(spiral) == 1
    assert period(0.0 * n, impacts=jnp.where(n == 200, 2, 1)) == none
    assert period(1e-4 * jnp.cos(n)) == none and period(noise) == 1 and period(100 * noise) == none
    # Steps of a tolerance wander within it, which hides a split as small.
    assert period(100 * noise, wander=1e-5) == 1 and period(split, wander=1e-8) == 1
    assert period(noise, tolerance=1e-8) == none


@pytest.mark.slow
def test_some_lanes_are_verified_by_a_better_method():
    """Under steps of a loose tolerance sections do not repeat closely: the regimes are told wrongly
    where that is asked for."""
    axes = {"drive.frequency_ratio": np.linspace(1.0, 1.4, 6), "start.Y": [0.0, 0.5]}
    measure = ("extremes", vi.Regime(longest=4, observed=8, threshold=1.0, tolerance=1e-6))
    method = vi.Adaptive(diffrax.Bosh3(), rtol=1e-3)
    data = vi.scan(SCENE, axes, measure=measure, method=method, settle=200, verify=10)
    assert data.attrs["verified_lanes"] == 10
    assert data.attrs["verified_changed_period"] > 5
    assert data.attrs["verified_changed_result"] == 0
    assert 1e-6 < data.attrs["verified_error_y_min"] < 1e-1


def test_a_store_is_made_whole_or_not_at_all(tmp_path, monkeypatch):
    store = importlib.import_module("vi_jax.scan.store")
    create = store.zarr.Group.create_array

    def interrupted(group, name, **options):
        if name == "y_min":
            raise KeyboardInterrupt
        return create(group, name, **options)

    def run():
        return vi.scan(SCENE, {"start.Y": [0.0, 0.1]}, settle=5, store=tmp_path / "store")

    with monkeypatch.context() as patched:
        patched.setattr(store.zarr.Group, "create_array", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run()
    assert not list(tmp_path.iterdir())
    assert bool((run().result == 0).all())
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


def test_an_interrupted_scan_in_memory_gives_what_it_has(monkeypatch):
    work = importlib.import_module("vi_jax.scan._work")
    done = []
    compute = work.compute

    def interrupted(*arguments):
        if done:
            raise KeyboardInterrupt
        done.append(1)
        return compute(*arguments)

    monkeypatch.setattr(work, "compute", interrupted)
    with pytest.raises(vi.ScanInterrupted) as caught:
        vi.scan(SCENE, {"start.Y": np.linspace(-1, 1, 600)}, settle=5, lanes=256, workers=1)
    codes = np.asarray(caught.value.data.result)
    assert (codes == 0).sum() == 256 and (codes == -1).sum() == 344


def _run(path, *options, **environment):
    command = [sys.executable, str(SCRIPT), str(path), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, **environment)


def _stored(path):
    data = xr.open_zarr(path, consolidated=False, chunks=None, mask_and_scale=False)
    return {name: data[name].values for name in data.data_vars}


def _finished(path, *options, **environment):
    process = _run(path, *options, stderr=subprocess.STDOUT, **environment)
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0, out
    return _stored(path)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The numbers of the scan, and how long it takes once its programs are compiled."""
    folder = tmp_path_factory.mktemp("scan")
    kept = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder / "programs")}
    process = _under_way(folder / "whole", env=kept)
    begin = time.perf_counter()
    assert process.stdout.readline() == "ends\n"
    lasts = time.perf_counter() - begin
    assert process.wait() == 0
    return _stored(folder / "whole"), lasts, kept


@pytest.fixture
def whole(undisturbed):
    return undisturbed[0]


def _under_way(path, **environment):
    process = _run(path, **environment)
    assert process.stdout.readline() == "begins\n"
    return process


def _same(found, whole):
    for name, numbers in whole.items():
        np.testing.assert_array_equal(found[name], numbers)


@pytest.mark.slow
def test_killed_again_and_again_the_store_ends_the_same(tmp_path, undisturbed):
    """Every run goes on with what the killed ones left, and is killed itself until one ends."""
    whole, lasts, kept = undisturbed
    rng = np.random.default_rng(3)
    killed, parts, path = 0, set(), tmp_path / "store"
    for tries in range(40):
        process = _under_way(path, env=kept)
        try:
            process.wait(timeout=0.5 * lasts * rng.uniform())
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            killed += process.wait() == -signal.SIGKILL
        if process.wait() == 0:
            _same(_stored(path), whole)
            if killed >= 5 and len(parts) >= 3:
                break
            path = tmp_path / f"store{tries}"
        elif path.exists():
            done = (_stored(path)["result"] != -1).sum()
            parts |= {done} - {0, whole["result"].size}
    assert killed >= 5 and len(parts) >= 3, (killed, parts)


@pytest.mark.slow
def test_any_number_of_devices_gives_the_same_numbers(tmp_path, whole):
    for n in ("2", "4"):
        _same(_finished(tmp_path / n, "--devices", n), whole)


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_gives_the_same(tmp_path, whole):
    _same(_finished(tmp_path / "cluster", "--cluster"), whole)


@pytest.mark.slow
def test_a_cluster_that_loses_its_scheduler_says_how_to_go_on(tmp_path, monkeypatch):
    distributed = pytest.importorskip("dask.distributed")
    known, store = tmp_path / "scheduler.json", tmp_path / "store"
    parts = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", *words, "--scheduler-file", str(known)],
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        for words in (
            ("scheduler", "--port", "0", "--no-dashboard"),
            ("worker", "--nthreads", "1", "--no-nanny", "--no-dashboard"),
        )
    ]
    scene = vi.Scene.ideal(frequency_ratio=0.9)
    axes = {"start.Y": np.linspace(-1.0, 1.0, 3000)}
    options: dict = {"measure": "extremes", "settle": 500, "cycles": 50, "lanes": 256}
    write = ZarrStore.write

    def written(self, where, numbers):
        write(self, where, numbers)
        parts[0].kill()

    try:
        client = distributed.Client(scheduler_file=str(known), timeout=60)
        client.wait_for_workers(1, timeout=60)
        with monkeypatch.context() as patched:
            patched.setattr(ZarrStore, "write", written)
            told = r"scheduler .* was lost. (\d+) of 12 blocks .* kept in .*store: the same call"
            with pytest.raises(ConnectionError, match=told) as lost:
                vi.scan(scene, axes, **options, cluster=client, store=store)
        done = int(re.search(told, str(lost.value))[1])
        assert 1 <= done < 12
        assert (_stored(store)["result"] != -1).sum() in (256 * done, 256 * done - 72)
        with pytest.raises(ConnectionError, match="Nothing is kept: give the scan a `store`"):
            vi.scan(scene, axes, **options, cluster=client)
        client.close(timeout=1)
    finally:
        for part in parts:
            part.kill()
            part.wait()
    found = vi.scan(scene, axes, **options, store=store)  # goes on
    np.testing.assert_array_equal(found["y_max"], vi.scan(scene, axes, **options)["y_max"])


def test_scenes_made_by_a_function_move_as_they_would_alone():
    """By the same default method, and at rest on the stop where they can be."""

    def machine(gap):
        return vi.Scene.ideal(frequency_ratio=0.5, gap=gap, restitution=0.3)

    gaps = [0.2, 0.7, 1.5]
    data = vi.scan(machine, {"gap": gaps}, measure=["extremes", "steps"], settle=20, cycles=8)
    for i, gap in enumerate(gaps):
        scene = machine(gap)
        run = vi.simulate(scene, scene.start(), 8, settle=20, method=vi.ExactFlight(), rests=True)
        assert int(data.steps[i]) == int(run.steps)
        assert float(data.y_min[i]) == pytest.approx(float(run.y_min.min()), abs=1e-12)
        assert (int(run.rests.sum()) > 0) == (gap < 0.5)


def test_only_what_measures_ask_for_is_met():
    scene = vi.Scene.ideal(frequency_ratio=0.9, gap=2.0, restitution=0.5)
    axes = {"drive.frequency_ratio": [0.8, 0.9]}
    lean, full = (
        vi.scan(scene, axes, measure=measure, settle=20, cycles=64)
        for measure in (["steps", "impact_rate"], ["steps", "impact_rate", "extremes"])
    )
    assert (lean.steps < full.steps).all()
    np.testing.assert_array_equal(lean.impact_rate, full.impact_rate)
