"""Assumptions of the paper behind Figures 3 and 4, each with the size of its effect."""

from typing import Any

import numpy as np
from vi_jax.flow import simulate
from vi_jax.machine import Parameters, Scene, SliderCrank

from .claims import CONFIRMED, CONTRADICTED, PARTLY, Claim
from .motions import CYCLES, FREQUENCY_RATIO, GAP, RESTITUTION, Case, last_minima, run_of, sampled
from .motors import Motors
from .orbits import mean_ratio

# Number of crank angles at the start: each is a multiple of an eighth of a turn.
_PHASES = 8
# A start within this distance of the 2π motion counts as near (unit: a): a choice.
_NEAR = 0.3


def check_assumptions(case: Case) -> list[Claim]:
    """Measure the assumptions of the ideal machine, on the undamped case."""
    return [_crank_phase(case), _cosine(case)]


def check_motor(motors: Motors) -> list[Claim]:
    """Measure the assumptions about the motor, on the runs with motors."""
    return [_motor(motors), _even_speed(motors)]


def _crank_phase(case: Case) -> Claim:
    cycles = case.from_rest.impacts.shape[0]
    size = sampled(case.from_rest)[2]
    short = sampled(case.on_short)[0][0]
    apart, ends = {}, []
    for i in range(_PHASES):
        scene = case.scene.at_section(2 * np.pi * i / _PHASES)
        Y = sampled(run_of(scene, scene.start(), cycles, size))[0]
        off = np.abs(Y - np.roll(short, -size * i // _PHASES))
        apart[f"{2 * i / _PHASES:g}"] = off[2:4].max(axis=1).tolist()
        ends.append(float(Y[-2:].min()))
    listed = ", ".join(f"{x[0]:.2f}/{x[1]:.2f} at {name}π" for name, x in apart.items())
    near = [max(x) < _NEAR for x in apart.values()]
    long = float(case.long.y_min[0])
    settled = all(abs(y - long) < 1e-2 for y in ends)
    return Claim(
        "the start's crank phase",
        "Fig. 3 a, conclusion",
        "From zero position and velocity the motion begins near the 2π motion; the crank's angle "
        "at the start is not given, and taken as φ(0) = 0.",
        f"Greatest |Y - Y(2π)| in the third/fourth cycle by φ(0): {listed}. The motion ends on the "
        f"4π motion from {'all' if settled else 'not all'} of these, but is near the 2π motion "
        "before from some only.",
        (CONFIRMED if all(near) else PARTLY) if near[0] else CONTRADICTED,
        {"max_difference_cycles_3_4_by_phase_over_pi": apart, "last_minima": ends},
    )


def _cosine(case: Case) -> Claim:
    exact = Parameters().scene(crank="slider").crank
    assert isinstance(exact, SliderCrank)
    scene = Scene.ideal(
        frequency_ratio=FREQUENCY_RATIO, restitution=RESTITUTION, gap=GAP, crank=exact
    )
    start = scene.start(Y=case.long.Y[0], V=case.long.V[0])
    run = simulate(scene, start, CYCLES, throw=True)
    Y = np.asarray(run.sections.Y)
    repeats = float(np.abs(Y[-1] - Y[-3]))
    minima, cosine = last_minima(run), last_minima(case.from_long)
    impacts = int(np.sum(np.asarray(run.impacts)[-2:]))
    return Claim(
        "the cosine in the crank's place (Eq. 4)",
        "Eq. 4",
        "u(φ) = l + a cos φ is a first approximation; Table 1 has a/l = 1/3.",
        f"With the exact crank the 4π motion survives: {CYCLES} cycles from the cosine's state it "
        f"repeats to {repeats:.0e} with {impacts} impact, minima {minima[0]:.4f} and "
        f"{minima[1]:.4f} (cosine {cosine[0]:.4f} and {cosine[1]:.4f}).",
        CONFIRMED if repeats < 1e-6 and impacts == 1 else CONTRADICTED,
        {"minima_exact": minima, "minima_cosine": cosine, "repeats_to": repeats},
    )


def _motor(motors: Motors) -> Claim:
    numbers: dict[str, Any] = {}
    for run in motors.runs:
        minima = np.asarray(run.from_rest.y_min)
        numbers[f"{run.torque:g}"] = {
            "kappa": run.kappa,
            "frequency_ratio": mean_ratio(run.orbit),
            "minimum": float(run.orbit.y_min),
            "largest_multiplier": float(abs(complex(run.orbit.multipliers[0]))),
            "minima_cycles_3_4_from_rest": minima[2:4].tolist(),
            "last_minima_from_rest": last_minima(run.from_rest),
        }
    listed = "; ".join(
        f"T0 = {name} N·m, κ = {x['kappa']:.4f}: minimum {x['minimum']:.3f}, largest multiplier "
        f"{x['largest_multiplier']:.3f}, from rest {x['minima_cycles_3_4_from_rest'][0]:.2f} and "
        f"{x['minima_cycles_3_4_from_rest'][1]:.2f} in cycles 3 and 4, "
        f"{x['last_minima_from_rest'][0]:.3f} in the end"
        for name, x in numbers.items()
    )
    same = all(
        x["largest_multiplier"] < 1 and abs(x["last_minima_from_rest"][0] - x["minimum"]) < 1e-6
        for x in numbers.values()
    )
    return Claim(
        "Figures 3 and 4 with the motor",
        "Title, Eq. 7; Fig. 3, 4",
        "The motions are those of the system with non-ideal excitation; the figures are computed "
        "with an ideal one.",
        f"Undamped, k = 0.50, κ tuned to a mean ζ of 0.90: {listed}.",
        CONFIRMED if same else CONTRADICTED,
        {"by_torque": numbers},
    )


def _even_speed(motors: Motors) -> Claim:
    variation = {f"{run.torque:g}": run.speed_variation for run in motors.runs}
    listed = ", ".join(f"{100 * x:.2f} % with T0 = {name}" for name, x in variation.items())
    return Claim(
        "the speed hardly varies within a cycle (Eq. 10)",
        "Eq. 10 to 12",
        "Ω = Ωa + ε f(φ), with a small ε whose terms are dropped.",
        f"On the 4π motions tuned to ζ = 0.90 the crank's speed varies by {listed} N·m of its "
        "mean, from least to greatest. Their minima differ from the ideal drive's by as much as "
        f"{max(abs(float(r.orbit.y_min) - float(motors.ideal_minimum)) for r in motors.runs):.3f}.",
        CONFIRMED if max(variation.values()) < 0.1 else CONTRADICTED,
        {"variation_by_torque": variation},
    )
