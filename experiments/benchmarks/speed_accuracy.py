# %% [markdown]
# # Speed against accuracy
#
# All methods run the same lanes from rest: Table 1's machine (d = 2, k = 0.8; motor: T0 = 10 N·m)
# at 256 values of ζ (ideal drive) or κ (motor) from 0.5 to 1.9. The run time of a method is listed
# with its errors in the state after few and after many cycles, in impact times and counts, and in
# extremes. A scan is judged by the share of wrong *regimes*.
#
# Truth is `ExactFlight` for the ideal drive and 40 steps of Verner9 per cycle for the motor. Errors
# are taken over the lanes that amplify a displacement of 1e-10 to at most 1e-6 in 1,000 cycles. Run
# times are medians of five interleaved rounds of 200 cycles, without compilation. Single-threaded
# programs are timed on one thread.
#
# Run with `python experiments/benchmarks/speed_accuracy.py` (`--quick` for few methods and lanes of
# the ideal drive).

# %%
import sys
import warnings
from pathlib import Path

import jax
import numpy as np

# Single precision is used on purpose.
warnings.filterwarnings("ignore", message="vi_jax is running in single precision")
warnings.filterwarnings("ignore", message="[0-9,]+ of [0-9,]+ lanes failed")

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from benchmarks.accuracy.measures import (
    FEW,
    GRID,
    LANES,
    MANY,
    TIMED,
    differ,
    errors_of,
    observe,
    regimes,
    timed,
)
from benchmarks.accuracy.methods import CHOICES, DRIVES, SCANNED, TRUTH, adaptive, fixed, forget
from benchmarks.accuracy.picture import About, Row, picture
from tools.study import QUICK, say, write
from tools.tables import table
from tools.timing import side_by_side

ROUNDS = 3 if QUICK else 5
TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)

# %% [markdown]
# ## Errors of the motion, errors of regimes, and run times
#
# A run of many cycles from rest gives the states after few and after many cycles. Its first cycles
# give the impact phases, impact counts and extremes. A scan over ζ (or κ) and k gives labels
# (period, impacts per period). A lane is left out if two accurate methods (the truth and `Adaptive`
# at 1e-13) differ: it is chaotic or near a border.


# %%
def rows_of(drive: str) -> tuple[list[Row], About]:
    """Return the rows of all methods with one drive."""
    truth, displaced = observe(TRUTH[drive], drive), observe(TRUTH[drive], drive, shift=1e-10)
    calm = differ(truth.states, displaced.states) < 1e-6
    sure, _ = regimes(TRUTH[drive], drive)
    second, _ = regimes(adaptive("Verner9", 1e-13), drive)
    firm = (sure == second).all(axis=0)
    about = About(int(calm.sum()), int(firm.sum()), int(firm.size))
    say(f"{drive}: {about}")
    found, family = [], ""
    for choice in CHOICES[drive]:
        if choice.family != family or not choice.method.adaptive:
            forget("seen")
        family = choice.family
        errors = errors_of(observe(choice, drive), truth, calm)
        wrong, scanning = np.nan, np.nan
        if choice.name in SCANNED:
            labels, scanning = regimes(choice, drive)
            wrong = float(np.mean((labels != sure).any(axis=0)[firm]))
        found.append((choice, errors, wrong, scanning, timed(choice, drive)))
        say(f"{drive}: {choice.name}: {errors['late95']:.1e}, regimes wrong {wrong:.4f}")
    seconds = side_by_side([program.run for *_, program in found], ROUNDS)
    forget("seen", "timed")
    rows = [
        Row(choice, errors, program.compiling, took, wrong, scanning)
        for (choice, errors, wrong, scanning, program), took in zip(found, seconds, strict=True)
    ]
    return rows, about


results = {drive: rows_of(drive) for drive in DRIVES}

say("measured")

# %% [markdown]
# ## Tables


