"""Files for the command line: what is read of them."""

import dataclasses
import tomllib
from pathlib import Path

import numpy as np
import pytest
import vi_jax as vi
from hypothesis import given, settings
from hypothesis import strategies as st
from vi_jax.cli import checks, config, verbs
from vi_jax.cli.toml import keys_of, read_toml
from vi_jax.machine.numbers import leaf, leaf_names

from toml_files import IDEAL, written

READY = sorted((Path(__file__).parents[2] / "experiments").glob("*.toml"))

numbers = st.floats(0.01, 0.99).map(lambda x: round(x, 6))

SI = sorted(field.name for field in dataclasses.fields(vi.Parameters))


@pytest.mark.slow
@settings(deadline=None, max_examples=30)
@given(machine=st.dictionaries(st.sampled_from(SI), numbers, max_size=6))
def test_any_machine_is_read_as_it_is_written(tmp_path_factory, machine):
    path = tmp_path_factory.mktemp("machine") / "file.toml"
    text = "".join(f"{key} = {value!r}\n" for key, value in machine.items())
    path.write_text("[parameters]\n" + text)
    table = config.read(path).parameters
    assert table is not None
    assert {name: getattr(table, name) for name in machine} == machine
    scene, wanted = table.build(), vi.Parameters(**machine).scene(drive="motor")
    for name in leaf_names(wanted):
        assert float(leaf(scene, name)) == float(leaf(wanted, name))


def test_the_machine_has_the_keys_of_parameters():
    assert set(keys_of(config.ParametersTable)) == {*SI, "drive", "crank", "clock"}


@settings(deadline=None, max_examples=30)
@given(low=numbers, high=numbers, count=st.integers(1, 20), quoted=st.booleans())
def test_ranges_and_names(tmp_path_factory, low, high, count, quoted):
    name = "stops.0.gap"
    key = f'"{name}"' if quoted else name
    path = tmp_path_factory.mktemp("axes") / "file.toml"
    path.write_text(f"[axes]\n{key} = {{ from = {low}, to = {high}, count = {count} }}\n")
    axes = config.read(path).axes
    assert axes is not None and list(axes) == [name]
    np.testing.assert_array_equal(axes[name], np.linspace(low, high, count))


def test_whole_numbers_are_numbers(here):
    file = config.read(written(IDEAL + "gap = 1\n[axes]\ndrive.frequency_ratio = [1, 2]"))
    assert file.axes == {"drive.frequency_ratio": (1.0, 2.0)}
    assert float(file.build()[0].stops[0].gap) == 1.0


def test_scenes(here):
    scene, start, method = config.read(written(IDEAL)).build()
    assert start is None and method is None
    assert [(s.side, float(s.gap), float(s.restitution)) for s in scene.stops] == [
        ("right", 2.0, 0.5)
    ]
    text = """
    [scene]
    drive = "motor"
    motor = { strength = 1.0, control = 0.8, coupling = 0.1, slider_inertia = 0.05 }
    restitution = 0.6
    crank = "slider"
    crank_ratio = 0.3
    clock = "time"
    [[scene.stops]]
    gap = 1.5
    [[scene.stops]]
    side = "left"
    gap = 1.0
    restitution = 0.2
    [start]
    Y = 0.25
    [method]
    name = "fixed-step"
    solver = "Tsit5"
    steps_per_cycle = 20
    """
    scene, start, method = config.read(written(text)).build()
    assert isinstance(scene.drive, vi.Motor) and float(scene.drive.control) == 0.8
    assert isinstance(scene.crank, vi.SliderCrank) and float(scene.crank.ratio) == 0.3
    assert [(s.side, float(s.restitution)) for s in scene.stops] == [("right", 0.6), ("left", 0.2)]
    assert isinstance(start, vi.TimedMotorState) and float(start.W) == 0.8
    assert isinstance(method, vi.FixedStep) and method.steps_per_cycle == 20
    lagging = text.replace(
        "slider_inertia = 0.05 }", "slider_inertia = 0.05, electrical_time = 0.2 }"
    )
    scene, start, _ = config.read(written(lagging + "[simulate]\ncycles = 1")).build()
    assert isinstance(scene.drive, vi.DCMotor) and float(scene.drive.electrical_time) == 0.2
    assert isinstance(start, vi.TimedDCMotorState) and float(start.M) == 0.0
    switched_on = lagging.replace("Y = 0.25", "W = 0\nM = 0.125")
    assert float(config.read(written(switched_on)).build()[1].M) == 0.125
    assert not config.read(written(IDEAL + "stops = []")).build()[0].stops


def test_soft_stops(here):
    text = IDEAL + "[[scene.soft_stops]]\ngap = 2.0\nstiffness = 50.0\nrestitution = 0.5"
    scene, _, _ = config.read(written(text)).build()
    assert isinstance(scene, vi.Scene) and not scene.stops
    assert float(scene.soft_stops[0].damping) == pytest.approx(0.43090752, abs=1e-8)


def test_methods(here):
    def method(text):
        return config.read(written(f"{IDEAL}[method]\n{text}")).build()[2]

    assert isinstance(method('name = "exact-flight"'), vi.ExactFlight)
    adaptive = method('name = "adaptive"\nrtol = 1e-7')
    assert isinstance(adaptive, vi.Adaptive) and float(adaptive.rtol) == 1e-7
    implicit = method('name = "adaptive"\nsolver = "Kvaerno5"')
    assert isinstance(implicit, vi.Adaptive) and implicit.solver.implicit
    series = method('name = "taylor"\norder = 12\nsteps_per_cycle = 6')
    assert isinstance(series, vi.Taylor) and (series.order, series.steps_per_cycle) == (12, 6)
    with pytest.raises(config.ConfigError, match=r"\[method\].*explicit"):
        method('name = "fixed-step"\nsolver = "Kvaerno5"')


@pytest.mark.parametrize("path", READY, ids=lambda path: path.stem)
def test_ready_files(path):
    file = config.read(path)
    scene, _, _ = file.build()
    for verb in verbs.VERBS:
        if getattr(file, verb) is not None:
            break
    else:
        raise AssertionError("no verb")
    checks.check_names(scene, file.axes or (), "[axes]", start=True)
    assert f"vi-jax {verb} experiments/{path.name}" in path.read_text()


def test_there_are_ready_files():
    assert {"regimes", "basins", "frequency_response"} <= {path.stem for path in READY}


def test_an_editors_mark_is_no_fault(here):
    Path("file.toml").write_bytes(b"\xef\xbb\xbf" + IDEAL.encode())
    scene, _, _ = config.read("file.toml").build()
    assert float(scene.drive.frequency_ratio) == 0.9


def test_the_example_of_the_module_is_valid(here):
    lines = (config.__doc__ or "").splitlines()
    text = "\n".join(line[4:] for line in lines if line.startswith("    "))
    tomllib.loads(text)
    file = read_toml(written(text.replace("[method]", "")), config.Config)
    assert file.machine is not None and file.machine.build().half_gap == 2
    assert file.axes is not None and list(file.axes) == ["stops.0.restitution"]
