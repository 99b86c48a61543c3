"""The errors in the paper's printed text, each a row with the number that shows it."""

from typing import Any

import numpy as np
from vi_jax.flow import simulate
from vi_jax.machines import Parameters
from vi_jax.orbit import closed_form_orbits

from .motions import FREQUENCY_RATIO, GAP, RESTITUTION, figure_scene
from .printed import energy_drift, eq21_misses
from .rows import Row, fault, listed


def check_faults() -> list[Row]:
    """Measure each fault of the printed text."""
    checks = (
        _inertia_term, _coupling, _phase, _no_load_speed, _captions, _damping, _lever, _disc,
        _lines,
    )  # fmt: skip
    return [check(number=number) for number, check in enumerate(checks, 1)]


def _drift(**printed: float) -> float:
    """Return the `energy_drift` of Table 1's machine with other coefficients."""
    return energy_drift(**_groups(), **printed)


def _groups() -> dict[str, float]:
    """Return ε and μ of Table 1's machine, as arguments of `energy_drift`."""
    drive: Any = Parameters().scene().drive
    return {"coupling": float(drive.coupling), "slider_inertia": float(drive.slider_inertia)}


def _table(*names: str) -> list[float]:
    """Return numbers of Table 1."""
    return [float(getattr(Parameters(), name)) for name in names]


@fault
def _inertia_term():
    inertia, (radius,) = _groups()["slider_inertia"], _table("crank_radius")
    return {}, {
        "energy_drift_printed_in_metres": _drift(printed_inertia=inertia / radius),
        "energy_drift_printed_in_crank_radii": _drift(printed_inertia=inertia),
        "energy_drift_right": _drift(),
    }


@fault
def _coupling():
    (c, k0), right = _table("damping", "stiffness"), _groups()["coupling"]
    printed = c / k0 * right
    return {"c": c, "k0": k0}, {
        "coupling_printed": printed,
        "coupling_right": right,
        "energy_drift_printed": _drift(printed_coupling=printed),
        "energy_drift_right": _drift(),
    }


@fault
def _phase():
    numbers, items = {}, []
    for n in (1, 2):
        forms = {
            name: eq21_misses(FREQUENCY_RATIO, RESTITUTION, GAP, n, printed=name == "printed")
            for name in ("printed", "right")
        }
        numbers[f"{2 * n}pi"] = forms
        worst = (max(x["miss_17_before"], x["miss_17_after"]) for x in forms.values())
        items.append((2 * n, *worst))
    return {"missed": listed("{1:.2g} ({0}π; with ζ {2:.0e})", items, " and ")}, numbers


def _settled_ratio(kappa: float, factor: float) -> float:
    """Return ζ at which a strong motor with this κ settles, for Ω0 = factor ω."""
    table = Parameters(torque=100.0, control=kappa)
    free = factor * float(table.natural_frequency)
    scene = Parameters(torque=100.0, control=kappa, no_load_speed=free).scene()
    run = simulate(scene, scene.start(), 120, throw=True)
    assert run.frequency_ratio is not None
    return float(run.frequency_ratio[-20:].mean())


@fault
def _no_load_speed():
    numbers = {
        name: {f"{kappa}": _settled_ratio(kappa, factor) for kappa in (0.5, 0.9, 1.9)}
        for name, factor in (("omega", 1.0), ("2 omega", 2.0))
    }
    omega, twice = (listed("{:.4f}", x.values(), ", ") for x in numbers.values())
    return {"omega": omega, "twice": twice}, {"frequency_ratio_by_kappa": numbers}


@fault
def _captions():
    wide = 2 / (1 - FREQUENCY_RATIO**2)
    narrow, broad = (
        sum(int(np.sum(closed_form_orbits(scene, cycles=n).admissible)) for n in (1, 2))
        for scene in (figure_scene(0.0), figure_scene(0.0, gap=wide))
    )
    return {"wide": wide}, {
        "amplitude_A": wide / 2,
        "motions_with_gap_2a": narrow,
        "motions_with_gap_2A": broad,
    }


def period_doubling_damping() -> float:
    """Return the c (N·s/m) at which a multiplier of the 2π motion of Figure 3 crosses -1."""
    low, high = 0.0, 0.5
    for _ in range(50):
        middle = 0.5 * (low + high)
        unstable = np.min(np.real(_multipliers(middle))) < -1
        low, high = (middle, high) if unstable else (low, middle)
    return low


def _multipliers(c: float) -> np.ndarray:
    """Return the multipliers of the 2π motion of Figure 3 with the damping c (N·s/m)."""
    ratio = Parameters(damping=c).scene(drive="ideal").damping_ratio
    return np.asarray(closed_form_orbits(figure_scene(ratio), cycles=1).multipliers[0])


@fault
def _damping():
    (c,) = _table("damping")
    undamped, damped = (float(np.abs(_multipliers(x)).max()) for x in (0.0, c))
    return {"c": c, "undamped": undamped, "damped": damped}, {
        "largest_multiplier_by_c": {"0": undamped, f"{c:g}": damped},
        "period_doubling_c": period_doubling_damping(),
    }


@fault
def _lever():
    J, rod = _table("inertia", "rod_length")
    # A uniform rod about its end.
    return {"J": J, "rod": rod}, {"mass_of_such_a_lever": 3 * J / rod**2}


@fault
def _disc():
    J, radius, body = _table("inertia", "crank_radius", "body_mass")
    words = {"J": J, "radius": radius, "body": body}
    return words, {"mass_of_the_disc": 2 * J / radius**2, "coupling": body * radius**2 / J}


@fault
def _lines():
    return {}, {"styles_that_differ": 2, "styles": 4}
