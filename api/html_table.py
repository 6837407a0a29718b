"""Display tables: as HTML in notebooks, as aligned text elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..config.escaping import html_text

_MOST_ROWS = 60


@dataclass(frozen=True)
class Table:
    """Rows of text below a head; the first column names the row."""

    head: tuple[str, ...]
    rows: Sequence[Sequence[str]]

    def html(self) -> str:
        """Return an HTML table of at most 60 rows."""
        head = "".join(f"<th style='text-align:left'>{html_text(h)}</th>" for h in self.head)
        body = "".join(
            "<tr>"
            + "".join(f"<td style='text-align:left'>{html_text(c)}</td>" for c in row)
            + "</tr>"
            for row in self.rows[:_MOST_ROWS]
        )
        left = len(self.rows) - _MOST_ROWS
        more = f"<p>and {left} more rows</p>" if left > 0 else ""
        return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}"

    def text(self) -> str:
        """Return the table as lines of aligned text."""
        lines = [self.head, *self.rows]
        widths = [max(len(row[c]) for row in lines) for c in range(len(self.head))]
        return "\n".join(
            "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip()
            for row in lines
        )
