"""The reproduction: what it measures, and that its report says so."""

import json
from math import isnan
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from vi_jax.paper import check_claims, check_faults, reproduce, simulate_cases
from vi_jax.paper.assumptions import check_assumptions
from vi_jax.paper.faults import period_doubling_damping
from vi_jax.paper.figures import DRAWN, draw_figure, drawn_numbers
from vi_jax.paper.motions import closed_form, sampled
from vi_jax.paper.motors import TORQUES, draw_motors, simulate_motors
from vi_jax.paper.printed import energy_drift, eq21_misses
from vi_jax.paper.sketch import draw_sketch
from vi_jax.plot.stamp import stamped

KEPT = Path(__file__).parents[2] / "experiments" / "figures"


@pytest.fixture(scope="module")
def cases():
    return simulate_cases(quick=True)


@pytest.fixture(scope="module")
def claims(cases):
    return {claim.name: claim for claim in check_claims(cases)}


@pytest.fixture(scope="module")
def faults():
    return {fault.number: fault for fault in check_faults()}


def test_verdicts(claims):
    assert {name: claim.verdict for name, claim in claims.items()} == {
        "first 4π from rest follow the 2π motion": "contradicted",
        "begins near the 2π motion": "confirmed undamped only",
        "leaves the 2π motion": "confirmed undamped only",
        "rounding errors drive the transient": "contradicted",
        "settles on the 4π motion": "confirmed undamped only",
        "simulation and 4π closed form agree": "confirmed undamped only",
        "no transient from the 4π state": "confirmed undamped only",
        "direct 2π solutions by initial conditions": "confirmed",
        "no discrepancy of the maximum": "confirmed",
        "discrepancy of the minimum": "confirmed undamped only",
    }


@pytest.fixture(scope="module")
def assumptions(cases):
    return {claim.name: claim for claim in check_assumptions(cases[0])}


def test_crank_phase_of_the_start(assumptions):
    claim = assumptions["the start's crank phase"]
    apart = claim.numbers["max_difference_cycles_3_4_by_phase_over_pi"]
    assert claim.verdict == "confirmed in part"
    assert apart["0"] == pytest.approx([0.197, 0.170], abs=2e-3)
    assert apart["1"] == pytest.approx([1.708, 1.708], abs=2e-3)
    # From every phase the same 4π motion in the end.
    assert claim.numbers["last_minima"] == pytest.approx([-3.2543] * len(apart), abs=1e-2)


def test_exact_crank(assumptions):
    claim = assumptions["the cosine in the crank's place (Eq. 4)"]
    assert claim.verdict == "confirmed"
    assert claim.numbers["minima_exact"] == pytest.approx([-3.2985, -1.7043], abs=1e-4)
    assert claim.numbers["minima_cosine"] == pytest.approx([-3.2543, -1.5442], abs=1e-4)


def test_direct_short(claims):
    numbers = claims["direct 2π solutions by initial conditions"].numbers
    assert numbers["cycles_within_0.05"] == {"undamped": 60, "damped": 60}


@pytest.mark.slow
def test_motors_at_the_stated_speed(cases):
    """κ and minima from an independent code (SciPy), at a mean ζ of 0.90."""
    motors = simulate_motors()
    for row in motors.rows:
        assert row.kappa is not None and bool(row.orbit.successful)
        assert float(row.orbit.frequency_ratio) == pytest.approx(0.9, abs=1e-9)
    assert [run.torque for run in motors.runs] == list(TORQUES)
    kappa = [run.kappa for run in motors.runs]
    assert kappa == pytest.approx([0.9277, 0.9055, 0.9005], abs=1e-4)
    minima = [float(run.orbit.y_min) for run in motors.runs]
    assert minima == pytest.approx([-3.291, -3.282, -3.257], abs=1e-3)
    found = {claim.name: claim for claim in check_assumptions(cases[0], motors)}
    assert found["Figures 3 and 4 with the motor"].verdict == "confirmed"
    speed = found["the speed hardly varies within a cycle (Eq. 10)"].numbers
    assert len(draw_motors(motors.runs, cases[0].from_rest).axes) == 6
    assert 0 < speed["variation_by_torque"]["100"] < speed["variation_by_torque"]["2"] < 0.1


def test_sketch_names_the_machine():
    figure = draw_sketch()
    words = " ".join(text.get_text() for text in figure.axes[0].texts)
    for name in ("m_B", "m_C", "k_0", "l_0", "J", "Delta", "varphi", "$c$", "$l$", "$a$"):
        assert name in words


def test_disc_and_lever(faults):
    assert faults[8].numbers["mass_of_the_disc"] == pytest.approx(75.0)
    assert faults[7].numbers["mass_of_such_a_lever"] == pytest.approx(12.5)


@pytest.mark.parametrize("number", [3, 4])
def test_kept_figures_show_these_numbers(cases, number):
    """The pictures beside the studies are of the motions as they are computed now."""
    kept = json.loads(stamped(KEPT / f"fig{number}.png", DRAWN) or "{}")
    drawn = drawn_numbers(number, cases)
    assert kept.keys() == drawn.keys()
    for name, numbers in drawn.items():
        assert kept[name] == pytest.approx(numbers, abs=1e-7)


