"""The command line: `vi-jax explore`, and `vi-jax VERB FILE.toml` for what a file asks."""

import argparse
import os
import sys
from io import TextIOWrapper

import jax

from .._messages import installed_version
from ..explore.serve import Subject, missing, serve
from .config import (
    BasinsTable,
    ContinueTable,
    OrbitTable,
    ScanTable,
    SimulateTable,
    SweepTable,
    read,
)
from .machine import machine_named
from .toml import ConfigError, keys_of
from .verbs import VERBS

_ABOUT = {
    "scan": ("every combination of the values on the axes", (ScanTable,)),
    "sweep": ("one number changed little by little", (SweepTable,)),
    "basins": ("which start settles on which motion", (BasinsTable,)),
    "orbit": ("a periodic motion, and its branch", (OrbitTable, ContinueTable)),
    "simulate": ("one motion, cycle by cycle", (SimulateTable,)),
}


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 1 (failed), 2 (usage) or 130 (Ctrl-C)."""
    try:
        code = _run(argv)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # whoever reads has seen enough, as `head` has
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _run(argv: list[str] | None) -> int:
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters
    options = _parser().parse_args(argv)
    if options.command == "explore":
        return _explore(options)
    return _run_file(options)


def _explore(options: argparse.Namespace) -> int:
    if not 0 <= options.port <= 65535:
        return _error(f"argument --port must be between 0 and 65535, but is {options.port}", 2)
    problem = missing()
    if problem:
        return _error(problem, 1)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_platforms", "cpu")  # the fastest for one motion
    try:
        shown = _shown(options)
    except (ConfigError, ValueError) as error:
        return _error(error, 2)
    try:
        serve(
            options.host, options.port, browser=options.browser, tell=_say, machine=shown,
            paper=not options.ready,
        )  # fmt: skip
    except KeyboardInterrupt:
        pass
    except OSError as error:
        return _error(f"cannot serve {options.host} port {options.port}: {error.strerror}", 1)
    return 0


def _shown(options: argparse.Namespace) -> tuple[str, Subject] | None:
    """The machine to explore, with its name; `None` where none is named.

    **Raises:** `ConfigError` or `ValueError` for what is none, or for ranges that are not.
    """
    ranges = {}
    for text in options.range:
        name, _, ends = text.partition("=")
        low, _, high = ends.partition(":")
        try:
            ranges[name] = (float(low), float(high))
        except ValueError:
            raise ConfigError(f"--range must be NAME=LOW:HIGH, but is {text!r}") from None
    if options.machine is None:
        if ranges:
            raise ConfigError("--range needs --machine, whose numbers it is of")
        return None
    return options.machine, Subject(machine_named(options.machine), ranges)


def _run_file(options: argparse.Namespace) -> int:
    """Do what the file asks of the verb."""
    jax.config.update("jax_enable_x64", True)
    verb, store = options.command, None
    try:
        config = read(options.file, machine=options.machine)
        table = getattr(config, verb)
        if table is None:
            raise ConfigError(f"missing table [{verb}], which says what to do")
        store = getattr(table, "store", None)
        found = VERBS[verb](config, table, _say)
    except ConfigError as error:
        for problem in error.problems:
            _error(f"{options.file}: {problem}", 2)
        return 2
    except KeyboardInterrupt:
        how = f"nothing was kept (only a `store` in [{verb}] could be resumed)"
        if store is not None:
            how = f"the same command goes on from what is in {store}"
        elif verb not in ("scan", "basins"):
            how = "nothing was written"
        print(f"vi-jax: interrupted; {how}", file=sys.stderr)
        return 130
    except OSError as error:
        return _error(error, 1)
    print(found.text)
    if found.interrupted is not None:
        print(f"vi-jax: interrupted {found.interrupted}, which are kept", file=sys.stderr)
        return 130
    return 0 if found.good else 1


def _error(problem: object, code: int) -> int:
    print(f"vi-jax: error: {problem}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vi-jax", description="Simulation of vibro-impact systems."
    )
    parser.add_argument("--version", action="version", version=f"vi-jax {installed_version()}")
    commands = parser.add_subparsers(dest="command", required=True)
    verb = commands.add_parser(
        "explore",
        help="open a page with sliders, on which motions are seen at once",
        description="Serves a page with sliders for the numbers of the machine and its start: "
        "motions, phase portraits, impact maps, regimes, multipliers, bifurcation diagrams, and "
        "a motor. Ctrl-C ends it.",
    )
    verb.add_argument("--host", default="127.0.0.1", help="address to listen at (%(default)s)")
    verb.add_argument(
        "--port", type=int, default=8417, help="port to listen at; 0 is any free one (%(default)s)"
    )
    verb.add_argument(
        "--machine",
        metavar="MODULE:FUNCTION",
        help="show the machine that a function without arguments returns, of a module or of a file "
        "(path/to/file.py:function)",
    )
    verb.add_argument(
        "--range",
        action="append",
        default=[],
        metavar="NAME=LOW:HIGH",
        help="the range of a slider of that machine; may be given several times",
    )
    verb.add_argument(
        "--ready", action="store_true", help="show the ready machines, instead of the paper's scene"
    )
    verb.add_argument(
        "--no-browser", dest="browser", action="store_false", help="do not open a browser"
    )
    for name, (about, tables) in _ABOUT.items():
        verb = commands.add_parser(
            name,
            help=f"{about}, as a file says",
            description=f"Does what FILE says: {about}. The file holds [scene], [parameters] "
            "or [machine], if need be [start] and [method]"
            f"{', [axes]' if name == 'scan' else ''}, and [{name}].",
            epilog="; ".join(_keys(kind) for kind in tables),
        )
        verb.add_argument("file", metavar="FILE", help="a TOML file")
        verb.add_argument(
            "--machine",
            metavar="MODULE:FUNCTION",
            help="a function without arguments that returns the machine, instead of the file's",
        )
    return parser


def _keys(kind: type) -> str:
    """The keys of a table, for the help."""
    name = (kind.__doc__ or "").strip("`.")
    return f"keys of {name}: {', '.join(key.rstrip('_') for key in keys_of(kind))}"


def _say(step: str) -> None:
    print(f"{step} …", file=sys.stderr, flush=True)
