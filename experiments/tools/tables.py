"""Tables in Markdown."""

from collections.abc import Iterable, Sequence


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table.

    **Arguments:** the columns' headings; the rows, with a cell for each of them, shown as `str`
    shows it.

    **Raises:** `ValueError` if a row has another number of cells.
    """
    # A heading without text is one blank wide.
    lines = [_line(heads).replace("  ", " "), "|" + "---|" * len(heads)]
    for row in rows:
        if len(row) != len(heads):
            raise ValueError(f"{len(row)} cells under {len(heads)} headings: {row}")
        lines.append(_line(row))
    return "\n".join(lines)


def _line(cells: Sequence[object]) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"
