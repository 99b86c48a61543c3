"""Run the scripts and write `docs/validated.md`: `python experiments/validated [name ...]`.

If names are given, only these scripts are run, and nothing is written.
"""

import contextlib
import io
import re
import runpy
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
from tools.kept import keep_programs

PAGE = HERE.parents[1] / "docs" / "validated.md"
SCRIPTS = sorted(path for path in HERE.glob("*.py") if not path.name.startswith("_"))
# The order of the page: the best known examples first.
ORDER = (
    "siconos_balls", "matlab_balls", "contact_gradients", "heyoka_ramp", "heyoka_sensitivity",
    "coco_grazing", "coco_stick_slip", "pwsdde_pair", "mpgos_valve", "siconos_friction",
    "bstab_belt", "duffing_basins", "woodpecker", "walker", "siconos_chain", "siconos_bar",
)  # fmt: skip

BEGIN = """# Examples of other codes

This page computes published examples of other codes again and compares the numbers with theirs, or
with a reference solution. Each section is a script of at most sixty lines in
[`experiments/validated`](../experiments/validated); the tests run all of them and compare every
number below.

*Theirs* has the published digits, or those of a reference solution of the published equations.
*How* gives the origin: a documentation, a program, the reference file of a test, a closed form, or
an independent integrator. Times include compilation.
"""


def comparison_of(path: Path) -> Any:
    """Run a script without its output, and return its comparison."""
    with contextlib.redirect_stdout(io.StringIO()):
        return runpy.run_path(str(path))["comparison"]


def described(path: Path) -> tuple[str, str]:
    """Return the title and the text at the beginning of a script."""
    text = path.read_text(encoding="utf-8").split('"""')[1]
    title, _, body = text.partition("\n")
    return title.lstrip("# "), body.strip()


def section(path: Path, comparison: Any, seconds: float) -> str:
    """Return a section of the page."""
    title, text = described(path)
    source = re.sub(r"https://[^\s,;]+", r"<\g<0>>", comparison.source)
    return (
        f"## {comparison.code}: {title[0].lower()}{title[1:]}\n\n{text}\n\n{comparison}\n\n"
        f"*How:* {comparison.how}. *Source:* {source}.\n\n"
        f"[Script](../experiments/validated/{path.name}), {seconds:.0f} s.\n"
    )


def main() -> None:
    """Run all scripts and write the page, or only run the named scripts."""
    names = sys.argv[1:]
    keep_programs()
    assert sorted(ORDER) == [path.stem for path in SCRIPTS]
    sections = []
    for name in names or ORDER:
        begin = time.process_time()
        comparison = comparison_of(HERE / f"{name}.py")
        seconds = time.process_time() - begin
        sections.append(section(HERE / f"{name}.py", comparison, seconds))
        print(f"{name}, {seconds:.1f} s\n{comparison}\n", flush=True)
    if not names:
        PAGE.write_text("\n".join([BEGIN, *sections]), encoding="utf-8")


if __name__ == "__main__":
    main()
