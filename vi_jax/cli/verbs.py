"""What the command line does with a file: one function for each verb.

Each checks everything, the paths it will write to included, before it simulates, and returns the
lines to print and whether anything succeeded.
"""

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.tree_util as jtu
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .._files import write_whole
from .._messages import so_many
from ..flow import RESULTS, Run, average_names, number_of
from ..machine import AbstractMachine
from ..orbit import Orbit, continue_orbit, find_orbit
from ..plot import (
    BLUE,
    RED,
    plot_basins,
    plot_branch,
    plot_history,
    plot_phase_portrait,
    plot_regimes,
    plot_sweep,
)
from ..scans import COLUMNS, LanesFailed, Sweep
from ..scans import basins as find_basins
from ..scans import scan as run_scan
from .checks import (
    check_continuation,
    check_map,
    check_names,
    check_paths,
    check_quantity,
    check_range,
)
from .config import (
    BasinsTable,
    Config,
    ContinueTable,
    OrbitTable,
    ScanTable,
    SimulateTable,
    SweepTable,
    start_of,
)
from .output import (
    axes_in_words,
    cycle_columns,
    failures,
    new_axes,
    ranges_in_words,
    regimes_in_words,
    sample_columns,
    saved,
    sweep_columns,
    write_rows,
)
from .parts import noted_interrupts, simulate_in_parts, sweep_in_parts
from .toml import ConfigError, given, in_terms_of, keys_of

Tell = Callable[[str], None]


class Outcome(NamedTuple):
    """How a verb ended, and what is printed of it."""

    text: str
    """What to print."""
    good: bool
    """Whether anything succeeded."""
    interrupted: str | None = None
    """Where Ctrl-C ended it, if it did; what was computed before is kept."""


def scan(config: Config, table: ScanTable, tell: Tell) -> Outcome:
    """`vi-jax scan`: a grid of motions, its regimes and its numbers."""
    machine, start, method = config.build()
    axes = config.axes
    if not axes:
        raise ConfigError("missing table [axes]: a scan needs at least one")
    check_names(machine, axes, "[axes]", start=True)
    if table.picture is not None:
        check_map(axes, table.measure, paired=table.paired)
    check_paths("[scan]", picture=table.picture)
    options = given(table, "picture")
    total = len(next(iter(axes.values())))
    if not table.paired:
        total = math.prod(len(row) for row in axes.values())
    tell(f"scanning {total:,} motions")
    with in_terms_of("[scan]", keys=keys_of(type(table))), warnings.catch_warnings():
        warnings.simplefilter("ignore", LanesFailed)
        data = run_scan(machine, axes, start=start, method=method, **options)
    lines = [f"Scan of {data['result'].size:,} motions over {axes_in_words(axes)}"]
    if "period" in data:
        lines += regimes_in_words(data)
    lines += ranges_in_words(data)
    if "verified_changed_period" in data.attrs:
        changed, lanes = data.attrs["verified_changed_period"], data.attrs["verified_lanes"]
        lines.append(f"  regime otherwise by a better method: {changed} of {lanes} lanes tried")
    if table.store is None:
        lines += ["", str(data), "", "Nothing was written: name a `store` in [scan] to keep it."]
    else:
        lines.append(f'  data: xarray.open_zarr("{table.store}")')
    if table.picture is not None:
        ax = new_axes()
        plot_regimes(data, ax=ax)
        lines.append(saved(ax, table.picture))
    failed, good = failures(np.asarray(data["result"]))
    return Outcome("\n".join([*lines, *failed]), good)


