"""The motions of Figure 2's sweeps between BB' and CC', the range of the paper's discrepancy."""

from typing import Any, NamedTuple

import numpy as np
from vi_jax.orbit import ClosedFormOrbits

from .motions import GAP
from .response import LONGEST, WALL, Response, System

# A motion without a period counts as chaotic beyond this exponent (per drive cycle): a choice.
_CHAOS = 0.01
# A minimum farther than this from that of the 2π analysis counts as apart (unit: a).
_APART = 1e-3


def _stable(closed: ClosedFormOrbits) -> np.ndarray:
    """Return the mask of the ζ at which the first closed form is admissible and stable."""
    return closed.admissible[:, 0] & (np.abs(closed.multipliers[:, 0]).max(axis=-1) < 1)


class Row(NamedTuple):
    """One motion that a sweep follows over neighbouring ζ."""

    part: np.ndarray
    """Indices into the values of ζ."""
    cycles: int
    """Period in drive cycles, or a code of `REGIMES` below zero if none was found."""
    impacts: float
    """Impacts in a period; without a period, the mean per cycle."""
    exponent: float
    """Median of the largest Lyapunov exponents if there is no period, else NaN."""

    @property
    def motion(self) -> str:
        """The period and the number of impacts in words, or the kind of motion without a period."""
        if self.cycles <= 0:
            if self.exponent > _CHAOS:
                return "chaotic"
            return f"period over {2 * LONGEST}π" if self.exponent < -_CHAOS else "no period found"
        count = round(self.impacts)
        return f"{2 * self.cycles}π, {count} impact{'' if count == 1 else 's'}"


def rows(system: System, direction: str, inside: np.ndarray) -> list[Row]:
    """Return the motions that a sweep follows over the indices `inside` of ζ."""
    at, exponent = system.sweeps[direction], system.exponents[direction]
    period, impacts = np.asarray(at.period), np.asarray(at.impacts)
    kind = np.stack([period, np.where(period > 0, np.round(impacts), exponent > _CHAOS)])[:, inside]
    found = []
    for part in np.split(inside, 1 + np.flatnonzero(np.any(np.diff(kind), axis=0))):
        cycles = int(period[part[0]])
        middle = float(np.median(exponent[part])) if cycles <= 0 else float("nan")
        found.append(Row(part, cycles, float(np.mean(impacts[part])), middle))
    return found


def between(system: System, ratios: np.ndarray) -> np.ndarray:
    """Return the indices of the ζ between BB' and CC'."""
    return np.flatnonzero((ratios > system.stretch[0]) & (ratios < system.stretch[1]))


def describe(found: Response) -> dict[str, Any]:
    """Describe the differences between numerical minimum and 2π analysis, and the motions there.

    The result has only floats, integers, strings, lists and `None`. "apart" counts the values with
    |min Y - min Y of the 2π closed form| > 1e-3. "on_the_4pi_curve" compares all values at which
    the one-impact 4π motion is admissible and stable.
    """
    return {
        "printed": "The text sees a discrepancy between BB' and CC', in the minimum only, and puts "
        "it down to a motion of period 4π. It gives no ζ for the two lines and no place for the "
        "wall drawn below.",
        "panels": [_panel(found, system) for system in found.systems],
    }


def _panel(found: Response, system: System) -> dict[str, Any]:
    ratios, inside = found.ratios, between(system, found.ratios)
    directions = {}
    for name, at in system.sweeps.items():
        y_min, y_max = np.asarray(at.y_min), np.asarray(at.y_max)
        short, long = system.closed[1], system.closed[2]
        off = np.abs(y_min - short.y_min[:, 0])
        apart = inside[off[inside] > _APART]
        stable = np.flatnonzero(_stable(long))
        on_it = np.abs(y_min - long.y_min[:, 0])[stable] < 1e-6
        widest = inside[np.argmax(off[inside])]
        impacting = inside[np.asarray(at.impacts)[inside] > 0]
        reach, clear = y_min[inside] < WALL, short.y_min[inside, 0] > WALL
        directions[name] = {
            "values": len(inside),
            "apart": len(apart),
            "widest": float(off[widest]),
            "widest_at": float(ratios[widest]),
            "maximum_off": float(np.max(np.abs(y_max[impacting] - GAP))),
            "impacting": len(impacting),
            "analysis_clear_of_the_wall": int(clear.sum()),
            "sweep_reaches_the_wall": int((reach & clear).sum()),
            "on_the_4pi_curve": {
                "stable_values": len(stable),
                "on_it": int(on_it.sum()),
            },
            "motions": [_motion(ratios, row) for row in rows(system, name, inside)],
        }
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
        "sweeps": directions,
    }  # fmt: skip


def shares(sweep: dict[str, Any]) -> tuple[float, float]:
    """Return the shares of a sweep on the 4π motion with one impact, and on all 4π motions."""
    one, four = (
        sum(m["values"] for m in sweep["motions"] if fits(m["motion"])) / sweep["values"]
        for fits in (lambda x: x == "4π, 1 impact", lambda x: x.startswith("4π"))
    )
    return one, four


def _motion(ratios: np.ndarray, row: Row) -> dict[str, Any]:
    return {
        "motion": row.motion,
        "from": float(ratios[row.part[0]]),
        "to": float(ratios[row.part[-1]]),
        "values": len(row.part),
        "impacts_per_2pi": row.impacts / max(row.cycles, 1),
        "exponent": row.exponent if np.isfinite(row.exponent) else None,
    }
