"""Read the results of identify and trace, and summarise each in one line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ...config.escaping import one_line
from ...config.files.reading import read_json

RESULT = "result.json"


@dataclass(frozen=True)
class ResultSummary:
    """A result: its folder, the command, its logs, when it was written (UTC), and the outcome."""

    path: Path
    command: str
    logs: tuple[str, ...]
    written: datetime
    outcome: str

    def plain(self) -> dict[str, Any]:
        """Return the summary as JSON data."""
        return {
            "path": str(self.path),
            "command": self.command,
            "logs": list(self.logs),
            "written": self.written.isoformat(timespec="seconds"),
            "outcome": self.outcome,
        }


def read_result(folder: Path) -> ResultSummary | None:
    """Return the summary of a result's folder, None if there is no readable result.json."""
    path = folder / RESULT
    try:
        found = read_json(path)
        written = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    except (OSError, ValueError, OverflowError):  # of the file, or of its date
        return None
    if not isinstance(found, dict) or found.get("command") not in ("identify", "trace"):
        return None
    command = str(found["command"])
    try:
        outcome = _traced(found) if command == "trace" else _identified(found)
    except (LookupError, ArithmeticError, TypeError, ValueError, AttributeError):
        outcome = "result.json has another form than this version of levid writes"
    logs = found.get("logs")
    names = tuple(map(str, logs)) if isinstance(logs, list) else ()
    return ResultSummary(folder, command, names, written, one_line(outcome))


def _traced(found: Mapping[str, Any]) -> str:
    """Return the answer, and the error before and after in multiples of the noise."""
    checked = found["validation"]
    before, after, floor = (checked.get(k) for k in ("before", "after", "noise_floor"))
    answer = str(found["answer"])
    if before is None or after is None or not floor:
        return answer
    times = f"{before / floor:.3g} times the noise before, {after / floor:.3g} after"
    return f"{answer} (error {times})"


def _identified(found: Mapping[str, Any]) -> str:
    """Return orders by beam position, and how well the parameters of the model are known."""
    parts = []
    points = found.get("points") or []
    if points:
        orders = sorted({int(p["order"]) for p in points})
        places = sum(p["beam_m"] is not None for p in points)
        where = f" at {places} beam position{'s' * (places != 1)}" if places else ""
        shown = f"{orders[0]}" if len(orders) == 1 else f"{orders[0]} to {orders[-1]}"
        parts.append(f"order {shown}{where}")
    multisine = found.get("multisine") or []
    if multisine:
        parts.append(f"{len(multisine)} best linear approximations")
    grey = found.get("grey_box")
    if grey:
        shares = sorted(
            196.0 * p["se"] / abs(p["value"])
            for p in grey["parameters"].values()
            if p["se"] and p["value"]
        )
        text = f"{len(shares)} parameters fitted"
        if shares:
            text += f", half of them to {shares[len(shares) // 2]:.2g} % or better (95 %)"
        if grey["unidentifiable"]:
            text += f", {len(grey['unidentifiable'])} not identifiable"
        parts.append(text)
    return "; ".join(parts) or "no result"
