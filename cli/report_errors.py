"""Let a report fail last and alone: results are written and printed whatever happens to figures."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path

from ..report.plotting.undrawn_figures import take_undrawn_figures
from .progress import say

FAILED = 1


def report_or_error(write: Callable[[], object]) -> Exception | None:
    """Call what writes a report; return its error, which `exit_code_of_report` prints."""
    try:
        write()
    except Exception as error:  # noqa: BLE001 - printed after the results
        return error
    return None


def exit_code_of_report(error: Exception | None = None) -> int:
    """Print why the report or figures of it could not be written; return the exit code."""
    undrawn = take_undrawn_figures()
    for figure in undrawn:
        say(f"warning: a figure could not be drawn: {figure}")
    if error is not None:
        # The place, for whoever reads this in a bug report.
        place = traceback.extract_tb(error.__traceback__)[-1:]
        where = "".join(f" ({Path(frame.filename).name}:{frame.lineno})" for frame in place)
        say(
            "warning: the results are written, the report is not: "
            f"{type(error).__name__}: {error}{where}"
        )
    return FAILED if undrawn or error is not None else 0
