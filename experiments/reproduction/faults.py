"""The errors in the paper's printed text, each with the number that shows it."""

from typing import Any, NamedTuple

import numpy as np
from vi_jax.flow import simulate
from vi_jax.machine import Parameters
from vi_jax.orbit import closed_form_orbits

from .motions import FREQUENCY_RATIO, GAP, RESTITUTION, figure_scene
from .printed import energy_drift, eq21_misses


class Fault(NamedTuple):
    """One fault of the printed text."""

    number: int
    place: str
    printed: str
    right: str
    measured: str
    """One sentence with the numbers that show it."""
    numbers: dict[str, Any]


def check_faults() -> list[Fault]:
    """Measure each fault of the printed text."""
    return [
        _inertia_term(), _coupling(), _phase(), _no_load_speed(), _captions(), _damping(),
        _lever(), _disc(), _lines(),
    ]  # fmt: skip


def _groups() -> dict[str, float]:
    """Return ε and μ of Table 1's machine, as arguments of `energy_drift`."""
    drive: Any = Parameters().scene().drive
    return {"coupling": float(drive.coupling), "slider_inertia": float(drive.slider_inertia)}


def _inertia_term() -> Fault:
    groups, a = _groups(), float(Parameters().crank_radius)
    inertia = groups["slider_inertia"]
    right, metres, radii = (
        energy_drift(**groups, printed_inertia=value) for value in (0.0, inertia / a, inertia)
    )
    return Fault(
        1,
        "Eq. 1, drive equation",
        "m_B φ'² u''(φ)",
        "m_B φ'² u'(φ) u''(φ), as Eq. 5 has it",
        f"With T0 = 0, c = 0, k = 1 the energy must stay. Over 20 natural periods it drifts by "
        f"{metres:.1e} of itself as printed with lengths in metres, by {radii:.1e} with lengths "
        f"in units of a (the printed term is a force, so that its effect depends on the unit), "
        f"and by {right:.1e} with the factor u'.",
        {
            "energy_drift_printed_in_metres": metres,
            "energy_drift_printed_in_crank_radii": radii,
            "energy_drift_right": right,
        },
    )


def _coupling() -> Fault:
    table, groups = Parameters(), _groups()
    share, coupling = float(table.damping) / float(table.stiffness), groups["coupling"]
    right = energy_drift(**groups)
    printed = energy_drift(**groups, printed_coupling=share * coupling)
    return Fault(
        2,
        "Eq. 1, 5, 7, 9, drive equation",
        "c u'(φ)(x - l0 - u(φ)), a product in N·m·s (c is the damping of Table 1)",
        "k0 u'(φ)(x - l0 - u(φ)), in N·m",
        f"The number {float(table.damping):g} for c in place of {float(table.stiffness):.4g} for "
        f"k0 makes the coupling {share * coupling:.3e} instead of {coupling:.3e}; with T0 = 0, no "
        f"damping and k = 1 the energy then drifts by {printed:.1e} of itself over 20 natural "
        f"periods, with k0 by {right:.1e}.",
        {
            "coupling_printed": share * coupling,
            "coupling_right": coupling,
            "energy_drift_printed": printed,
            "energy_drift_right": right,
        },
    )


def _phase() -> Fault:
    numbers: dict[str, Any] = {}
    words = []
    for n in (1, 2):
        forms = {
            name: eq21_misses(FREQUENCY_RATIO, RESTITUTION, GAP, n, printed=name == "printed")
            for name in ("printed", "right")
        }
        numbers[f"{2 * n}pi"] = forms
        worst = {
            name: max(form["miss_17_before"], form["miss_17_after"]) for name, form in forms.items()
        }
        words.append(f"{worst['printed']:.2g} ({2 * n}π; with ζ {worst['right']:.0e})")
    return Fault(
        3,
        "Eq. 21",
        "cos φ0 = Δ/A + (1 + k)/(2A) cot(2π/ζ) v0",
        "cos φ0 = Δ/A + ζ (1 + k)/(2A) cot(2π/ζ) v0 (4π; cot(π/ζ) for 2π)",
        "C1 and C2 of Eq. 20 meet the positions (16) with any φ0; the velocities (17) are then "
        f"missed by {' and '.join(words)} a per radian.",
        numbers,
    )


def _no_load_speed() -> Fault:
    kappas = (0.5, 0.9, 1.9)
    numbers: dict[str, Any] = {}
    for name, factor in (("omega", 1.0), ("2 omega", 2.0)):
        ratios = []
        for kappa in kappas:
            table = Parameters(torque=100.0, control=kappa)
            free = factor * float(table.natural_frequency)
            scene = Parameters(torque=100.0, control=kappa, no_load_speed=free).scene()
            run = simulate(scene, scene.start(), 120, throw=True)
            assert run.frequency_ratio is not None
            ratios.append(float(run.frequency_ratio[-20:].mean()))
        numbers[name] = dict(zip(map(str, kappas), ratios, strict=True))
    listed = {
        name: ", ".join(f"{x:.4f}" for x in ratios.values()) for name, ratios in numbers.items()
    }
    return Fault(
        4,
        "Eq. 3, Table 1",
        "Ω0 is never given",
        "Ω0 = ω (w0 = 1), by default",
        f"A strong motor (T0 = 100 N·m) at κ = 0.5, 0.9, 1.9 settles at ζ = {listed['omega']} with "
        f"Ω0 = ω: the tabulated κ = 0.5…1.9 is then the range of ζ. With Ω0 = 2ω it is "
        f"{listed['2 omega']}.",
        {"frequency_ratio_by_kappa": numbers},
    )


