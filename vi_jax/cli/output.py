"""What the command line says, writes and draws of what was found."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .._files import write_whole
from ..flow import REASONS, RESULTS, number_of
from ..machine import components
from ..plot import save_picture
from ..scans import NOT_COMPUTED, REGIMES, Sweep, periods_of


def failures(codes: np.ndarray, *, what: str = "motions") -> tuple[list[str], bool]:
    """Lines on the lanes that failed and why, and whether any did not."""
    counts = {int(c): int(np.sum(codes == c)) for c in np.unique(codes) if c != 0}
    if not counts:
        return [], True
    total = sum(counts.values())
    lines = [f"  failed: {total:,} of {codes.size:,} {what}"]
    lines += [f"    {n:,}: {_reason(code)}" for code, n in counts.items()]
    return lines, total < codes.size


def _reason(code: int) -> str:
    return "Not computed." if code == NOT_COMPUTED else RESULTS[REASONS[code]] or "completed"


def axes_in_words(axes: Mapping[str, Sequence[float]]) -> str:
    """Each axis by its name, its size and its ends."""
    return ", ".join(f"{n} ({len(x)}: {min(x):g} … {max(x):g})" for n, x in axes.items())


def regimes_in_words(data: xr.Dataset) -> list[str]:
    """How many motions there are of each period."""
    period = periods_of(data["period"])[np.asarray(data["result"]) == 0]
    names: dict[int, str] = {regime: regime.meaning for regime in REGIMES}
    kinds, counts = np.unique(period, return_counts=True)
    order = sorted(zip(kinds.tolist(), counts.tolist(), strict=True), key=lambda pair: -pair[1])
    lines = [
        f"  {names.get(kind, f'period {2 * kind}π')}: {n:,} ({100 * n / data['result'].size:.1f} %)"
        for kind, n in order
    ]
    return lines if len(lines) <= 12 else [*lines[:12], f"  {len(lines) - 12} further periods"]


def ranges_in_words(data: xr.Dataset) -> list[str]:
    """The span of each number over the motions that did not fail."""
    lines = []
    for name in sorted(map(str, data)):  # a store does not keep their order
        x = data[name]
        if x.dtype.kind != "f" or name == "impacts":
            continue
        numbers = np.asarray(x.where(data["result"] == 0))
        numbers = numbers[np.isfinite(numbers)]
        if numbers.size:
            span = f"{numbers.min():.6g} … {numbers.max():.6g}"
            lines.append(f"  {name}: {span} {x.attrs.get('units', '')}".rstrip())
    return lines


def sweep_columns(way: str, run: Sweep) -> dict[str, np.ndarray]:
    """One row for each value."""
    names = ("values", "y_min", "y_max", "period", "impacts", "frequency_ratio", "impact_speed")
    columns = _there(run, names) | {name: np.asarray(x) for name, x in run.averages.items()}
    results = np.array([_reason(int(code)) for code in number_of(run.result)])
    return {"direction": np.full(results.size, way), **columns, "result": results}


def _there(run: object, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Those of its arrays that it has: nothing says how fast the drive is where there is none."""
    values = {name: getattr(run, name) for name in names}
    return {name: np.asarray(x) for name, x in values.items() if x is not None}


def sample_columns(samples: Any) -> dict[str, np.ndarray]:
    """One row for each sample."""
    return {
        "cycles": np.asarray(samples.cycles),
        "time": np.asarray(samples.time),
        **{name: np.asarray(x) for name, x in components(samples.state, 1).items()},
        **{name: np.asarray(x) for name, x in samples.quantities.items()},
    }


def cycle_columns(run: Any) -> dict[str, np.ndarray]:
    """One row for each cycle: the state at its end, and what happened in it."""
    names = ("y_min", "y_max", "impacts", "impact_speed", "frequency_ratio")
    return {
        "cycle": np.arange(1, run.impacts.size + 1),
        **{name: np.asarray(x)[1:] for name, x in components(run.sections, 1).items()},
        **{name: np.asarray(x)[1:] for name, x in run.quantities.items()},
        **_there(run, names),
        **{name: np.asarray(x) for name, x in run.averages.items()},
    }


def write_rows(path: str, tables: Iterable[Mapping[str, np.ndarray]]) -> None:
    """Columns as CSV, several tables of the same columns below each other."""
    text = StringIO(newline="")
    writer = csv.writer(text)
    for i, table in enumerate(tables):
        if not i:
            writer.writerow(table)
        writer.writerows(zip(*(x.tolist() for x in table.values()), strict=True))
    write_whole(path, text.getvalue())


def new_axes() -> Axes:
    """The axes of an empty picture, of the size that all verbs draw."""
    return Figure(figsize=(7.5, 4.2), layout="constrained").subplots()


def saved(ax: Axes, path: str) -> str:
    """Save a picture; a line that says where."""
    figure = ax.figure
    assert isinstance(figure, Figure)
    return f"  picture: {save_picture(figure, path)}"
