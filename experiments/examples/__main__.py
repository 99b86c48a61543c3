"""Runs the examples and writes their notebooks: `python experiments/examples [name ...]`.

The pictures go to `experiments/figures/examples`; with `--notebooks` nothing is run.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
FIGURES = HERE.parent / "figures" / "examples"
EXAMPLES = sorted(path for path in HERE.glob("*.py") if not path.name.startswith("_"))


def cells(text: str) -> list[tuple[str, str]]:
    """The cells of a script in percent format: "markdown" or "code", and what is in them.

    A title after `# %%` is a cell of text before the code.
    """
    found = []
    for part in ("\n" + text).split("\n# %%")[1:]:
        title, _, body = part.partition("\n")
        title, body = title.strip(), body.strip("\n")
        if title == "[markdown]":
            found.append(("markdown", body.strip('"').strip("\n")))
            continue
        if title:
            found.append(("markdown", title))
        found.append(("code", body))
    return found


def notebook(path: Path) -> str:
    """The notebook of an example, which ends with the picture that the example makes."""
    picture = f"![The picture of this example](../figures/examples/{path.stem}.png)"
    made = [*cells(path.read_text(encoding="utf-8")), ("markdown", picture)]
    listed: list[dict[str, Any]] = []
    for i, (kind, source) in enumerate(made):
        cell = {"cell_type": kind, "id": f"{path.stem}-{i}", "metadata": {}}
        if kind == "code":
            cell |= {"execution_count": None, "outputs": []}
        listed.append({**cell, "source": source.splitlines(keepends=True)})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    book = {"cells": listed, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(book, indent=1, ensure_ascii=False) + "\n"


def main() -> None:
    """Make the notebooks and pictures of all examples, or of those named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="examples; all of them if left out")
    parser.add_argument("--notebooks", action="store_true", help="only write the notebooks")
    options = parser.parse_args()
    FIGURES.mkdir(parents=True, exist_ok=True)
    for path in EXAMPLES:
        if options.names and path.stem not in options.names:
            continue
        path.with_suffix(".ipynb").write_text(notebook(path), encoding="utf-8")
        if not options.notebooks:
            print(f"{path.stem} …", flush=True)
            subprocess.run([sys.executable, str(path)], cwd=FIGURES, check=True)


if __name__ == "__main__":
    main()
