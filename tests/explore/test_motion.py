"""The explorer's computations agree with closed forms and the library; no page is needed."""

import re
import time

import numpy as np
import pytest
import vi_jax as vi
from vi_jax.explore.pictures import MAPS, MotionPicture, draw_diagram
from vi_jax.explore.subject import CYCLES, SETTLE, SHOWN, WINDOW, look, ready

ZETA, GAP, K = "drive.frequency_ratio", "stops.0.gap", "stops.0.restitution"


@pytest.fixture(scope="module")
def ideal():
    """Return the first machine of the page, compiled."""
    subject = next(iter(ready().values()))()
    subject.compile(lambda step: None)
    return subject


def read(svg):
    """Yield the paths of each panel by style, in units of its ticks, and a pixel's size in them."""
    lowered = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    for panel in svg.decode().split("<g ")[1:]:
        *_, up, across, _ = re.findall(">([^<]*)</text>", panel)
        scales, found = [], {}
        for label, tick in ((across, "M([0-9.]+) [0-9]+v4"), (up, "M0 ([0-9.]+)h-4")):
            power = "".join(re.findall("× 10(.+)", label)).translate(lowered) or "0"
            pairs = re.findall(f'{tick}"/><text [^>]*>([^<]*)', panel)
            places = [(x, f"{word}e{power}".replace("−", "-")) for x, word in pairs]
            scales.append(np.polyfit(*np.array(places, float).T, 1))
        assert scales[0][0] > 0 > scales[1][0]  # pixels are counted downwards
        for style, drawn in re.findall('class="([a-z]+)" d="([^"]*)', panel):
            points = np.array(re.findall("[ML]([-0-9.]+) ([-0-9.]+)", drawn), float).reshape(-1, 2)
            found[style] = [np.polyval(*x) for x in zip(scales, points.T, strict=True)]
        yield found, np.abs(scales)[:, :1]


def check_picture(svg, motion):
    """Check that the picture has the path, the sections and the multipliers of the motion."""
    (course, portrait, sections, circle), path, mu = read(svg), motion.path, motion.multipliers
    for (found, pixel), style, true in (
        (course, "motion", (path.cycles, path.Y)),
        (portrait, "motion", (path.Y, path.V)),
        (portrait, "section", motion.places),
        (sections, "section", motion.places),
        (circle, "multiplier", (mu.real, mu.imag)),
    ):
        np.testing.assert_allclose(found[style] / pixel, true / pixel, rtol=0, atol=0.3)


def seen(subject, settle=1000, **numbers):
    names = {"zeta": ZETA, "gap": GAP, "xi": "damping_ratio", "Y": "start.Y"}
    values = subject.first_values() | {names.get(name, name): x for name, x in numbers.items()}
    return look(*subject.at(values), settle)


@pytest.mark.parametrize("numbers", [{}, {"zeta": 1.1}, {"gap": 1.0, "Y": 3.0}])
def test_motions_with_one_impact_agree_with_closed_forms(ideal, numbers):
    found = seen(ideal, **numbers)
    zeta, gap = numbers.get("zeta", 0.9), numbers.get("gap", 2.0)
    scene = vi.Scene.ideal(frequency_ratio=zeta, gap=gap, damping_ratio=0.01)
    exact = vi.closed_form_orbits(scene, cycles=found.period)
    (place,) = np.flatnonzero(np.isclose(exact.y_min, found.extremes[0], atol=1e-6))
    assert exact.admissible[place] and found.impacts == 1
    expected = np.asarray(exact.multipliers[place])
    assert np.sort_complex(found.multipliers) == pytest.approx(np.sort_complex(expected), abs=1e-5)
    assert "stable" in found.stability and f"{2 * found.period}π with 1 impact" in found.regime
    assert found.impact_speed == pytest.approx(float(exact.impact_speed[place]), abs=1e-5)
    at_stop = np.isclose(found.path.Y, gap)
    assert found.path.cycles[-1] == pytest.approx(WINDOW)
    assert at_stop.sum() == 2 * WINDOW // found.period  # before and after each impact


