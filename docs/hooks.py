"""Takes into the site what lies beside `docs/`, so that the same links hold there and here.

A page links to `../experiments/...` as it lies in the repository; the site holds a copy of what is
linked, and `../` is taken off. Formulas become MathML, which browsers draw without a script, a font
or a server.
"""

import html
import logging
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

try:
    from latex2mathml.converter import convert  # pyright: ignore[reportMissingImports]
except ImportError:  # pages show the source of their formulas then
    convert = None

ROOT = Path(__file__).resolve().parents[1]
KINDS = {".md", ".png", ".gif", ".py", ".ipynb", ".toml"}
FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</(?:span|div)>',
    re.DOTALL,
)
# Upright letters, which the converter writes as numbers or in a variant that browsers do not draw.
UPRIGHT = re.compile(r'<mi>(&#x000[4-7][0-9A-F];)</mi>|<mi mathvariant="sans-serif">(\w)</mi>')
BESIDE = re.compile(r"\]\(((?:\.\./)+)(experiments/|CHANGELOG\.md)")


def on_files(files: Any, config: Any) -> Any:
    """Add the studies, the examples, their pictures and the changelog."""
    outside = [p for p in (ROOT / "experiments").rglob("*") if p.suffix in KINDS and p.is_file()]
    for path in [*outside, ROOT / "CHANGELOG.md"]:
        name = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links that leave `docs/` go to the copies."""
    if page.file.src_uri.startswith("experiments/"):
        return markdown
    return BESIDE.sub(lambda m: f"]({m[1].removeprefix('../')}{m[2]}", markdown)


def on_page_content(content: str, page: Any, config: Any, files: Any) -> str:
    """Formulas, as `pymdownx.arithmatex` marks them, are set."""
    if convert is None:
        if FORMULA.search(content):
            logging.getLogger("mkdocs").info(
                "%s: formulas are shown as their source; `pip install '.[docs]'` for latex2mathml",
                page.file.src_uri,
            )
        return content
    return FORMULA.sub(_set, content)


def _set(formula: re.Match[str]) -> str:
    """The MathML of a formula; one on a line of its own may be scrolled on a narrow screen."""
    assert convert is not None
    block = formula[1] == "div"
    drawn = convert(
        html.unescape(formula[2]).strip(),
        display="block" if block else "inline",
    )
    drawn = UPRIGHT.sub(lambda m: f'<mi mathvariant="normal">{m[1] or m[2]}</mi>', drawn)
    return f'<div class="formula">{drawn}</div>' if block else drawn
