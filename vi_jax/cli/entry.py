"""The command line: `vi-jax VERB FILE.toml` for what a file asks, and `vi-jax explore`."""

import argparse
import os
import signal
import sys
import tomllib
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import jax

from .._messages import Interrupted, installed_version
from ..explore.serve import missing, serve
from ..explore.subject import Subject, ready
from ..machines.named import InputError, check_keys, machine_of
from .verbs import VERBS, do

_MACHINE = "a class or a function that makes the machine (module:name or path/to/file.py:name)"


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 1 (failed), 2 (usage) or 130 (Ctrl-C)."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters
    before = signal.getsignal(signal.SIGINT)
    try:
        options = _parser().parse_args(argv)
        jax.config.update("jax_enable_x64", True)
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
        say = lambda step: print(f"{step} …", file=sys.stderr, flush=True)
        serve(options.host, options.port, (name, make()), browser=options.browser, tell=say)
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
    for name, what in VERBS.items():
        verb = commands.add_parser(
            name,
            help=what.about,
            description=f"Computes {what.about}. FILE names a `machine`, with its [arguments], and "
            f"holds [{name}]; it may hold [start] and `method`.",
            epilog=f"keys of [{name}]: {', '.join(what.keys())}",
        )
        verb.add_argument("file", metavar="FILE", help="a TOML file")
        verb.add_argument("--machine", metavar="NAME", help=f"{_MACHINE}, instead of the file's")
        verb.set_defaults(run=_run_file)
    return parser
