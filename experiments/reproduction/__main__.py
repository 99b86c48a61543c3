"""Reproduce the paper: `python experiments/reproduction` writes pictures and a report."""

import argparse
import os
import sys
from pathlib import Path

# Set for both processes, and before JAX is imported. One run is too short for a GPU.
os.environ["JAX_ENABLE_X64"], os.environ["JAX_PLATFORMS"] = "1", "cpu"
sys.path.insert(0, str(Path(__file__).parents[1]))

from tools.kept import keep_programs

from reproduction.report import KEPT, differences, read, reproduce


def main() -> int:
    """Reproduce; return 1 if a verdict or a special point differs from the kept report."""
    parser = argparse.ArgumentParser(
        prog="python experiments/reproduction",
        description="Draws Figures 1 to 4 of the paper and the boundaries of its discrepancy, and "
        "measures its claims and the faults of its printed text (report.md, report.json).",
    )
    parser.add_argument("--out", type=Path, default=Path("reproduction"), help="folder to write to")
    out = parser.parse_args().out
    keep_programs()
    try:
        found = reproduce(out)
    except KeyboardInterrupt:
        print(f"interrupted; what was written is in {out}", file=sys.stderr)
        return 130
    except OSError as error:  # the folder cannot be written to
        parser.exit(1, f"{error}\n")
    print("Claims and assumptions of the paper (Figures 3 and 4: ζ = 0.90, k = 0.50, Δ = 2a):")
    for claim in found.claims:
        print(f"  {claim.verdict:<25}{claim.name}")
    print(f"{len(found.faults)} faults of the printed text, with their numbers: report.md")
    print(f"Written to {out}: {', '.join(sorted(path.name for path in out.iterdir()))}")
    differing = differences(read(out / "report.json"), read(KEPT)) if KEPT.exists() else []
    for line in differing:
        print(f"not as in the kept report: {line}", file=sys.stderr)
    return int(bool(differing))


if __name__ == "__main__":
    sys.exit(main())
