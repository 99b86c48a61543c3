"""The command line: `vi-jax VERB FILE.toml` with arguments in a file, and `vi-jax explore`.

Each verb calls the function of its name, prints, writes and draws.
"""

import argparse
import dataclasses
import functools
import inspect
import os
import re
import signal
import sys
import tomllib
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from .. import plot
from .._checks import unwritable
from .._messages import Interrupted, installed_version
from .._programs import keep_programs
from ..explore.serve import missing, serve
from ..explore.subject import Subject, ready
from ..flow import Run, RunOptions, make_plan, simulate
from ..machine import (
    AbstractMachine,
    State,
    check_leaf,
    components,
    cycles_in_words,
    is_autonomous,
    leaf_names,
    with_leaves,
)
from ..orbit import continue_orbit, find_orbit
from ..scans import REGIMES, basins, scan, sweep
from .named import InputError, check_keys, machine_of, value_of

_ENDINGS = {"output": (".csv", ".nc"), "picture": (".png", ".pdf", ".svg")}
_LEFT_OUT = {"machine", "orbit", "options", "progress", "cluster", "throw", "key"}
_NOT_NEEDED = {*_LEFT_OUT, "start", "guess"}

# Cycles, or samples, of one part of a run: a fraction of a second, or seconds for a slow machine.
_CYCLES, _SAMPLES = 1024, 16384

_MACHINE = "a class or a function that makes the machine (module:name or path/to/file.py:name)"


class Found(NamedTuple):
    """The result of a verb, with functions for its table and its picture."""

    lines: list[str]
    table: Callable[[], Any] | None = None
    draw: Callable[[Figure], object] | None = None
    good: bool = True
    """True if at least one of its computations succeeded; else the command fails."""
    interrupted: bool = False
    """True if Ctrl-C ended it early."""
    result: Any = None


class Verb(NamedTuple):
    """A function of the library, and the handling of its arguments."""

    about: str
    function: Callable[..., Any]
    work: Callable[..., Found]
    own_keys: tuple[str, ...] = ()
    """Keys of its table that are not arguments of the function."""

    def keys(self) -> list[str]:
        """Return the keys of its table."""
        names = [*inspect.signature(self.function).parameters]
        names += [*inspect.signature(scan).parameters] if "options" in names else []
        return [x for x in dict.fromkeys([*names, *self.own_keys, *_ENDINGS]) if x not in _LEFT_OUT]

    def check(self, table: Mapping[str, Any], place: str) -> None:
        """Raise `InputError` for an unknown or a missing key."""
        check_keys(table, self.keys(), place)
        for name, parameter in inspect.signature(self.function).parameters.items():
            needed = parameter.default is parameter.empty and name not in _NOT_NEEDED
            if needed and name not in table:
                raise InputError(f"missing key `{name}` in {place}")


def do(verb: str, machine: AbstractMachine, tables: Mapping[str, Any]) -> Found:
    """Return the result of a verb with the arguments of a file. **Raises:** `InputError`."""
    before, subject = [], machine
    spec, place, table = VERBS[verb], f"[{verb}]", tables.get(verb)
    if not isinstance(table, dict):
        raise InputError(f"missing table {place}, which holds the arguments")
    spec.check(table, place)
    if verb == "continue":  # checked before the search for the orbit
        with errors_in(place):
            check_leaf(machine, table.get("parameter", ""))
        found = do("orbit", machine, {"orbit": {}, **tables})
        if not found.good:
            return found
        before, subject = found.lines, found.result
    state_key = "guess" if verb == "orbit" else "start"
    shared = {state_key: tables.get("start"), "method": tables.get("method")}
    table = {key: x for key, x in shared.items() if x is not None and key in spec.keys()} | table
    values = {key: value_of(x, f"{place}: `{key}`") for key, x in table.items()}
    if state_key in values:
        values[state_key] = start_of(machine, values[state_key])
    files = {key: values.pop(key) for key in _ENDINGS if key in values}
    for key, path in files.items():
        _check_path(path, _ENDINGS[key], f"`{key}` in {place}")
    own_options = {key: values.pop(key) for key in spec.own_keys if key in values}
    with errors_in(place), warnings.catch_warnings(record=True) as caught:
        found = spec.work(subject, values, **own_options)
        lines = [*before, *found.lines, *_write_files(found, **files)]
    return found._replace(lines=lines + sorted({f"  warning: {x.message}" for x in caught}))


def _check_path(path: Any, endings: tuple[str, ...], place: str) -> None:
    """Raise `InputError` if a file cannot be written; create the folder above it."""
    if not isinstance(path, str) or Path(path).suffix not in endings:
        raise InputError(f"{place} must end in {', '.join(endings)}, but is {path!r}")
    reason = unwritable(Path(path).parent) or ("it is a folder" if Path(path).is_dir() else None)
    if reason:
        raise InputError(f"{place} cannot be written: {path}: {reason}")


