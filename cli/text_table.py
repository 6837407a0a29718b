"""Print tables of text with aligned columns, in the same form on a terminal and in a pipe."""

from __future__ import annotations

from collections.abc import Sequence

from ..config.escaping import one_line


def text_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()
) -> list[str]:
    """Return the lines of a table; columns that are empty in all rows are left out.

    right: numbers of the columns that are aligned right.
    """
    shown = [i for i in range(len(head)) if any(row[i] for row in rows)]
    cells = [[one_line(row[i]) for i in shown] for row in (head, *rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(shown))]
    lines = []
    for row in cells:
        parts = [
            cell.rjust(width) if shown[k] in right else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(parts).rstrip())
    return lines
