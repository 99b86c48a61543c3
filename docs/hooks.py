"""Takes into the site what lies beside `docs/`, so that the same links hold there and here.

A page links to `../experiments/...` as it lies in the repository; the site holds a copy of what is
linked, and `../` is taken off.
"""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
KINDS = {".md", ".png", ".py", ".ipynb", ".toml"}
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
