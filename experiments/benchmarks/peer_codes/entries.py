"""The codes that `peers.py` runs, their options, and the distribution of their lanes."""

import sys
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .pool import cores

QUICK = "--quick" in sys.argv
LANES, CYCLES, ROUNDS, SLOW_ROUNDS = (256, 20, 3, 1) if QUICK else (1024, 200, 5, 3)
KAPPA = np.linspace(0.5, 1.9, LANES)
OURS = "vi_jax"


@dataclass(frozen=True)
class Entry:
    """A code with its options, and the distribution of its lanes."""

    name: str
    code: str
    options: dict[str, Any] = field(default_factory=dict)
    block: int = 16
    every: int = 1

    @property
    def rounds(self) -> int:
        """The number of rounds, smaller for slow codes."""
        return ROUNDS if self.every == 1 else SLOW_ROUNDS


def ours(name: str, number: float = 0.0) -> Entry:
    """Return an entry of vi_jax."""
    inside = "" if not number else f"{number:g}"
    if name == "Taylor" and number > 1:
        inside += ", 8 steps"
    elif name == "FixedStep":
        inside = f"Verner9, {inside}"
    return Entry(f"{OURS} {name}({inside})", "ours", {"name": name, "number": number})


def heyoka(tol: float, **options: Any) -> Entry:
    """Return an entry of heyoka in batch mode."""
    return Entry(f"heyoka batch 8, {tol:.0e}", "heyoka_taylor", {"tol": tol, **options})


def entries(drive: str, all_cores: bool) -> list[Entry]:
    """Return all codes for one machine."""
    sparse = LANES // 8 if not all_cores else LANES // (8 if len(cores()) > 8 else 16)
    motor = [("FixedStep", n) for n in (5, 6, 8, 10, 12, 16, 20, 24)]
    motor += [("Taylor", n) for n in (14, 16, 18)] + [("Taylor", 1e-12), ("Taylor", 1e-13)]
    methods = motor if drive == "motor" else [("ExactFlight", 0), ("FixedStep", 10)]
    listed = [ours(*method) for method in methods]
    listed += [heyoka(tol) for tol in (1e-6, 1e-9, 1e-15)]
    scalar = {"tol": 1e-9, "batch": 1}
    listed += [Entry("heyoka scalar, 1e-09", "heyoka_taylor", scalar, every=4)]
    listed += [
        Entry(f"numba Dormand–Prince, {tol:.0e}", "numba_rk", {"tol": tol}, every=4)
        for tol in (1e-6, 1e-9)
    ]
    listed += [
        Entry(
            f"diffrax Event {solver}, {tol:.0e}",
            "diffrax_event",
            {"solver": solver, "tol": tol},
            block=64,
            every=4,
        )
        for solver, tol in (("Tsit5", 1e-6), ("Dopri8", 1e-9))
    ]
    return [
        *listed,
        Entry("SciPy DOP853, 1e-09", "scipy_ivp", {"tol": 1e-9}, block=1, every=sparse),
    ]


def derivative_entries() -> list[Entry]:
    """Return the codes with derivatives in six parameters, each after its primal."""
    listed = []
    for method in (("FixedStep", 6), ("FixedStep", 10), ("FixedStep", 16), ("Taylor", 1e-12)):
        primal = ours(*method)
        with_six = Entry(primal.name + " six jvp", "ours", {**primal.options, "jacobian": True})
        listed += [primal, with_six]
    for tol in (1e-6, 1e-9, 1e-15):
        options = {"tol": tol, "jacobian": True}
        named = f"heyoka variational, saltation by hand, {tol:.0e}"
        listed += [heyoka(tol), Entry(named, "heyoka_taylor", options)]
    return listed
