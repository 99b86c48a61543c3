"""The motions of Figure 2's sweeps between BB' and CC', the range of the paper's discrepancy."""

from typing import Any

import numpy as np

from .motions import GAP
from .response import LONGEST, WALL, Response, System
from .rows import WORDS

# A motion without a period counts as chaotic beyond this exponent (per drive cycle): a choice.
_CHAOS = 0.01
# A minimum farther than this from that of the 2π analysis counts as apart (unit: a).
_APART = 1e-3


def motion_name(cycles: int, impacts: int) -> str:
    """Return the period and the number of impacts in words."""
    return f"{2 * cycles}π, {impacts} impact{'' if impacts == 1 else 's'}"


def in_words(panel: dict[str, Any]) -> str:
    """Return k and the damping of a panel in words."""
    return f"k = {panel['restitution']:g}, {'' if panel['damping_ratio'] else 'un'}damped"


def _motion_name(cycles: int, impacts: float, exponent: float) -> str:
    """Return the motion in words, from its period or a code of `REGIMES` below zero, the mean
    number of impacts in a period, and the median of the largest Lyapunov exponents."""
    if cycles > 0:
        return motion_name(cycles, round(impacts))
    if exponent > _CHAOS:
        return "chaotic"
    return f"period over {2 * LONGEST}π" if exponent < -_CHAOS else "no period found"


def _motions(ratios: np.ndarray, system: System, name: str, inside: np.ndarray) -> list[dict]:
    """Return the motions that a sweep follows over the indices `inside` of ζ."""
    at, exponent = system.sweeps[name], system.exponents[name]
    period, impacts = np.asarray(at.period), np.asarray(at.impacts)
    kind = np.stack([period, np.where(period > 0, np.round(impacts), exponent > _CHAOS)])[:, inside]
    found = []
    for part in np.split(inside, 1 + np.flatnonzero(np.any(np.diff(kind), axis=0))):
        cycles, struck = int(period[part[0]]), float(np.mean(impacts[part]))
        middle = float(np.median(exponent[part]))
        found.append({
            "motion": _motion_name(cycles, struck, middle),
            "from": float(ratios[part[0]]),
            "to": float(ratios[part[-1]]),
            "values": len(part),
            "impacts_per_2pi": struck / max(cycles, 1),
            "exponent": middle if np.isfinite(middle) else None,
        })  # fmt: skip
    return found


def describe(found: Response) -> dict[str, Any]:
    """Describe the differences between numerical minimum and 2π analysis, and the motions there, in
    types of JSON. "apart" counts the values with |min Y - min Y of the 2π closed form| > 1e-3,
    "on_the_4pi_curve" those at which the one-impact 4π motion is admissible and stable."""
    panels = [_panel(found.ratios, system) for system in found.systems]
    return {"printed": WORDS["printed"], "panels": panels}


def _panel(ratios: np.ndarray, system: System) -> dict[str, Any]:
    return {
        "restitution": system.restitution,
        "damping_ratio": system.damping_ratio,
        "BB": system.stretch[0],
        "CC": system.stretch[1],
        "special_points": [
            {"cycles": b.cycles, "impacts": b.impact_speed.shape[1], "kind": p.kind,
             "frequency_ratio": p.parameter}
            for b in system.branches for p in b.special
        ],
        "sweeps": {name: _sweep(ratios, system, name) for name in system.sweeps},
    }  # fmt: skip


def _sweep(ratios: np.ndarray, system: System, name: str) -> dict[str, Any]:
    at = system.sweeps[name]
    inside = np.flatnonzero((ratios > system.stretch[0]) & (ratios < system.stretch[1]))
    y_min, y_max = np.asarray(at.y_min), np.asarray(at.y_max)
    short, long = system.closed[1], system.closed[2]
    off = np.abs(y_min - short.y_min[:, 0])
    stable = np.flatnonzero(
        long.admissible[:, 0] & (np.abs(long.multipliers[:, 0]).max(axis=-1) < 1)
    )
    on_it = np.abs(y_min - long.y_min[:, 0])[stable] < 1e-6
    widest = inside[np.argmax(off[inside])]
    impacting = inside[np.asarray(at.impacts)[inside] > 0]
    clear = short.y_min[inside, 0] > WALL
    return {
        "values": len(inside),
        "apart": int(np.sum(off[inside] > _APART)),
        "widest": float(off[widest]),
        "widest_at": float(ratios[widest]),
        "maximum_off": float(np.max(np.abs(y_max[impacting] - GAP))),
        "impacting": len(impacting),
        "analysis_clear_of_the_wall": int(clear.sum()),
        "sweep_reaches_the_wall": int(((y_min[inside] < WALL) & clear).sum()),
        "on_the_4pi_curve": {"stable_values": len(stable), "on_it": int(on_it.sum())},
        "motions": _motions(ratios, system, name, inside),
    }


def shares(sweep: dict[str, Any]) -> tuple[float, float]:
    """Return the shares of a sweep on the 4π motion with one impact, and on all 4π motions."""
    one, four = (
        sum(m["values"] for m in sweep["motions"] if fits(m["motion"])) / sweep["values"]
        for fits in (lambda x: x == "4π, 1 impact", lambda x: x.startswith("4π"))
    )
    return one, four