def _write_files(found: Found, output: str | None = None, picture: str | None = None) -> list[str]:
    lines = []
    if output is not None and found.table is not None:
        data = found.table()
        if output.endswith(".csv"):
            data.to_dataframe().reset_index().to_csv(output, index=False)
        else:
            data.to_netcdf(output)
        lines.append(f"  output: {output}")
    if picture is not None and found.draw is not None:
        figure = Figure(figsize=(7.5, 4.2), layout="constrained")
        try:
            found.draw(figure)
        except ValueError as error:  # the other results are kept
            return [*lines, f"  picture: not drawn: {error}"]
        figure.savefig(picture, dpi=110)
        lines.append(f"  picture: {picture}")
    return lines


def _finished(function: Callable[..., Any], *args: Any, **options: Any) -> tuple[Any, bool]:
    """Return the result of a function, partial after Ctrl-C, and whether that ended it. From then
    on Ctrl-C is ignored."""
    try:
        return function(*args, **options), False
    except Interrupted as error:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        return error.partial, True


def _simulate(machine: AbstractMachine, options: dict[str, Any]) -> Found:
    along, start = "sample" if options.get("samples") else "cycle", options.pop("start", None)
    if along == "sample":  # for impacts between samples in the picture
        options.setdefault("impact_log", 8)
    run, interrupted = run_in_parts(machine, machine.start() if start is None else start, **options)

    def table() -> Any:
        data = run.to_xarray(along=along)
        if along == "cycle":  # with the state at its end
            ends = run.to_xarray(along="section").isel(section=slice(1, None))
            data = xr.merge([ends.rename(section="cycle"), data])
        return data

    def draw(figure: Figure) -> None:
        figure.set_size_inches(11, 3.6)
        left, right = figure.subplots(1, 2, width_ratios=(2, 1))
        sampled, shown = run, machine
        if run.samples is None:  # the same cycles again; autonomous ones at equal intervals
            first = jtu.tree_map(lambda x: x[0], run.sections)
            if is_autonomous(machine, first):
                shown = machine.observed_every(machine.cycle)
            sampled = simulate(shown, first, run.impacts.size, samples=64, impact_log=8)
        unit = "cycles" if shown is machine else "time"
        plot.plot_history(sampled, machine=shown, ax=left, unit=unit)
        plot.plot_phase_portrait(sampled, shown, ax=right)

    return Found([str(run)], table, draw, not bool(run.failed), interrupted)


