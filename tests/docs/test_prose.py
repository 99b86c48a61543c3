"""Pages and docstrings are in plain English; code on pages fits a column."""

import ast
import inspect
import re
from pathlib import Path
from types import FunctionType

import pytest
import vi_jax as vi

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
WIDTH = 76
CODE = re.compile(r"^```\w*\n(.*?)^```$", re.M | re.S)
FORMULA = re.compile(r"\$\$.*?\$\$|\$[^$]*\$|`[^`]*`", re.S)
# A sentence that begins with a clause without a noun, as "What is there" or "Of these the first".
HEADLESS = re.compile(
    r"(?:^|(?<=[.!?] )|(?<=^- ))(?:What|Where|Of|That which|One that|Whoever)\b(?![^.]*\?)"
)
PHRASES = re.compile(
    r"\b(?:(?:is|are) none|such as is|of its own|whatever|wherever|beside"
    r"|(?:says?|tells?|knows?) (?:what|which|how|why|whether|where)"
    r"|(?:gradients?|derivatives?|differentiated) by (?!columns|hand))\b",
    re.I,
)


def paragraphs(text: str) -> list[str]:
    """Return each paragraph, item or row as one line, without code, formulas and headings."""
    text = FORMULA.sub("x", CODE.sub("", text))
    parts = re.split(r"\n\s*\n|\n(?=\s*[-|#]|\s*\d+\. )", text)
    return [" ".join(part.split()) for part in parts if not part.lstrip().startswith("#")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(DOCS).as_posix())
def test_plain_english(page):
    text = page.read_text("utf-8")
    wide = [x for code in CODE.findall(text) for x in code.splitlines() if len(x) > WIDTH]
    assert not wide
    found = [x for x in paragraphs(text) if HEADLESS.search(x) or PHRASES.search(x)]
    assert not found


VERBS = """Animate Compile Compute Count Draw End Estimate Find Follow Label Predict Return Run
Simulate Store Sweep Trace""".split()
CLAUSES = "What Where When Which How Why".split()


def documented():
    """Yield the docstrings of public functions, classes and their public members."""
    for module in (vi, vi.machines, vi.plot):
        for name in (x for x in dir(module) if x[0] != "_"):
            public = getattr(module, name)
            if inspect.isfunction(public) or inspect.isclass(public):
                yield name, public, inspect.getdoc(public) or ""
            for member, value in vars(public).items() if inspect.isclass(public) else ():
                if member[0] != "_" and isinstance(value, property | FunctionType):
                    yield f"{name}.{member}", value, inspect.cleandoc(value.__doc__ or "")


def test_docstrings_of_public_names():
    """Docstrings of functions begin with a verb, those of classes not with a clause."""
    for name, public, text in documented():
        if "." not in name and inspect.isfunction(public):
            assert text.split()[0] in VERBS, name
        elif inspect.isclass(public):
            assert text.split()[0] not in CLAUSES, name
        found = [x for x in paragraphs(text) if HEADLESS.search(x) or PHRASES.search(x)]
        assert not found, name


def test_docstrings_of_private_names_do_not_begin_with_a_clause():
    for path in sorted(Path(inspect.getfile(vi)).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module):
                text = ast.get_docstring(node) or "None"
                assert text.split()[0] not in [*CLAUSES, *"Of That Those Whether".split()], text
