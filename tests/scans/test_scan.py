"""Scans agree with single runs; errors and failing lanes."""

import numpy as np
import pytest
import vi_jax as vi
import xarray as xr

from shaken_oscillator import Shaken

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.01)

AXES = {"drive.frequency_ratio": np.linspace(0.6, 1.4, 7), "start.Y": np.linspace(-1.0, 1.0, 5)}


@pytest.fixture(scope="module")
def data():
    measure = ("extremes", "regime", "frequency_ratio", "power", "impact_rate", "sections", "steps")
    return vi.scan(SCENE, AXES, measure=measure, settle=100, cycles=130)


def test_lanes_agree_with_runs(data):
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


def test_power_is_the_loss_in_impacts():
    orbit = vi.closed_form_orbits(SCENE, cycles=1)
    start = SCENE.start(Y=orbit.Y[0], V=orbit.V[0])
    options = {"start": start, "measure": "power", "settle": 0, "cycles": 40}
    found = vi.scan(SCENE, {"stops.0.restitution": [0.5]}, **options)
    expected = 0.5 * (1 - 0.25) * float(orbit.impact_speed[0]) ** 2 * 0.9 / (2 * np.pi)
    assert float(found.power[0]) == pytest.approx(expected, rel=1e-6)


def test_labels_units_and_attributes(data):
    assert data.y_min.attrs["units"] == "a" and "long_name" in data.period.attrs
    assert data["drive.frequency_ratio"].attrs["units"] == "ω"
    assert "ExactFlight" in data.attrs["method"] and data.attrs["settle"] == 100
    assert set(data.Y.dims) == {"drive.frequency_ratio", "start.Y", "cycle"}
    assert data.result.attrs["flag_meanings"].split()[1] == "successful"
    assert data.attrs["period_codes"].startswith("-1 chaotic, -2 unsettled")


def test_blocks_do_not_change_results(data):
    same = vi.scan(SCENE, AXES, measure=("extremes", "regime"), settle=100, cycles=130, workers=3)
    xr.testing.assert_equal(same.y_min, data.y_min)
    rows = {
        "drive.frequency_ratio": np.repeat(AXES["drive.frequency_ratio"], 200),
        "start.Y": np.tile(np.linspace(-1, 1, 200), 7),
    }
    pair = vi.scan(SCENE, rows, measure="extremes", settle=20, paired=True, lanes=256)
    finer = {**AXES, "start.Y": np.linspace(-1, 1, 200)}
    grid = vi.scan(SCENE, finer, measure="extremes", settle=20)
    assert pair.y_min.dims == ("sample",)
    np.testing.assert_array_equal(np.asarray(pair.y_min), np.asarray(grid.y_min).ravel())


def test_paired_lanes_are_checked_one_by_one():
    """The smallest gap on one side is paired with a large one on the other."""
    scene = vi.Scene(
        damping_ratio=0.05,
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


def test_other_numbers_do_not_recompile(data, compilations):
    axes = {name: row[:-1] + 0.01 for name, row in AXES.items()}
    scene = vi.Scene.ideal(frequency_ratio=0.8, restitution=0.7, gap=1.5, damping_ratio=0.02)
    measure = ("extremes", "regime", "frequency_ratio", "power", "impact_rate", "sections", "steps")
    vi.scan(scene, axes, measure=measure, settle=77, cycles=130)
    assert not compilations


def test_user_defined_measures_scenes_and_starts():
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


@pytest.mark.slow
def test_derivatives_agree_with_those_of_a_run():
    names = ("drive.frequency_ratio", "start.V", "stops.0.gap")
    options = {"measure": "extremes", "settle": 5, "cycles": 1, "derivatives": names}
    data = vi.scan(SCENE, {"start.Y": [0.1, 0.4]}, **options)

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


def test_failing_lanes_are_counted_and_do_not_change_others():
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
        ({"axes": {}}, "`axes` must map"), ({"measure": "extreme"}, "near names: extremes"),
        ({"cycles": 12}, "at least 128 for the measure Regime"),
        ({"derivatives": ["stops.1.gap"]}, "near names: stops.0.gap"),
        ({"store": "/dev/null/x"}, "`store` must be a path"),
        ({"devices": 99}, "`devices` must be at most"), ({"paired": True}, "rows of one length"),
    ],
)  # fmt: skip
def test_invalid_arguments_raise_before_any_work(change, message):
    arguments = {"axes": AXES, **change}
    with pytest.raises((ValueError, TypeError), match=message):
        vi.scan(SCENE, **arguments)


def test_scenes_from_a_function_agree_with_runs():
    """Each lane uses the default method, and rests if its gap allows it."""

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


def test_unused_extremes_are_not_computed():
    scene = vi.Scene.ideal(frequency_ratio=0.9, gap=2.0, restitution=0.5)
    axes = {"drive.frequency_ratio": [0.8, 0.9]}
    lean, full = (
        vi.scan(scene, axes, measure=measure, settle=20, cycles=64)
        for measure in (["steps", "impact_rate"], ["steps", "impact_rate", "extremes"])
    )
    assert (lean.steps < full.steps).all()
    np.testing.assert_array_equal(lean.impact_rate, full.impact_rate)


FREQUENCIES = np.array([0.76, 0.77, 0.78])
OBSERVED = {"settle": 60, "cycles": 8}


@pytest.fixture(scope="module")
def runs():
    """Simulate each frequency separately."""
    found = []
    for frequency in FREQUENCIES:
        machine = Shaken(frequency=frequency)
        found.append(vi.simulate(machine, machine.start(), 8, settle=60))
    return found


def test_a_scan_measures_an_average_by_its_name(runs):
    wanted = [run.averages["taken"].mean() for run in runs]
    for machine in (Shaken(), lambda frequency: Shaken(frequency=frequency)):
        data = vi.scan(
            machine, {"frequency": FREQUENCIES}, measure=("taken", "power"), start=Shaken().start(),
            progress=False, **OBSERVED,
        )  # fmt: skip
        np.testing.assert_allclose(data.taken, wanted, rtol=1e-9)
        assert data.taken.attrs["units"] == "W" and "power" in data
    with pytest.raises(ValueError, match="near names: taken"):
        vi.scan(Shaken(), {"frequency": FREQUENCIES}, measure="takes")


def test_a_sweep_has_averages(runs):
    swept = vi.sweep(Shaken(), "frequency", FREQUENCIES[:1], **OBSERVED)
    np.testing.assert_allclose(swept.averages["taken"][0], runs[0].averages["taken"].mean())
    assert swept.to_xarray().taken.attrs["units"] == "W"
    ax = vi.plot_sweep(swept, y="taken")
    assert ax.get_ylabel() == "mean taken (W)"
    with pytest.raises(ValueError, match="'lost', 'taken'"):
        vi.plot_sweep(swept, y="given")


@pytest.mark.slow
def test_exponents_have_averages(runs):
    machine = Shaken(frequency=FREQUENCIES[0])
    found = vi.lyapunov(machine, runs[0].last, 8, settle=0, number=1)
    np.testing.assert_allclose(found.averages["taken"], runs[0].averages["taken"][-1], rtol=1e-6)
    assert "mean taken: " in repr(found) and found.to_xarray().taken.attrs["units"] == "W"