def run_in_parts(
    machine: AbstractMachine, start: Any, cycles: int, *, samples: int = 0, **options: Any
) -> tuple[Run, bool]:
    """Return a run of one motion, as `simulate`, and whether Ctrl-C ended it. The run then has the
    cycles recorded so far."""
    length, runs = max(1, min(_CYCLES, _SAMPLES // max(1, samples))), []
    settled = options.get("settle", 0)
    make_plan(machine, start, cycles, RunOptions(samples=samples, **options))  # checks them all
    if cycles <= length or options.keys() & {"estimate", "max_steps", "noise"}:
        return simulate(machine, start, cycles, samples=samples, **options), False
    try:
        for done in range(0, cycles, length):
            count = min(length, cycles - done)
            run = simulate(machine, start, count, samples=samples, **options)
            if done and run.outcome_cycle is not None and run.outcome_cycle >= 0:
                run = dataclasses.replace(run, outcome_cycle=run.outcome_cycle + settled + done)
            runs.append(run)
            start, options["settle"] = run.last, 0
            if not bool(run.successful):
                break
    except KeyboardInterrupt:
        if not runs:
            raise
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # also while parts are joined
        return _joined(runs), True
    return _joined(runs), False


def _joined(runs: list[Run]) -> Run:
    """Return parts of one run as one; a part begins with the last state of that before it."""
    time, length = 0.0, runs[0].impacts.size
    for i, run in enumerate(runs):
        if run.samples is not None:
            later = {"cycles": run.samples.cycles + i * length, "time": run.samples.time + time}
            runs[i] = dataclasses.replace(run, samples=dataclasses.replace(run.samples, **later))
            time = later["time"][-1]

    def row(*parts: Any) -> Any:
        if not jnp.ndim(parts[0]):
            return parts[-1]
        begin = int(len(parts[0]) != length)
        return jnp.asarray(np.concatenate([parts[0], *(x[begin:] for x in parts[1:])]))

    tried, rejected = (sum(getattr(run, name) for run in runs) for name in ("steps", "rejected"))
    return dataclasses.replace(jtu.tree_map(row, *runs), steps=tried, rejected=rejected)


def _sweep(machine: AbstractMachine, options: dict[str, Any], *, y: str | None = None) -> Found:
    found, interrupted = _finished(sweep, machine, **options)

    def draw(figure: Figure) -> None:
        plot.plot_sweep(found, ax=figure.subplots(), y=y, color=plot.BLUE)

    good = bool(found.successful.any())
    return Found([str(found)], lambda: found.to_xarray(along="value"), draw, good, interrupted)


def _scan(machine: AbstractMachine, options: dict[str, Any]) -> Found:
    data = scan(machine, **options)
    axes = ", ".join(f"{name} ({data[name].size})" for name in data.coords)
    lines = [f"Scan of {data['result'].size:,} motions over {axes}"]
    if "period" in data:
        lines += _count_periods(data, machine)
    if options.get("store") is not None:
        lines.append(f'  store: xarray.open_zarr("{options["store"]}")')
    draw = lambda figure: plot.plot_regimes(data, ax=figure.subplots())
    return Found([*lines, str(data)], lambda: data, draw, bool((data["result"] == 0).any()))


def _count_periods(data: xr.Dataset, machine: AbstractMachine) -> list[str]:
    period = np.asarray(data["period"]).astype(int)[np.asarray(data["result"]) == 0]
    kinds, counts = np.unique(period, return_counts=True)
    lines = []
    for i in np.argsort(-counts)[:12]:
        n = int(kinds[i])
        name = REGIMES(n).meaning if n < 0 else f"period {cycles_in_words(machine, n)}"
        lines.append(f"  {name}: {counts[i]:,} ({100 * counts[i] / data['result'].size:.1f} %)")
    return lines + [f"  {len(kinds) - 12} further periods"] * (len(kinds) > 12)


def _basins(machine: AbstractMachine, options: dict[str, Any]) -> Found:
    found = basins(machine, **options)
    table = lambda: found.data[["label", "period", "impacts"]]
    draw = lambda figure: plot.plot_basins(found, ax=figure.subplots())
    return Found([str(found)], table, draw, bool((found.data["result"] == 0).any()))


def _orbit(machine: AbstractMachine, options: dict[str, Any], *, settle: int = 0) -> Found:
    guess = options.pop("guess") if "guess" in options else machine.start()
    if settle:
        guess = simulate(machine, guess, 1, settle=settle, method=options.get("method")).last
    found = find_orbit(machine, guess, **options)
    if not bool(found.successful):
        return Found([str(found)], good=False)
    path = functools.cache(found.trajectory)  # of the table and the picture
    draw = lambda figure: plot.plot_phase_portrait(path(), machine, ax=figure.subplots())

    def table() -> Any:  # a row for each section state, with the numbers of the whole motion
        whole = found.to_xarray().data_vars.items()
        numbers = {name: x for name, x in whole if not x.dims}
        energy = path().impact_energy
        assert energy is not None
        numbers["impact_energy"] = xr.DataArray(float(energy.sum()) / int(found.cycles))
        return found.to_xarray(along="section").assign(numbers)

    return Found([str(found)], table, draw, result=found)


def _continue(orbit: Any, options: dict[str, Any], *, y: str | None = None) -> Found:
    curve, interrupted = _finished(continue_orbit, orbit, **options)
    draw = lambda figure: plot.plot_branch(curve, ax=figure.subplots(), y=y)
    return Found([str(curve)], lambda: curve.to_xarray(along="point"), draw, True, interrupted)


VERBS: Mapping[str, Verb] = {
    "simulate": Verb("one motion, cycle by cycle", simulate, _simulate),
    "sweep": Verb("one number changed step by step", sweep, _sweep, ("y",)),
    "scan": Verb("every combination of the values on the axes", scan, _scan),
    "basins": Verb("which start settles on which motion", basins, _basins),
    "orbit": Verb("a periodic motion", find_orbit, _orbit, ("settle",)),
    "continue": Verb("the branch of the motion of [orbit]", continue_orbit, _continue, ("y",)),
}


@contextmanager
def errors_in(place: str) -> Iterator[None]:
    """Turn errors of the library about its arguments into an `InputError` that names the table."""
    try:
        yield
    except (ValueError, TypeError) as error:
        about = re.match("Argument|Axis|Method|Measure", str(error))
        if isinstance(error, InputError) or not about:
            raise
        raise InputError(f"{place}: {error}") from None


def start_of(machine: AbstractMachine, table: Any) -> Any:
    """Return the state that `[start]` describes: arguments of the machine's `start`, components
    that replace those of the default, or all without `start`. **Raises:** `InputError`."""
    if not isinstance(table, dict):
        return table
    if type(machine).start is AbstractMachine.start:
        return State(**table)
    parameters = inspect.signature(machine.start).parameters
    with errors_in("[start]"):
        if parameters:
            if not any(x.kind is x.VAR_KEYWORD for x in parameters.values()):
                check_keys(table, parameters, "[start]")
            return machine.start(**table)
        state = machine.start()
        check_keys(table, dict.fromkeys((*leaf_names(state), *components(state))), "[start]")
        return with_leaves(state, table)


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 1 (failed), 2 (usage) or 130 (Ctrl-C)."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters
    before = signal.getsignal(signal.SIGINT)
    try:
        options = _parser().parse_args(argv)
        jax.config.update("jax_enable_x64", True)
        if argv is None:  # a process of its own
            keep_programs()
        code = options.run(options)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader has closed the pipe, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        return _error(error, 1)
    finally:
        if signal.getsignal(signal.SIGINT) is not before:
            signal.signal(signal.SIGINT, before)


def _error(problem: object, code: int) -> int:
    print(f"vi-jax: error: {problem}", file=sys.stderr)
    return code


def read(path: str) -> dict[str, Any]:
    """Return the tables of a file. **Raises:** `InputError`."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))  # some editors' mark
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from None


def _run_file(options: argparse.Namespace) -> int:
    verb, store = options.command, None
    try:
        tables = read(options.file)
        check_keys(tables, ["machine", "arguments", "start", "method", *VERBS], "the file")
        name, keywords = tables.get("machine"), tables.get("arguments", {})
        machine = machine_of(*((options.machine, {}) if options.machine else (name, keywords)))
        store = (tables[verb] if isinstance(tables.get(verb), dict) else {}).get("store")
        found = do(verb, machine, tables)
    except InputError as error:
        return _error(f"{options.file}: {error}", 2)
    except KeyboardInterrupt as error:
        how = "nothing was written"
        if isinstance(error, Interrupted) and store is not None:
            how = f"the same command goes on from what is in {store}"
        print(f"vi-jax: interrupted; {how}", file=sys.stderr)
        return 130
    print("\n".join(found.lines))
    if found.interrupted:
        print("vi-jax: interrupted; what was computed before is kept", file=sys.stderr)
        return 130
    return 0 if found.good else 1


def _serve_page(options: argparse.Namespace) -> int:
    if options.range and options.machine is None:
        return _error("argument --range: only with --machine, whose sliders it sets", 2)
    if not 0 <= options.port <= 65535:
        return _error(f"argument --port: the port must be 0-65535, but is {options.port}", 2)
    if problem := missing():
        return _error(problem, 1)
    jax.config.update("jax_platforms", "cpu")  # the fastest for one motion
    name, make = next(iter(ready().items()))
    try:
        ranges = {name: (float(low), float(high)) for name, low, high in options.range}
        if options.machine is not None:
            name, make = options.machine, lambda: Subject(machine_of(options.machine, {}), ranges)
        report = lambda step: print(f"{step} …", file=sys.stderr, flush=True)
        serve(options.host, options.port, (name, make()), browser=options.browser, report=report)
    except ValueError as error:
        return _error(error, 2)
    except OSError as error:
        return _error(f"cannot serve {options.host} port {options.port}: {error.strerror}", 1)
    except KeyboardInterrupt:
        pass
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vi-jax", description="Simulation of vibro-impact systems."
    )
    parser.add_argument("--version", action="version", version=f"vi-jax {installed_version()}")
    commands = parser.add_subparsers(dest="command", required=True)
    about = "open a page with sliders, on which motions are seen at once"
    verb = commands.add_parser("explore", help=about, description=f"{about}. Ctrl-C ends it.")
    verb.add_argument("--host", default="127.0.0.1", help="address to listen at (%(default)s)")
    verb.add_argument(
        "--port", type=int, default=8417, help="port to listen at; 0 is any free one (%(default)s)"
    )
    verb.add_argument("--machine", metavar="NAME", help=_MACHINE)
    verb.add_argument(
        "--range", action="append", default=[], nargs=3, metavar=("NAME", "LOW", "HIGH"),
        help="the range of a slider of that machine; may be given several times",
    )  # fmt: skip
    verb.add_argument(
        "--no-browser", dest="browser", action="store_false", help="do not open a browser"
    )
    verb.set_defaults(run=_serve_page)
    for name, spec in VERBS.items():
        verb = commands.add_parser(
            name,
            help=spec.about,
            description=f"Computes {spec.about}. FILE names a `machine`, with its [arguments], and "
            f"holds [{name}]; it may hold [start] and `method`.",
            epilog=f"keys of [{name}]: {', '.join(spec.keys())}",
        )
        verb.add_argument("file", metavar="FILE", help="a TOML file")
        verb.add_argument("--machine", metavar="NAME", help=f"{_MACHINE}, instead of the file's")
        verb.set_defaults(run=_run_file)
    return parser
