# %% [markdown]
# # Speed against accuracy
#
# Every method on the same lanes: Table 1's machine (d = 2, k = 0.8; the motor with T0 = 10 N·m),
# 256 values of ζ (ideal drive) or κ (motor) from 0.5 to 1.9, from rest. What a method costs
# is listed with what it gets wrong: the state after few and after many cycles, impact times and
# counts, extremes, and how often the *regime* comes out wrong, which is what a scan is for.
#
# Truth is `ExactFlight` for the ideal drive and 40 steps of Verner9 a cycle for the motor. Errors
# are over the lanes that amplify a displacement of 1e-10 to no more than 1e-6 in 1,000 cycles. Run
# times are medians of five interleaved rounds of 200 cycles, compiled before; what takes one
# thread is measured on one thread.
#
# Run with `python experiments/benchmarks/speed_accuracy.py` (`--quick` for few methods and lanes of
# the ideal drive).

# %%
import sys
import warnings
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)
# Single precision is one of the things compared here.
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
# ## What goes wrong with the motion, with regimes, and what it costs
#
# One run of many cycles from rest gives the states after few and after many cycles, and in the
# first few cycles the impact phases, impact counts and extremes. A scan over ζ (or κ) and k gives
# labels (period, impacts in a period). A lane where two true methods (the truth and `Adaptive` at
# 1e-13) differ is chaotic or lies on a border; it is left out.


# %%
def rows_of(drive: str) -> tuple[list[Row], About]:
    """Every method with one drive."""
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
    """The methods whose error 95 lanes in 100 keep below `target`, the fastest first.

    The error is that of the state after many cycles; of each family the fastest only.
    """
    good = sorted(
        (row for row in rows if row.errors["late95"] <= target), key=lambda row: row.seconds
    )
    first: dict[str, Row] = {}
    for row in good:
        first.setdefault(row.choice.family, row)
    return list(first.values())


def scanned(row: Row) -> tuple[str, str]:
    """What the scan said, where there was one."""
    return ("–", "–") if np.isnan(row.wrong) else (f"{row.wrong:.2%}", f"{row.scanning:.1f}")


def in_words(row: Row) -> str:
    """A method and what it costs."""
    return f"{row.choice.name} ({1e3 * row.seconds:.0f} ms, {row.errors['late95']:.0e})"


def front(drive: str, target: float) -> list[str]:
    """The three fastest families that stay below an error, and how much slower the others are."""
    best = fastest(results[drive][0], target)[:3]
    cells = [in_words(best[0])] if best else ["none"]
    for row in best[1:]:
        cells += [in_words(row), f"{row.seconds / best[0].seconds:.2f}"]
    return [drive, f"{target:.0e}", *cells, *[""] * (5 - len(cells))]


def all_of(row: Row) -> list[str]:
    """A method with all its errors."""
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
