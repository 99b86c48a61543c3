"""The claims and assumptions of the paper, each a row with its measurement."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from tools.ideal import vibration
from vi_jax.flow import Run, simulate
from vi_jax.machines import Parameters, Scene, SliderCrank

from .discrepancy import in_words, shares
from .motions import (
    CYCLES,
    FREQUENCY_RATIO,
    GAP,
    RESTITUTION,
    Case,
    closed_form,
    half_turn_states,
    last_minima,
    mean_ratio,
    run_of,
    sampled,
)
from .motors import MotorRun
from .response import WALL, Response
from .rows import PARTLY, Row, claim, listed, verdict

# A motion counts as settled while it stays this close to an orbit (unit: a, a ω): a choice.
_SETTLED = 1e-3
# Number of crank angles at the start: each is a multiple of an eighth of a turn.
_PHASES = 8
# A start within this distance of the 2π motion counts as near (unit: a): a choice.
_NEAR = 0.3


def check_claims(cases: tuple[Case, Case], panels: list[dict] | None = None) -> list[Row]:
    """Measure each claim about Figures 3 and 4 on the simulated cases. Without the `panels` of
    Figure 2 (`describe`) the claim about the whole figure is tested at ζ = 0.90 only."""
    checks = (
        _first_cycles, _near_short, _departure, _rounding, _settles, _agrees, _no_transient,
        _direct_short, partial(_maximum, panels or []), _minimum,
    )  # fmt: skip
    return [check(cases) for check in checks]


def check_figure_2(found: Response, panels: list[dict]) -> list[Row]:
    """Measure each claim about the whole of Figure 2, whose panels `describe` returns."""
    return [_free(found), *(check(panels) for check in (_everywhere, _reason, _wall))]


def check_assumptions(case: Case, motors: list[MotorRun]) -> list[Row]:
    """Measure the assumptions on the undamped case, and those about the motor on its runs."""
    return [_crank_phase(case), _cosine(case), _motor(motors), _even_speed(case, motors)]


def _each(cases: tuple[Case, Case], measure: Callable[[Case], Any]) -> dict[str, Any]:
    return {case.name: measure(case) for case in cases}


def _off(case: Case, part: slice, period: int) -> float:
    """Return the greatest |Y - closed form| over a part of the cycles from rest; `period` is that
    of the closed form, in cycles."""
    Y = sampled(case.from_rest)[0]
    return float(np.abs(Y - closed_form(case, len(Y), period))[part].max())


@claim
def _first_cycles(cases):
    off = _each(cases, lambda case: [_off(case, slice(i, i + 1), 1) for i in range(4)])
    words = {name: listed("{:.2f}", gaps, ", ") for name, gaps in off.items()}
    return words, verdict(max(off["undamped"][:2]) < 0.5), {"max_difference_cycles_1_to_4": off}


@claim
def _near_short(cases):
    minima = _each(cases, lambda case: np.asarray(case.from_rest.y_min)[2:4].tolist())
    closed = _each(cases, lambda case: case.short_minimum)
    growth = _each(cases, lambda case: case.growth)
    near = np.abs(np.array(minima["undamped"]) - closed["undamped"]).max() < 0.2
    return {}, verdict(bool(near) and growth["undamped"] > 1, growth["damped"] > 1), {
        "minima_cycles_3_4": minima,
        "closed_form_minimum_2pi": closed,
        "largest_multiplier_2pi": growth,
    }  # fmt: skip


def _deviation(run: Run, orbit: Run) -> np.ndarray:
    """Return the distances of the states at φ = π from the 2π orbit."""
    return np.linalg.norm(half_turn_states(run) - half_turn_states(orbit)[0], axis=1)


def _staying(case: Case, distance: float) -> int | None:
    """Return the number of cycles from the 2π state within a distance, or `None` for all."""
    gone = np.nonzero(_deviation(case.on_short, case.on_short) > distance)[0]
    return int(gone[0]) if gone.size else None


def _rate(deviation: np.ndarray) -> float:
    """Return the factor per cycle, from a straight line through the logarithms."""
    return float(np.exp(np.polyfit(np.arange(deviation.size), np.log(deviation), 1)[0]))


def _nudged_rate(case: Case) -> float:
    """Return the growth per cycle of a deviation of 1e-8 in Y from the 2π motion."""
    start = case.scene.start(Y=case.short.Y[0] - 1e-8, V=case.short.V[0])
    Y = sampled(case.from_rest)[0]
    run = run_of(case.scene, start, *Y.shape)
    # After 12 cycles the other multiplier's part has decayed, and the deviation is still small.
    return _rate(_deviation(run, case.on_short)[12:36])


@claim
def _departure(cases):
    rates, predicted = _each(cases, _nudged_rate), _each(cases, lambda case: case.growth)
    fits = abs(rates["undamped"] - predicted["undamped"]) < 1e-3
    return {}, verdict(fits and rates["undamped"] > 1, rates["damped"] > 1), {
        "rate_small_deviation": rates,
        "rate_from_rest": _each(
            cases, lambda case: _rate(_deviation(case.from_rest, case.on_short)[3:15])
        ),
        "largest_multiplier_2pi": predicted,
    }  # fmt: skip


@claim
def _rounding(cases):
    case, cycles = cases[0], _staying(cases[0], 0.1)
    fourth = float(_deviation(case.from_rest, case.on_short)[3])
    on_orbit = _deviation(case.on_short, case.on_short)
    staying = f"is within {on_orbit.max():.1g} of it after all {on_orbit.size} cycles"
    if cycles is not None:
        staying = f"leaves it (by 0.1) only after {cycles} cycles"
    return {"staying": staying}, verdict(fourth <= 1e-6), {
        "deviation_fourth_cycle": fourth,
        "cycles_on_2pi_motion_to_rounding": cycles,
        "deviation_last_cycle_from_2pi_start": float(on_orbit[-1]),
    }  # fmt: skip


def _settling(run: Run, orbit: Run, period: int, shift: int) -> int | None:
    """Return the first cycle after which the run stays on an orbit, or `None`."""
    states, closed = half_turn_states(run), half_turn_states(orbit)[:period]
    wanted = closed[(np.arange(len(states)) - shift) % period]
    away = np.nonzero(np.linalg.norm(states - wanted, axis=1) > _SETTLED)[0]
    settled = int(away[-1]) + 1 if away.size else 0
    return settled if settled < len(states) else None


@claim
def _settles(cases):
    case, damped = cases
    on_long = _settling(case.from_rest, case.from_long, 2, case.long_shift)
    on_short = _settling(damped.from_rest, damped.on_short, 1, 0)
    return {}, verdict(on_long is not None, on_short is None), {
        "cycle_settled_on_4pi_undamped": on_long,
        "cycle_settled_on_2pi_damped": on_short,
        "last_minima": _each(cases, lambda case: last_minima(case.from_rest)),
    }  # fmt: skip


@claim
def _agrees(cases):
    case, damped = cases
    last = slice(-2, None)
    worst, clearance = _off(case, last, 2), float(damped.long.clearance[0])
    tolerance = 1e-8 if case.from_rest.impacts.shape[0] >= 200 else 1e-3
    return {"over": -clearance}, verdict(worst < tolerance, damped.long_exists), {
        "max_difference_last_4pi_to_4pi_undamped": worst,
        "max_difference_last_4pi_to_2pi": _each(cases, lambda case: _off(case, last, 1)),
        "alignment_section": "second" if case.long_shift else "first",
        "clearance_4pi_damped": clearance,
    }  # fmt: skip


@claim
def _no_transient(cases):
    case, damped = cases
    states = half_turn_states(case.from_fit)
    worst = float(np.abs(states - states[np.arange(len(states)) % 2]).max())
    left = _settling(damped.from_fit, damped.on_short, 1, 0)
    numbers = {"max_deviation_undamped": worst, "cycle_settled_on_2pi_damped": left}
    return {"cycles": len(states)}, verdict(worst < 1e-8, left is None), numbers


@claim
def _direct_short(cases):
    cycles = cases[0].on_short.impacts.shape[0]
    stays = {name: cycles if x is None else x for name, x in
             _each(cases, lambda case: _staying(case, 0.05)).items()}  # fmt: skip
    held = stays["undamped"]
    words = {"held": "all " * (held == cycles) + str(held)}
    return words, verdict(held >= min(cycles, 100)), {
        "cycles_within_0.05": stays,
        "largest_multiplier_2pi": _each(cases, lambda case: case.growth),
        "cycles": cycles,
    }  # fmt: skip


@claim
def _maximum(panels, cases):
    stop, undamped = float(cases[0].scene.stops[0].gap), cases[0]
    ends = _each(cases, lambda case: float(np.asarray(case.from_rest.y_max)[-2:].max()))
    top = {
        "simulation": ends["undamped"],
        "closed_form_2pi": float(undamped.short.y_max[0]),
        "closed_form_4pi": float(undamped.long.y_max[0]),
        "simulation_damped": ends["damped"],
    }
    worst = max(abs(y - stop) for y in top.values())
    off = "are the stop to the last bit"
    if worst:
        off = f"differ from the stop by at most {worst:.1g}"
    swept = _sweeps(panels).values()
    values, struck = (sum(at[name] for at in swept) for name in ("values", "impacting"))
    wide = max((at["maximum_off"] for at in swept), default=0.0)
    return {"off": off}, verdict(max(worst, wide) < 1e-9 and struck == values), {
        "stop": stop,
        "maximum": top,
        "figure_2_values": values,
        "figure_2_values_with_impacts": struck,
        "figure_2_largest_difference": wide,
    }  # fmt: skip


@claim
def _minimum(cases):
    simulated = _each(cases, lambda case: last_minima(case.from_rest)[0])
    analysis = _each(cases, lambda case: case.short_minimum)
    differ = {name: abs(simulated[name] - analysis[name]) > 0.1 for name in simulated}
    return {}, verdict(differ["undamped"], differ["damped"]), {
        "simulated": simulated,
        "closed_form_2pi": analysis,
        "closed_form_4pi_undamped": float(cases[0].long.y_min[0]),
    }  # fmt: skip


def _sweeps(panels: list[dict]) -> dict[str, dict]:
    """Return the sweeps of all panels, by their panel and direction in words."""
    return {f"{in_words(panel)}, {name}": at for panel in panels for name, at in
            panel["sweeps"].items()}  # fmt: skip


@claim
def _free(found):
    off, count = {}, 0
    for system in found.systems:
        if not system.damping_ratio:
            continue  # undamped the free vibration never dies out
        free = np.abs(vibration(found.ratios, system.damping_ratio))
        for name, at in system.sweeps.items():
            quiet = np.asarray(at.impacts) == 0
            both = np.abs(np.stack([at.y_max - free, at.y_min + free]))[:, quiet]
            off[f"k = {system.restitution:g}, {name}"] = float(both.max())
            count += int(quiet.sum())
    worst = max(off.values())
    words = {"quiet": count, "worst": worst, "A": 1 / np.abs(1 - np.array([0.6, 1.4]) ** 2)}
    return words, verdict(worst < 1e-6), {"largest_difference_damped": off}


@claim
def _everywhere(panels):
    apart = {name: (at["apart"], at["values"]) for name, at in _sweeps(panels).items()}
    some, full = (sum(x[i] for x in apart.values()) for i in (0, 1))
    pattern = "k = {0[restitution]:g}, ξ = {0[damping_ratio]:.3f}: {0[BB]:.5f} to {0[CC]:.5f}"
    words = {"some": some, "all": full, "lines": listed(pattern, panels)}
    return words, verdict(True, some == full, PARTLY), {"apart_and_values": apart}


@claim
def _reason(panels):
    parts = [(name, *shares(at)) for name, at in _sweeps(panels).items()]
    numbers = {name: {"4pi_one_impact": one, "any_4pi": four} for name, one, four in parts}
    named = any(one for _, one, _ in parts)
    return {"parts": listed("{} {:.0%} and {:.0%}", parts)}, verdict(named, False, PARTLY), numbers


@claim
def _wall(panels):
    keys = "values", "analysis_clear_of_the_wall", "sweep_reaches_the_wall"
    counts = {name: [at[key] for key in keys] for name, at in _sweeps(panels).items()}
    clear = all(free == values for values, free, _ in counts.values())
    reach = [reached for *_, reached in counts.values()]
    parts = listed("{} {} of {}", [(name, x[2], x[0]) for name, x in counts.items()])
    words = {"where": "everywhere" if clear else "not everywhere", "parts": parts}
    numbers = {"wall": WALL, "values_clear_reached": counts}
    return words, verdict(clear and any(reach), all(reach), PARTLY), numbers


@claim
def _crank_phase(case):
    cycles, size = sampled(case.from_rest)[0].shape
    short = sampled(case.on_short)[0][0]
    apart, ends = {}, []
    for i in range(_PHASES):
        scene = case.scene.at_section(2 * np.pi * i / _PHASES)
        Y = sampled(run_of(scene, scene.start(), cycles, size))[0]
        off = np.abs(Y - np.roll(short, -size * i // _PHASES))
        apart[f"{2 * i / _PHASES:g}"] = off[2:4].max(axis=1).tolist()
        ends.append(float(Y[-2:].min()))
    near = [max(x) < _NEAR for x in apart.values()]
    settled = all(abs(y - float(case.long.y_min[0])) < 1e-2 for y in ends)
    parts = listed("{:.2f}/{:.2f} at {}π", [(*x, name) for name, x in apart.items()], ", ")
    words = {"parts": parts, "settled": "all" if settled else "not all"}
    numbers = {"max_difference_cycles_3_4_by_phase_over_pi": apart, "last_minima": ends}
    return words, verdict(near[0], all(near), PARTLY), numbers


@claim
def _cosine(case):
    exact = Parameters().scene(crank="slider").crank
    assert isinstance(exact, SliderCrank)
    scene = Scene.ideal(
        frequency_ratio=FREQUENCY_RATIO, restitution=RESTITUTION, gap=GAP, crank=exact
    )
    start = scene.start(Y=case.long.Y[0], V=case.long.V[0])
    run = simulate(scene, start, CYCLES, throw=True)
    Y, impacts = np.asarray(run.sections.Y), int(np.sum(np.asarray(run.impacts)[-2:]))
    repeats, words = float(np.abs(Y[-1] - Y[-3])), {"cycles": CYCLES, "impacts": impacts}
    return words, verdict(repeats < 1e-6 and impacts == 1), {
        "minima_exact": last_minima(run),
        "minima_cosine": last_minima(case.from_long),
        "repeats_to": repeats,
    }  # fmt: skip


@claim
def _motor(motors):
    numbers = {
        f"{run.torque:g}": {
            "kappa": run.kappa,
            "frequency_ratio": mean_ratio(run.orbit),
            "minimum": float(run.orbit.y_min),
            "largest_multiplier": float(abs(complex(run.orbit.multipliers[0]))),
            "minima_cycles_3_4_from_rest": np.asarray(run.from_rest.y_min)[2:4].tolist(),
            "last_minima_from_rest": last_minima(run.from_rest),
        }
        for run in motors
    }
    parts = listed(
        "T0 = {0} N·m, κ = {1[kappa]:.4f}: minimum {1[minimum]:.3f}, largest multiplier "
        "{1[largest_multiplier]:.3f}, from rest {1[minima_cycles_3_4_from_rest][0]:.2f} and "
        "{1[minima_cycles_3_4_from_rest][1]:.2f} in cycles 3 and 4, "
        "{1[last_minima_from_rest][0]:.3f} in the end",
        numbers.items(),
    )
    same = all(
        x["largest_multiplier"] < 1 and abs(x["last_minima_from_rest"][0] - x["minimum"]) < 1e-6
        for x in numbers.values()
    )
    return {"parts": parts}, verdict(same), {"by_torque": numbers}


@claim
def _even_speed(case, motors):
    variation = {f"{run.torque:g}": run.speed_variation for run in motors}
    parts = listed("{1:.2%} with T0 = {0}", variation.items(), ", ").replace("%", " %")
    off = max(abs(float(run.orbit.y_min - case.long.y_min[0])) for run in motors)
    words = {"parts": parts, "off": off}
    return words, verdict(max(variation.values()) < 0.1), {"variation_by_torque": variation}
