# %% [markdown]
# # vi_jax compared with other codes: same machines, same cores, same error
#
# 1,024 lanes of Table 1's machine (T0 = 10 N·m, d = 2) run for 200 drive cycles with k = 0.5 and
# 0.8. The control κ of the motor, or ζ of the ideal drive, is from 0.5 to 1.9. Each code has the
# best configuration found (see the files in `peer_codes/`). Its processes are pinned to their cores
# before anything is imported: one process for one core, or one per core. The lanes are distributed
# in blocks of neighbours. The codes' own parallel modes were not faster: heyoka's ensembles took
# twice as long, numba's `prange` as long. Rounds are interleaved, and compile time is separate. The
# error is the median error of the final (Y, V), compared with a full-precision run, over the lanes
# that do not amplify 1e-10 beyond 1e-6.
#
# Run with `python experiments/benchmarks/peers.py` (extra `bench`; `--quick` for few lanes, writes
# nothing).

# %%
import platform
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from vi_jax.plot.colors import BLUE, GREEN, PERIODS, RED

HERE = Path(__file__).parent if "__file__" in globals() else Path("experiments/benchmarks")
sys.path[:0] = [str(HERE), str(HERE.parent)]
from peer_codes.contest import RESTITUTIONS, contest
from peer_codes.entries import CYCLES, LANES, OURS, ROUNDS, SLOW_ROUNDS
from peer_codes.pool import cores
from peer_codes.task import PARAMETERS
from tools.pictures import panels
from tools.study import write
from tools.tables import table

# %% [markdown]
# ## Ratios at the same error
#
# The time of vi_jax at a peer's error is interpolated between its points, with both axes
# logarithmic. The fastest point or line that is at least as accurate counts. A peer that is more
# accurate than the most accurate point of vi_jax is compared with that point, and marked with <.


# %%
def at_error(rows: list[dict], error: float) -> tuple[float, bool]:
    """Return the seconds of vi_jax at an error, and whether it reaches that error."""
    points = sorted((row["error"], row["seconds"]) for row in rows)
    if error < points[0][0]:
        return points[0][1], False
    best = min(seconds for own, seconds in points if own <= error)
    for (fine, slow), (coarse, fast) in (
        (a, b) for a in points for b in points if a[0] < error < b[0]
    ):
        share = np.log(error / fine) / np.log(coarse / fine)
        best = min(best, float(np.exp((1 - share) * np.log(slow) + share * np.log(fast))))
    return best, True


HEADS = ["method", "compile, s", "run, s", "median error", "lost", "time / vi_jax's, same error"]


def row_of(row: dict[str, Any], compared: list[dict]) -> list[str]:
    """Return the table's row of a code; `compared` are the rows of vi_jax for its ratio."""
    sampled = "" if row["lanes"] == LANES else f" ({row['lanes']} lanes, scaled up)"
    known, ratio = np.isfinite(row["error"]), ""
    if known and not row["name"].startswith(OURS):
        seconds, reached = at_error(compared, row["error"])
        ratio = f"{row['seconds'] / seconds:.2f}" + ("" if reached else " <")
    return [
        row["name"] + sampled,
        f"{row['compiling']:.1f}",
        f"{row['seconds']:.3f}",
        f"{row['error']:.1e}" if known else "–",
        f"{100 * row['lost']:.1f} %" if known else "–",
        ratio,
    ]


def section(key: str, found: dict[str, Any]) -> str:
    """Return the section of one machine on one core or on all cores."""
    kind, drive, k, used = key.split(", ")
    rows = found["rows"]
    title = f"{drive.capitalize()} drive, k = {k}, {used} core{'s' * (used == 'all')}"
    if kind == "derivatives":
        title += f": final (Y, V) by {', '.join(PARAMETERS)}"
    own = [row for row in rows if row["name"].startswith(OURS) and np.isfinite(row["error"])]
    parts = [
        f"## {title} ({found['regular']} of {LANES} lanes regular)",
        table(HEADS, [row_of(row, own) for row in rows]),
    ]
    if kind == "derivatives":
        pairs = zip(rows[::2], rows[1::2], strict=True)
        ratios = [(six["name"], f"{six['seconds'] / one['seconds']:.2f}") for one, six in pairs]
        parts.append(table(["derivatives over primal", "ratio"], ratios))
    return "\n\n".join(parts)