def sweep(config: Config, table: SweepTable, tell: Tell) -> Outcome:
    """`vi-jax sweep`: one way through the values, or there and back."""
    machine, start, method = config.build()
    check_names(machine, [table.parameter], "[sweep]")
    check_range(machine, table.parameter, table.values, "`values` in [sweep]")
    own = average_names(machine, machine.start() if start is None else start)
    check_quantity(table.y, "`y` in [sweep]", (*COLUMNS, *own))
    check_paths("[sweep]", picture=table.picture, output=table.output)
    options = given(table, "values", "up_and_down", "y", "picture", "output")
    there, back = ("up", "down") if table.values[0] <= table.values[-1] else ("down", "up")
    found: dict[str, Sweep] = {}
    with noted_interrupts() as interrupted:
        with in_terms_of("[sweep]", keys=keys_of(type(table))):
            options |= {"method": method, "interrupted": interrupted}
            tell(f"sweeping {table.parameter} {there}, {len(table.values)} values")
            found[there] = sweep_in_parts(machine, values=table.values, start=start, **options)
            if table.up_and_down and not interrupted():
                tell(f"sweeping {table.parameter} {back}")
                last = _last_state(found[there], start)
                back_again = table.values[::-1]
                found[back] = sweep_in_parts(machine, values=back_again, start=last, **options)
        outcome = _describe_sweeps(found, table)
        done = sum(run.values.size for run in found.values())
        wanted = len(table.values) * (2 if table.up_and_down else 1)
        if interrupted() and done < wanted:
            return outcome._replace(interrupted=f"after {done:,} of {wanted:,} values")
        return outcome


def _describe_sweeps(found: Mapping[str, Sweep], table: SweepTable) -> Outcome:
    lines, codes = [], []
    for way, run in found.items():
        lines.append(f"{way}: {run}")
        codes.append(np.asarray(number_of(run.result)))
    if table.output is not None:
        write_rows(table.output, [sweep_columns(way, run) for way, run in found.items()])
        lines.append(f"  data: {table.output}")
    if table.picture is not None:
        ax = new_axes()
        for way, run in found.items():
            look = {"color": BLUE, "ms": 6} if way == "up" else {"color": RED, "ms": 3}
            plot_sweep(run, ax=ax, y=table.y, label=way, **look)
        ax.legend(frameon=False)
        lines.append(saved(ax, table.picture))
    failed, good = failures(np.concatenate(codes), what="values")
    return Outcome("\n".join([*lines, *failed]), good)


def basins(config: Config, table: BasinsTable, tell: Tell) -> Outcome:
    """`vi-jax basins`: what each start of a region settles on."""
    machine, start, method = config.build()
    check_names(machine, table.region, "[basins.region]", start=True)
    if table.picture is not None and len(table.region) != 2:
        raise ConfigError(
            "`picture` in [basins] needs a region of two parts of the start, but it has "
            f"{len(table.region)}"
        )
    check_paths("[basins]", picture=table.picture, output=table.output)
    options = given(table, "resolution", "picture", "output")
    if table.resolution is not None:
        one = len(table.resolution) == 1
        options["resolution"] = table.resolution[0] if one else table.resolution
    tell("looking where the starts settle")
    with in_terms_of("[basins]", keys=keys_of(type(table))):
        found = find_basins(machine, start=start, method=method, **options)
    lines = [str(found)]
    if table.output is not None:
        kept = found.data[["label", "period", "impacts"]]
        write_whole(table.output, kept.to_dataframe().reset_index().to_csv(index=False))
        lines.append(f"  data: {table.output}")
    if table.picture is not None:
        ax = new_axes()
        plot_basins(found, ax=ax)
        lines.append(saved(ax, table.picture))
    failed, good = failures(np.asarray(found.data["result"]), what="starts")
    return Outcome("\n".join([*lines, *failed]), good)