def test_other_regimes(ideal):
    start = seen(ideal, settle=0, Y=-1.0)
    assert start.path.Y[0] == -1.0
    chaos = seen(ideal, zeta=0.7, xi=0.0)
    scene = vi.Scene.ideal(frequency_ratio=0.7)
    exact = vi.lyapunov(scene, scene.start(), 2000, settle=500, number=1)
    assert chaos.regime.startswith("chaotic") and not chaos.multipliers.size
    assert chaos.exponent == pytest.approx(float(exact.exponents[0]), abs=0.02)
    free = seen(ideal, zeta=2.0, xi=0.0)
    assert not free.impact_speed.size and "neither" in free.stability


def test_sliders_do_not_compile_and_redraw_quickly(ideal, compilations):
    begin, picture, took = ideal.first_values(), MotionPicture(ideal.machine.labels), []
    picture.draw(ideal.motion_at(begin))
    ideal.diagram(begin, K)
    compilations.clear()
    for name, control in ideal.controls.items():
        for part in (0.0, 0.4, 0.6, 1.0):
            values = {**begin, name: control.low + part * (control.high - control.low)}
            since = time.process_time()
            picture.draw(ideal.motion_at(values))
            took.append(time.process_time() - since)
    ideal.diagram({**begin, GAP: 1.0}, K)
    assert not compilations and np.median(took) < 0.1


def test_a_diagram_agrees_with_runs(ideal):
    values = {**ideal.first_values(), "start.Y": 0.5}
    found = ideal.diagram(values, K)
    assert found.values[0] == 0.0 and found.values[-1] == 1.0
    assert ideal.diagram({**values, K: 0.7, SETTLE: 3.0}, K) is found  # its axis is the slider's
    assert ideal.diagram({**values, GAP: 1.5}, K) is not found
    here, start = ideal.at({**values, K: found.values[60]})
    run = vi.simulate(here, start, CYCLES, settle=ideal.before)
    assert found.low[60] == pytest.approx(np.asarray(run.y_min), abs=1e-9)
    assert found.position[60] == pytest.approx(np.asarray(run.sections.Y[1:]), abs=1e-9)
    for name in SHOWN:
        ax = draw_diagram(found, 0.5, name)
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("restitution k", name)
        assert ax.get_xlim() == (0.0, 1.0)


def test_pictures(ideal):
    picture, found = MotionPicture(ideal.machine.labels), ideal.motion_at(ideal.first_values())
    check_picture(first := picture.draw(found), found)
    assert picture.draw(found) == first  # the axes keep their limits
    assert len({picture.draw(found, which) for which in MAPS}) == len(MAPS)
    check_picture(picture.draw(other := seen(ideal, zeta=0.902)), other)


def test_values_outside_a_sliders_range_raise(ideal):
    values = ideal.first_values()
    for wrong in (1e9, -5.0, float("nan"), None, "0.9"):
        message = f"The restitution k must be a number from 0 to 1, but is {wrong!r}."
        with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
            ideal.at({**values, K: wrong})


def test_slider_ranges_are_valid_for_the_machine():
    made = {name: make() for name, make in ready().items()}
    assert {"Scene, motor", "BouncingBall", "Beam"} <= set(made) and "Structure" not in made
    for subject in made.values():
        assert len({c.label for c in subject.controls.values()}) == len(subject.controls)
        for name, control in subject.controls.items():
            assert control.low <= control.value <= control.high
            # A slider's grid contains the default value.
            steps = (control.value - control.low) / control.step
            assert abs(steps - round(steps)) < 1e-9
            for end in (control.low, control.high):
                if not isinstance(subject.machine, vi.machines.Woodpecker):  # may not fit its pole
                    subject.at({**subject.first_values(), name: end})
    duffing = made["Duffing"].controls
    assert (duffing["restitution"].low, duffing["restitution"].high) == (0.0, 1.0)
    assert (duffing["amplitude"].low, duffing["amplitude"].high) == pytest.approx((0.0, 0.6))