def _captions() -> Fault:
    amplitude = 1 / (1 - FREQUENCY_RATIO**2)
    scene = figure_scene(0.0)
    wide = figure_scene(0.0, gap=2 * amplitude)
    counts = {
        name: int(sum(int(np.sum(closed_form_orbits(s, cycles=n).admissible)) for n in (1, 2)))
        for name, s in (("2a", scene), ("2A", wide))
    }
    return Fault(
        5,
        "captions of Fig. 2 to 4",
        '"Δ=2A", "K", "Z" in capitals',
        "Δ = 2a, k, ζ",
        f"A is the amplitude in Eq. 15, {amplitude:.4f}a at ζ = 0.9. The gap 2a has "
        f"{counts['2a']} impact motions of period 2π or 4π in closed form, a gap of 2A = "
        f"{2 * amplitude:.2f}a has {counts['2A']}.",
        {"amplitude_A": amplitude, "motions_with_gap_2a": counts["2a"],
         "motions_with_gap_2A": counts["2A"]},
    )  # fmt: skip


def period_doubling_damping() -> float:
    """Return the c (N·s/m) at which a multiplier of the 2π motion of Figure 3 crosses -1."""

    low, high = 0.0, 0.5
    for _ in range(50):
        middle = 0.5 * (low + high)
        unstable = np.min(np.real(np.asarray(_multipliers(middle)))) < -1
        low, high = (middle, high) if unstable else (low, middle)
    return low


def _multipliers(c: Any) -> Any:
    """Return the multipliers of the 2π motion of Figure 3 with the damping c (N·s/m)."""
    ratio = Parameters(damping=c).scene(drive="ideal").damping_ratio
    return closed_form_orbits(figure_scene(ratio), cycles=1).multipliers[0]


def _damping() -> Fault:
    table = float(Parameters().damping)
    largest = {f"{c:g}": float(np.abs(np.asarray(_multipliers(c))).max()) for c in (0.0, table)}
    crossing = period_doubling_damping()
    with_zero, with_table = largest["0"], largest[f"{table:g}"]
    return Fault(
        6,
        "Fig. 3 and 4, Table 1",
        f"the figures, with Table 1's c = {table:g} N·s/m",
        "c = 0 (Eq. 12 drops the damping)",
        f"Largest |multiplier| of the 2π motion: {with_table:.4f} with c = {table:g} (stable), "
        f"{with_zero:.4f} with c = 0 (unstable); it crosses -1 at c = {crossing:.4f} N·s/m.",
        {"largest_multiplier_by_c": largest, "period_doubling_c": crossing},
    )


def _lever() -> Fault:
    table = Parameters()
    J, rod = float(table.inertia), float(table.rod_length)
    mass = 3 * J / rod**2  # a uniform rod about its end
    return Fault(
        7,
        "Table 1",
        "J is the moment of inertia of the lever",
        "J is that of the disc on the shaft, as the text has it",
        f"The text calls the lever massless, and J is the shaft's in Eq. 1. A lever of {rod:g} m "
        f"with J = {J:g} kg·m² about its end would weigh {mass:.1f} kg.",
        {"mass_of_such_a_lever": mass},
    )


def _disc() -> Fault:
    table = Parameters()
    J, radius = float(table.inertia), float(table.crank_radius)
    mass = 2 * J / radius**2
    body = float(table.body_mass)
    return Fault(
        8,
        "Table 1",
        f"J = {J:g} kg·m² for a homogeneous disc of radius {radius:g} m",
        "J as printed, as the inertia of everything on the shaft",
        f"Such a disc weighs 2J/a² = {mass:.0f} kg, beside a body of {body:g} kg. What that does: "
        f"ε = m_C a²/J = {float(body * radius**2 / J):.5f}, so that the body hardly slows the "
        "shaft.",
        {"mass_of_the_disc": mass, "coupling": body * radius**2 / J},
    )


def _lines() -> Fault:
    return Fault(
        9,
        "Fig. 2, caption and text",
        "caption: blue and red solid lines, black circles and red dots; text: a solid blue and a "
        "dashed red curve, black and red circles",
        "which of the curves is dashed cannot be told; here dashed is unstable",
        "Caption and text differ in 2 of the 4 styles: the red curve (solid; dashed) and the red "
        "marks of the close-down (dots; circles).",
        {"styles_that_differ": 2, "styles": 4},
    )