def orbit(config: Config, table: OrbitTable, tell: Tell) -> Outcome:
    """`vi-jax orbit`: a periodic motion, and the branch that it lies on."""
    machine, start, method = config.build()
    check_paths("[orbit]", picture=table.picture)
    if table.continue_ is not None:
        check_continuation(machine, machine.start() if start is None else start, table.continue_)
    guess = start
    if table.guess is not None:
        guess = start_of(machine, table.guess, "`guess` in [orbit]")
    tell(f"searching a motion of {so_many(table.cycles, 'cycle')}")
    named = {"root_finder": "[orbit]", "method": "[method]", "guess": "[start]"}
    if table.guess is not None:
        named["guess"] = "`guess` in [orbit]"
    with in_terms_of("[orbit]", keys=keys_of(type(table)), named=named):
        found = find_orbit(
            machine,
            machine.start() if guess is None else guess,
            table.cycles,
            root_finder=table.search(),
            method=method,
        )
    lines = [str(found)]
    if not bool(found.successful):
        return Outcome("\n".join(lines), False)
    if table.picture is not None:
        lines.append(saved(_portrait(found), table.picture))
    if table.continue_ is not None:
        lines += _continued(found, table.continue_, tell)
    return Outcome("\n".join(lines), True)


def _continued(found: Orbit, asked: ContinueTable, tell: Tell) -> list[str]:
    """A branch followed from an orbit, as lines to print; it is written and drawn as asked for."""
    tell(f"following it in {asked.parameter}")
    with in_terms_of("[orbit.continue]"):
        branch = continue_orbit(found, **given(asked, "y", "picture", "output"))
    lines = [str(branch)]
    if asked.output is not None:
        data = branch.to_xarray()
        columns = {name: np.asarray(x) for name, x in data.items() if x.dims == ("point",)}
        write_rows(asked.output, [{str(name): x for name, x in columns.items()}])
        lines.append(f"  data: {asked.output}")
    if asked.picture is not None:
        ax = new_axes()
        plot_branch(branch, ax=ax, y=asked.y)
        lines.append(saved(ax, asked.picture))
    return lines


def _portrait(found: Orbit) -> Axes:
    """The phase portrait of a periodic motion."""
    ax = new_axes()
    plot_phase_portrait(found.trajectory(), found.machine, ax=ax)
    return ax


def simulate(config: Config, table: SimulateTable, tell: Tell) -> Outcome:
    """`vi-jax simulate`: one motion, cycle by cycle."""
    machine, start, method = config.build()
    check_paths("[simulate]", picture=table.picture, output=table.output)
    options = given(table, "picture", "output")
    if table.picture is not None:
        options = {"samples": 64, "impact_log": 8, **options}
        if options["samples"] < 1:
            raise ConfigError("`samples` in [simulate] must be at least 1 for a picture")
    tell(f"simulating {table.cycles:,} cycles")
    with noted_interrupts() as interrupted:
        with in_terms_of("[simulate]", keys=keys_of(type(table))):
            start = machine.start() if start is None else start
            run = simulate_in_parts(
                machine, start, method=method, interrupted=interrupted, **options
            )
        outcome = _describe_run(machine, run, table)
        done = run.impacts.size
        if interrupted() and done < table.cycles:
            return outcome._replace(interrupted=f"after {done:,} of {table.cycles:,} cycles")
        return outcome


def _describe_run(machine: AbstractMachine, run: Run, table: SimulateTable) -> Outcome:
    lines = [str(run)]
    if table.output is not None:
        columns = sample_columns(run.samples) if table.samples else cycle_columns(run)
        write_rows(table.output, [columns])
        lines.append(f"  data: {table.output}")
    if table.picture is not None:
        figure = Figure(figsize=(11, 3.6), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(2, 1))
        plot_history(run, machine=machine, ax=left, unit="cycles")
        plot_phase_portrait(run, machine, ax=right)
        lines.append(saved(left, table.picture))
    return Outcome("\n".join(lines), bool(run.successful))


VERBS: Mapping[str, Callable[[Config, Any, Tell], Outcome]] = {
    "scan": scan,
    "sweep": sweep,
    "basins": basins,
    "orbit": orbit,
    "simulate": simulate,
}


def _last_state(run: Sweep, otherwise: object) -> Any:
    """The section state on which a sweep ended."""
    good = np.flatnonzero(np.asarray(run.result == RESULTS.successful))
    if not good.size:
        return otherwise
    return jtu.tree_map(lambda x: x[good[-1], -1], run.sections)
