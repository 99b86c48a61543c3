"""Run the examples and write their notebooks: `python experiments/examples [name ...]`.

The pictures go to `experiments/figures/examples`. With `--notebooks` no example is run, and the
notebooks keep their printed output.
"""

import argparse
import base64
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from tools.kept import keep_programs
from tools.pictures import shrink

FIGURES = HERE.parent / "figures" / "examples"
EXAMPLES = sorted(path for path in HERE.glob("*.py") if not path.name.startswith("_"))

# The first cell of each notebook.
INSTALL = """\
# Where vi_jax is missing, as in a hosted notebook, it is installed: from a wheel that was put
# beside this notebook, or else from the checkout that the notebook lies in.
import importlib.util
import subprocess
import sys
from pathlib import Path

if importlib.util.find_spec("vi_jax") is None:
    source = next(Path.cwd().glob("vi_jax-*.whl"), Path.cwd().parents[1])
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", str(source)], check=True)\
"""

# Runs cells one after the other in one namespace.
_RUN = """
import contextlib, io, json, sys
_asked, _told = sys.argv[1:]
_texts = []
for _source in json.load(open(_asked, encoding="utf-8")):
    with contextlib.redirect_stdout(io.StringIO()) as _out:
        exec(_source, globals())
    _texts.append(_out.getvalue())
json.dump(_texts, open(_told, "w", encoding="utf-8"))
"""


def cells(text: str) -> list[tuple[str, str]]:
    """Return the cells of a script in percent format: "markdown" or "code", and the content.

    A title after `# %%` becomes a Markdown cell before the code.
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


def printed(path: Path) -> list[str]:
    """Run a script cell by cell, as a notebook does, and return the output of each code cell."""
    with TemporaryDirectory() as folder:
        asked, told = Path(folder) / "cells.json", Path(folder) / "printed.json"
        sources = [source for kind, source in cells(path.read_text("utf-8")) if kind == "code"]
        asked.write_text(json.dumps(sources), encoding="utf-8")
        command = [sys.executable, "-c", _RUN, str(asked), str(told)]
        subprocess.run(command, cwd=FIGURES, env={**os.environ, "MPLBACKEND": "Agg"}, check=True)
        return json.loads(told.read_text(encoding="utf-8"))


def printed_in(book: str) -> list[str]:
    """Return the printed output of a notebook's code cells, without the cell that installs."""
    code = [cell for cell in json.loads(book)["cells"] if cell["cell_type"] == "code"]
    texts = [[out["text"] for out in x["outputs"] if out.get("name") == "stdout"] for x in code]
    return ["".join(lines for text in each for lines in text) for each in texts[1:]]


def notebook(path: Path, texts: Sequence[str]) -> str:
    """Return the notebook of an example, with its output and, below the last cell, its picture.

    **Arguments:** the script; the printed output of each of its code cells.
    """
    parts = cells(path.read_text(encoding="utf-8"))
    parts.insert(1, ("code", INSTALL))
    places = [i for i, (kind, _) in enumerate(parts) if kind == "code"]
    told = dict(zip(places, ["", *texts], strict=True))
    picture = base64.b64encode((FIGURES / f"{path.stem}.png").read_bytes()).decode()
    listed: list[dict[str, Any]] = []
    for i, (kind, source) in enumerate(parts):
        cell = {"cell_type": kind, "id": f"{path.stem}-{i}", "metadata": {}}
        if kind == "code":
            outputs: list[dict[str, Any]] = []
            if told[i]:
                lines = told[i].splitlines(keepends=True)
                outputs.append({"output_type": "stream", "name": "stdout", "text": lines})
            if i == places[-1]:
                data = {"image/png": picture}
                outputs.append({"output_type": "display_data", "metadata": {}, "data": data})
            cell |= {"execution_count": places.index(i) + 1, "outputs": outputs}
        listed.append({**cell, "source": source.splitlines(keepends=True)})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    book = {"cells": listed, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(book, indent=1, ensure_ascii=False) + "\n"


def main() -> None:
    """Make the notebooks and pictures of the named examples, or of all examples."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="examples; all of them if left out")
    parser.add_argument("--notebooks", action="store_true", help="only write the notebooks")
    options = parser.parse_args()
    keep_programs()
    FIGURES.mkdir(parents=True, exist_ok=True)
    for path in EXAMPLES:
        if options.names and path.stem not in options.names:
            continue
        book = path.with_suffix(".ipynb")
        if options.notebooks:
            texts = printed_in(book.read_text(encoding="utf-8"))
        else:
            print(f"{path.stem} …", flush=True)
            texts = printed(path)
            shrink(FIGURES / f"{path.stem}.png")
        book.write_text(notebook(path, texts), encoding="utf-8")


if __name__ == "__main__":
    main()