def test_transient_from_rest(claims):
    near = claims["begins near the 2π motion"].numbers
    assert near["minima_cycles_3_4"]["undamped"] == pytest.approx([-2.004, -1.737], abs=1e-3)
    assert near["closed_form_minimum_2pi"]["undamped"] == pytest.approx(-1.883583, abs=1e-6)
    settled = claims["settles on the 4π motion"].numbers
    assert 25 <= settled["cycle_settled_on_4pi_undamped"] <= 45
    assert settled["last_minima"]["undamped"] == pytest.approx([-3.254, -1.544], abs=1e-3)


def test_departure_has_the_rate_of_the_multiplier(claims):
    numbers = claims["leaves the 2π motion"].numbers
    assert numbers["rate_small_deviation"]["undamped"] == pytest.approx(1.166036, abs=1e-5)
    assert numbers["rate_small_deviation"]["damped"] == pytest.approx(0.88598, abs=1e-4)


def test_four_pi_motion_has_no_transient(claims):
    # The state is the one optax fitted to a residual of 1e-10.
    assert claims["no transient from the 4π state"].numbers["max_deviation_undamped"] < 1e-9


def test_alignment_is_the_one_that_fits(cases):
    case = cases[0]
    Y = sampled(case.from_rest)[0]
    right = np.abs(Y - closed_form(case, len(Y), 2))[-2:].max()
    other = case._replace(long_shift=1 - case.long_shift)
    wrong = np.abs(Y - closed_form(other, len(Y), 2))[-2:].max()
    assert right < 1e-5 < 1 < wrong


def test_right_equation_keeps_energy_and_printed_ones_do_not(faults):
    first, second = faults[1].numbers, faults[2].numbers
    assert first["energy_drift_right"] < 1e-10
    assert first["energy_drift_printed_in_metres"] > 0.1
    assert first["energy_drift_printed_in_crank_radii"] > 0.01
    assert second["energy_drift_printed"] > 0.1


def test_energy_drift_needs_both_faults_gone():
    assert energy_drift(coupling=0.3, slider_inertia=0.4) < 1e-9
    assert energy_drift(coupling=0.3, slider_inertia=0.4, printed_coupling=0.31) > 1e-4


@pytest.mark.parametrize("zeta", [0.75, 0.9, 1.2])
@pytest.mark.parametrize("n", [1, 2])
def test_eq21_needs_its_zeta(zeta, n):
    right = eq21_misses(zeta, 0.6, 2.0, n, printed=False)
    printed = eq21_misses(zeta, 0.6, 2.0, n, printed=True)
    assert max(right[name] for name in right if name.startswith("miss")) < 1e-11
    assert printed["miss_17_before"] > 0.01


def test_eq21_gives_the_checked_impacts():
    for n, speed in ((1, 1.57475), (2, 3.54674)):
        v0 = eq21_misses(0.9, 0.5, 2.0, n, printed=False)["v0"]
        assert 0.9 * v0 == pytest.approx(speed, abs=1e-5)


def test_no_load_speed_maps_kappa_to_zeta(faults):
    by_kappa = faults[4].numbers["frequency_ratio_by_kappa"]["omega"]
    for kappa, ratio in by_kappa.items():
        assert ratio == pytest.approx(float(kappa), abs=1e-3)


def test_damping_at_the_period_doubling(faults):
    assert period_doubling_damping() == pytest.approx(0.27, abs=0.005)
    assert faults[6].numbers["largest_multiplier_by_c"]["0.5"] < 1
    assert faults[6].numbers["largest_multiplier_by_c"]["0"] > 1


@pytest.mark.slow
def test_reproduce_writes_figures_and_reports(tmp_path):
    steps = []

    def progress(step, left):
        assert left > 0
        steps.append(step)

    found = reproduce(tmp_path / "a" / "b", quick=True, progress=progress)
    names = ["fig1.png", "fig3.png", "fig4.png", "report.json", "report.md"]
    assert [path.name for path in found.files] == names
    assert len(steps) == 6
    for name in names[1:3]:
        path = tmp_path / "a" / "b" / name
        assert path.stat().st_size < 200_000
        picture = Image.open(path)
        assert picture.size == (1540, 924)
        assert len(np.unique(np.asarray(picture))) > 16

    def refuse(constant):
        raise AssertionError(constant)

    text = (tmp_path / "a" / "b" / "report.json").read_text(encoding="utf-8")
    data = json.loads(text, parse_constant=refuse)
    assert len(data["claims"]) == 12 and len(data["faults"]) == 9
    assert not any(isnan(x) for x in data["settings"]["damping_ratio"].values())
    page = (tmp_path / "a" / "b" / "report.md").read_text(encoding="utf-8")
    for claim in found.claims:
        assert claim.measured in page
    assert "None" not in page and "nan" not in page


def test_figure_numbers(cases, tmp_path):
    with pytest.raises(ValueError, match="3 or 4"):
        draw_figure(2, cases, tmp_path / "fig.png")
    assert not list(tmp_path.iterdir())