# %%
def fastest(rows: list[Row], target: float) -> list[Row]:
    """Return the fastest method of each family whose error is below `target` in 95 of 100 lanes.

    The error is that of the state after many cycles. The fastest method is first.
    """
    good = sorted(
        (row for row in rows if row.errors["late95"] <= target), key=lambda row: row.seconds
    )
    first: dict[str, Row] = {}
    for row in good:
        first.setdefault(row.choice.family, row)
    return list(first.values())


def scanned(row: Row) -> tuple[str, str]:
    """Return the share of wrong regimes and the seconds of the scan, or dashes without a scan."""
    return ("–", "–") if np.isnan(row.wrong) else (f"{row.wrong:.2%}", f"{row.scanning:.1f}")


def in_words(row: Row) -> str:
    """Return a method's name with its run time and its error."""
    return f"{row.choice.name} ({1e3 * row.seconds:.0f} ms, {row.errors['late95']:.0e})"


def front(drive: str, target: float) -> list[str]:
    """Return the three fastest families below an error, with their times over the fastest one's."""
    best = fastest(results[drive][0], target)[:3]
    cells = [in_words(best[0])] if best else ["none"]
    for row in best[1:]:
        cells += [in_words(row), f"{row.seconds / best[0].seconds:.2f}"]
    return [drive, f"{target:.0e}", *cells, *[""] * (5 - len(cells))]


def all_of(row: Row) -> list[str]:
    """Return a method's name with all its errors."""
    e = row.errors
    return [
        row.choice.name, f"{row.compiling:.1f}", f"{1e3 * row.seconds:.0f}",
        *(f"{e[x]:.0e}" for x in ("state", "state95", "late", "late95", "phase95", "extremes95")),
        *(f"{e[x]:.2%}" for x in ("counts", "lost", "failed")), *scanned(row),
    ]  # fmt: skip


FRONT = ["drive", "error up to", "fastest", "next family", "ratio", "third", "ratio"]
ALL = [
    "method", "compile s", "run ms", f"state, {FEW} cycles: median", "95 %",
    f"{MANY} cycles: median", "95 %", "impact phase", "min Y", "counts wrong", "off by 0.01",
    "failed", "regime wrong", "scan s",
]  # fmt: skip
fronts = [front(drive, target) for drive in results for target in TARGETS]
every = "\n\n".join(
    f"""## Every method, {drive} drive

{about.calm} of {LANES} lanes are calm. Regimes: {GRID} x {GRID} values of \
{"ζ" if drive == "ideal" else "κ"} and k, 400 cycles to settle; wrong labels among the \
{about.firm} of {about.grid} lanes on which two true methods agree (the others are chaotic or on a \
border).

{table(ALL, [all_of(row) for row in rows])}"""
    for drive, (rows, about) in results.items()
)
report = f"""# Speed against accuracy

{LANES} lanes, ζ (ideal drive) or κ (motor) from 0.5 to 1.9, Table 1's machine, d = 2, k = 0.8. \
JAX {jax.__version__}. Times: {TIMED} cycles of all lanes, medians of {ROUNDS} interleaved rounds. \
Errors are those that 95 of 100 calm lanes stay under (calm: a displacement of 1e-10 grows to no \
more than 1e-6 in {MANY} cycles).

![Speed against accuracy](../figures/speed_accuracy.png)

The map of a fixed-step method has periodic motions of its own, which repeat to rounding: its \
regimes come out right even where its states are off by 1e-5. With steps by a tolerance the \
sections wander within that tolerance, and a motion counts as unsettled unless it is well below \
the 1e-6 by which sections are compared.

## The fastest for an error

The error is that of the state after {MANY} cycles; of each family its fastest setting. In \
brackets time and error.

{table(FRONT, fronts)}

{every}

"""
print(report)
numbers = {
    f"{row.choice.name}: median error of the state, 20 cycles, ideal drive": row.errors["state"]
    for row in results["ideal"][0]
    if row.choice.name == fixed("Verner9", 10).name
}

# %% [markdown]
# ## Figure

# %%
write("speed_accuracy", report, numbers, picture(results))
