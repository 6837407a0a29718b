"""Save the result of identify or trace as OUT/result.json, the object that --json prints."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

RESULT = "result.json"


def save_result(
    out: Path, command: str, logs: Sequence[Path], plain: Mapping[str, Any]
) -> dict[str, Any]:
    """Write OUT/result.json and return its object: the result, with `command` and `logs`.

    `levid compare` and `levid list` read it. The paths of logs are absolute.
    """
    from ..report.plotting.atomic_write import replace_text

    whole = {**plain, "command": command, "logs": [str(log.resolve()) for log in logs]}
    replace_text(out / RESULT, json.dumps(whole) + "\n")
    return whole
