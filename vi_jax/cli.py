"""The command line: `vi-jax reproduce`."""

import argparse
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, version
from io import TextIOWrapper
from pathlib import Path

import jax

from .paper.report import reproduce, summary


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 1 (failed), 2 (usage) or 130 (Ctrl-C)."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters
    options = _parser().parse_args(argv)
    problem = _unusable(options.out)
    if problem:
        print(f"vi-jax: error: {problem}", file=sys.stderr)
        return 2
    jax.config.update("jax_enable_x64", True)
    try:
        found = reproduce(options.out, quick=options.quick, progress=_tell)
    except KeyboardInterrupt:
        print(f"vi-jax: interrupted; what was written is in {options.out}", file=sys.stderr)
        return 130
    except OSError as error:
        print(f"vi-jax: error: {error}", file=sys.stderr)
        return 1
    print(summary(found))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vi-jax", description="Simulation of vibro-impact systems."
    )
    parser.add_argument("--version", action="version", version=f"vi-jax {_version()}")
    commands = parser.add_subparsers(dest="command", required=True)
    verb = commands.add_parser(
        "reproduce",
        help="draw Figures 3 and 4 of the paper and write a report",
        description="Draws Figures 3 and 4 of the paper (fig3.png, fig4.png), measures what it "
        "claims with them and the faults of its printed text (report.md, report.json).",
    )
    verb.add_argument(
        "--out", default="reproduction", metavar="DIR", help="folder to write into (%(default)s)"
    )
    verb.add_argument(
        "--quick", action="store_true", help="60 cycles instead of 200, and fewer samples"
    )
    return parser


def _version() -> str:
    try:
        return version("vi-jax")
    except PackageNotFoundError:
        return "(not installed)"


def _unusable(out: str) -> str | None:
    """Why nothing can be written into this folder, or `None`; makes the folder."""
    if not out:
        return "argument --out must name a folder"
    try:
        Path(out).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except (FileExistsError, NotADirectoryError):
        return f"argument --out must be a folder, but {out} is or lies below a file"
    except (OSError, ValueError) as error:
        return f"cannot write into {out}: {getattr(error, 'strerror', None) or error}"
    return None


def _tell(step: str) -> None:
    print(f"{step} …", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
