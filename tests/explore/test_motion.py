"""What the explorer computes, against closed forms and the rest of the library; no page needed."""

import time
from contextlib import contextmanager
from io import BytesIO

import jax
import numpy as np
import pytest
import vi_jax as vi
from PIL import Image
from vi_jax.explore import controls
from vi_jax.explore.diagram import CYCLES, SETTLE, SHOWN, diagram
from vi_jax.explore.motion import OBSERVED, WINDOW, look
from vi_jax.explore.pictures import MAPS, DiagramPicture, MotionPicture
from vi_jax.explore.serve import compile_all

from differences import some


@pytest.fixture(scope="module", autouse=True)
def _compiled():
    compile_all(lambda step: None)


@contextmanager
def compilations():
    """Notes each program that is compiled in it."""
    found: list[str] = []

    def note(event: str, seconds: float, **about) -> None:
        if "backend_compile" in event:
            found.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_duration_listener(note)


def ideal(settle=1000, **numbers):
    return look(*controls.ideal({**controls.beginning(controls.IDEAL), **numbers}), settle)


def motor(settle=300, **numbers):
    return look(*controls.motor({**controls.beginning(controls.MOTOR), **numbers}), settle)


@pytest.mark.parametrize("numbers", [{}, {"frequency_ratio": 1.1}, {"gap": 1.0, "Y": 3.0}])
def test_a_motion_with_one_impact_is_as_in_closed_form(numbers):
    seen = ideal(**numbers)
    scene, _ = controls.ideal({**controls.beginning(controls.IDEAL), **numbers})
    exact = vi.closed_form_orbits(scene, cycles=seen.period)
    (place,) = np.flatnonzero(np.isclose(exact.y_min, seen.extremes[0], atol=1e-6))
    assert exact.admissible[place] and seen.impacts == 1
    expected = np.asarray(exact.multipliers[place])
    # In the order that the page has, conjugates apart.
    assert np.sort_complex(seen.multipliers) == pytest.approx(np.sort_complex(expected), abs=1e-5)
    assert "stable" in seen.stability and f"{2 * seen.period}π with 1 impact" in seen.regime
    assert seen.impact_speed == pytest.approx(float(exact.impact_speed[place]), abs=1e-5)


def test_the_path_touches_the_stop_where_the_impacts_are():
    seen = ideal()
    assert seen.path.cycles[0] == 0 and seen.path.cycles[-1] == pytest.approx(WINDOW)
    at_stop = np.isclose(seen.path.Y, 2.0)
    assert at_stop.sum() == 2 * WINDOW // seen.period  # before and after each impact
    before, after = seen.path.V[at_stop][::2], seen.path.V[at_stop][1::2]
    assert after == pytest.approx(-0.5 * before)
    assert seen.sections.Y.shape == (OBSERVED + 1,)


def test_without_settling_the_start_is_seen():
    seen = ideal(settle=0, Y=-1.0, V=0.5)
    assert (seen.path.Y[0], seen.path.V[0]) == (-1.0, 0.5)


def test_a_motion_without_a_period_has_an_exponent():
    seen = ideal(frequency_ratio=0.7, damping_ratio=0.0)
    scene = vi.Scene.ideal(frequency_ratio=0.7)
    exact = vi.lyapunov(scene, scene.start(), 2000, settle=500, number=1)
    assert seen.regime.startswith("chaotic") and not seen.multipliers.size
    assert seen.exponent == pytest.approx(float(exact.exponents[0]), abs=0.02)


def test_free_motion_without_damping_is_neutral():
    seen = ideal(frequency_ratio=2.0, damping_ratio=0.0)
    assert not seen.impact_speed.size and "neither" in seen.stability


def test_a_motor_lags_behind_by_what_it_must_deliver():
    strong, weaker = motor(torque=15.0), motor(torque=7.5)
    lag = [0.9 - seen.frequency_ratio.mean() for seen in (strong, weaker)]
    assert 0 < lag[0] < 5e-3 and lag[1] == pytest.approx(2 * lag[0], rel=0.02)
    assert strong.multipliers.size == 3 and "stable" in strong.stability


def test_what_fails_says_why():
    scene = vi.Parameters(control=-1.0).scene()
    seen = look(scene, scene.start(W=0.1), 300)
    assert seen.regime == "failed" and "turning forward" in seen.fault and not seen.stability
    assert MotionPicture(motor=True).draw(seen, 2.0)


def test_no_slider_compiles():
    numbers = controls.beginning(controls.NUMBERS)
    picture = MotionPicture()
    picture.draw(ideal(), 2.0)
    with compilations() as found:
        for changed in ({"restitution": 0.8}, {"gap": 0.0}, {"Y": -3.0}, {"frequency_ratio": 0.7}):
            seen = ideal(**changed)
            picture.draw(seen, 2.0)
            assert seen.stability
        diagram({**numbers, "gap": 1.0}, "restitution", (0.1, 0.9), Y=0.3, V=0.1)
        assert motor(control=1.3, torque=0.5, gap=0.2).stability
    assert not found


def test_redraws_are_quick():
    picture, took = MotionPicture(), []
    picture.draw(ideal(), 2.0)
    for i in range(20):
        begin = time.process_time()
        picture.draw(ideal(frequency_ratio=0.9 + 0.004 * i), 2.0)
        took.append(time.process_time() - begin)
    assert np.median(took) < 0.2


@pytest.mark.parametrize("make", some(["ideal", "motor"], "motor"))
def test_the_ends_of_all_sliders_can_be_shown(make):
    kinds = {"ideal": controls.IDEAL, "motor": controls.MOTOR}[make]
    see = {"ideal": ideal, "motor": motor}[make]
    picture = MotionPicture(motor=make == "motor")
    for name, control in kinds.items():
        for end in (control.low, control.high):
            assert control.nearest(end) == end
            if name != "settle":
                seen = see(**{name: end}, settle=100)
                assert seen.regime and not seen.fault, (name, end)
                assert picture.draw(seen, 2.0)
    assert control.nearest(-1e9) == control.low


def test_a_diagram_is_made_of_runs():
    numbers = controls.beginning(controls.NUMBERS)
    found = diagram(numbers, "restitution", (0.0, 1.0), Y=0.5, V=0.0)
    assert found.values[0] == 0.0 and found.values[-1] == 1.0
    value = found.nearest(0.4)
    (row,) = np.flatnonzero(found.values == value)
    scene = vi.Scene.ideal(**{**numbers, "restitution": value})
    run = vi.simulate(scene, scene.start(Y=0.5), CYCLES, settle=SETTLE)
    assert found.Y[row] == pytest.approx(np.asarray(run.sections.Y[1:]), abs=1e-9)
    assert found.y_min[row] == pytest.approx(np.asarray(run.y_min), abs=1e-9)


def test_pictures():
    picture, seen = MotionPicture(), ideal()
    first = picture.draw(seen, 2.0)
    assert Image.open(BytesIO(first)).size == (1008, 594)
    assert picture.draw(seen, 2.0) == first  # within kept frames
    assert picture.draw(seen, 2.0, which=MAPS[1]) != first
    moved = ideal(frequency_ratio=0.902)
    assert picture.draw(moved, 2.0) != first
    numbers = controls.beginning(controls.NUMBERS)
    found = diagram(numbers, "gap", (0.0, 5.0), Y=0.0, V=0.0)
    for name in SHOWN:
        ax = DiagramPicture().set(found, 2.0, shown=name)
        assert ax.get_ylabel() == name and ax.get_xlim() == (0.0, 5.0)
