"""The reproduction agrees with its stored report.

The first command of the README runs all of it, and fails if a verdict or special point differs.
"""

import copy

import numpy as np
import pytest
from reproduction.claims import check_claims
from reproduction.faults import check_faults, period_doubling_damping
from reproduction.motions import closed_form, sampled, simulate_cases
from reproduction.printed import energy_drift, eq21_misses
from reproduction.report import KEPT, differences, read


@pytest.fixture(scope="module")
def cases():
    return simulate_cases(quick=True)


@pytest.fixture(scope="module")
def claims(cases):
    return {claim.name: claim for claim in check_claims(cases)}


@pytest.fixture(scope="module")
def faults():
    return {fault.number: fault for fault in check_faults()}


@pytest.mark.slow
def test_verdicts_agree_with_the_stored_report(claims):
    kept = {claim["name"]: claim["verdict"] for claim in read(KEPT)["claims"]}
    assert len(kept) == 18 and len(claims) == 10
    assert {name: claim.verdict for name, claim in claims.items()}.items() <= kept.items()
    assert kept["rounding errors drive the transient"] == "contradicted"
    assert kept["discrepancy of the minimum"] == "confirmed undamped only"


def test_differences_from_the_stored_report_are_found():
    kept = read(KEPT)
    other = copy.deepcopy(kept)
    assert not differences(other, kept)
    other["claims"][0]["verdict"] = "confirmed"
    other["figure_2"]["panels"][0]["BB"] += 1e-4
    del other["boundaries"]["birth, undamped, ζ"]
    assert [line.partition(":")[0] for line in differences(other, kept)] == [
        kept["claims"][0]["name"], "birth, undamped, ζ", "k = 0.8, undamped",
    ]  # fmt: skip


def test_direct_short(claims):
    numbers = claims["direct 2π solutions by initial conditions"].numbers
    assert numbers["cycles_within_0.05"] == {"undamped": 60, "damped": 60}


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
    # The start was fitted by optax to a residual of 1e-10.
    assert claims["no transient from the 4π state"].numbers["max_deviation_undamped"] < 1e-9


def test_only_the_chosen_alignment_fits(cases):
    case = cases[0]
    Y = sampled(case.from_rest)[0]
    right = np.abs(Y - closed_form(case, len(Y), 2))[-2:].max()
    other = case._replace(long_shift=1 - case.long_shift)
    wrong = np.abs(Y - closed_form(other, len(Y), 2))[-2:].max()
    assert right < 1e-5 < 1 < wrong


def test_corrected_equation_conserves_energy_and_printed_ones_do_not(faults):
    first, second = faults[1].numbers, faults[2].numbers
    assert first["energy_drift_right"] < 1e-10
    assert first["energy_drift_printed_in_metres"] > 0.1
    assert first["energy_drift_printed_in_crank_radii"] > 0.01
    assert second["energy_drift_printed"] > 0.1


def test_energy_is_conserved_only_without_either_fault():
    assert energy_drift(coupling=0.3, slider_inertia=0.4) < 1e-9
    assert energy_drift(coupling=0.3, slider_inertia=0.4, printed_coupling=0.31) > 1e-4


@pytest.mark.parametrize("zeta", [0.75, 0.9, 1.2])
@pytest.mark.parametrize("n", [1, 2])
def test_eq21_needs_its_zeta(zeta, n):
    right = eq21_misses(zeta, 0.6, 2.0, n, printed=False)
    printed = eq21_misses(zeta, 0.6, 2.0, n, printed=True)
    assert max(right[name] for name in right if name.startswith("miss")) < 1e-11
    assert printed["miss_17_before"] > 0.01


def test_no_load_speed_maps_kappa_to_zeta(faults):
    by_kappa = faults[4].numbers["frequency_ratio_by_kappa"]["omega"]
    for kappa, ratio in by_kappa.items():
        assert ratio == pytest.approx(float(kappa), abs=1e-3)


def test_damping_at_the_period_doubling(faults):
    assert period_doubling_damping() == pytest.approx(0.27, abs=0.005)
    assert faults[6].numbers["largest_multiplier_by_c"]["0.5"] < 1
    assert faults[6].numbers["largest_multiplier_by_c"]["0"] > 1
