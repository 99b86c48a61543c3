"""Tables in Markdown."""

from collections.abc import Iterable, Sequence


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table.

    **Arguments:** the columns' headings; the rows, each with one cell per column, written by `str`.

    **Raises:** `ValueError` if the number of cells of a row is not that of the headings.
    """
    # An empty heading is one space wide.
    lines = [_line(heads).replace("  ", " "), "|" + "---|" * len(heads)]
    for row in rows:
        if len(row) != len(heads):
            raise ValueError(f"{len(row)} cells under {len(heads)} headings: {row}")
        lines.append(_line(row))
    return "\n".join(lines)


def _line(cells: Sequence[object]) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"