def report(sections: dict[str, dict]) -> str:
    """Return all tables."""
    about = (
        f"{LANES:,} lanes, {CYCLES} cycles; {len(cores())} cores ({platform.processor() or 'CPU'}, "
        f"{platform.machine()}); medians of {ROUNDS} interleaved rounds, of {SLOW_ROUNDS} for the "
        "codes that run a sample of the lanes. The error is the median over the regular lanes, "
        "those that do not amplify 1e-10 beyond 1e-6; lost is the share of them whose final state "
        "is off by more than 1e-3. The last column is a peer's time over vi_jax's at the same "
        "error, above 1 where vi_jax is faster; < where the peer is more accurate than all "
        "points of vi_jax. All cores: one process a core."
    )
    return "\n\n".join([about, *(section(key, found) for key, found in sections.items())])


LOOKS = {
    f"{OURS} FixedStep": (BLUE, "s"),
    f"{OURS} Taylor": (BLUE, "o"),
    f"{OURS} ExactFlight": (BLUE, "*"),
    "heyoka batch": (RED, "s"),
    "heyoka scalar": (RED, "o"),
    "numba": (GREEN, "s"),
    "diffrax Event Tsit5": (PERIODS[2], "s"),
    "diffrax Event Dopri8": (PERIODS[2], "o"),
    "SciPy": ("0.5", "s"),
}


def picture(sections: dict[str, dict]) -> Figure:
    """Draw time against error at the first restitution, with a panel for each drive and cores."""
    figure, grid = panels(9, 7, 2, 2, sharex="row", sharey="row")
    handles: dict[str, Any] = {}
    for axes, (drive, used) in zip(
        grid.flat, ((d, u) for d in ("motor", "ideal") for u in ("one", "all")), strict=True
    ):
        rows = sections[f"states, {drive}, {RESTITUTIONS[0]}, {used}"]["rows"]
        for family, (color, mark) in LOOKS.items():
            mine = [row for row in rows if row["name"].startswith(family)]
            points = sorted((row["error"], row["seconds"]) for row in mine)
            if points:
                size = 11 if mark == "*" else 5
                look = {"color": color, "marker": mark, "ms": size, "lw": 1, "label": family}
                (handles[family],) = axes.loglog(*zip(*points, strict=True), **look)
        axes.set_title(f"{drive} drive, {used} core{'s' * (used == 'all')}", fontsize=10)
        axes.grid(alpha=0.3)
    for axes in grid[:, 0]:
        axes.set_ylabel("1,024 lanes, 200 cycles: run time (s)")
    for axes in grid[1]:
        axes.set_xlabel("median error of the final state (a, a ω)")
    figure.legend(handles=handles.values(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


def headline(sections: dict[str, dict]) -> dict[str, float]:
    """Return the error of one method of vi_jax, which a test computes again."""
    wanted = f"{OURS} FixedStep(Verner9, 10)"
    rows = sections[f"states, ideal, {RESTITUTIONS[-1]}, one"]["rows"]
    error = next((row["error"] for row in rows if row["name"] == wanted), None)
    name = f"{wanted}, ideal drive, k = {RESTITUTIONS[-1]:g}: median error"
    return {} if error is None else {name: error}


# %%
if __name__ == "__main__":
    measured = contest()
    page = f"# vi_jax compared with other codes\n\n{report(measured)}"
    print(page)
    write("peers", page, headline(measured), picture(measured))
