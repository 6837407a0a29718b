"""Save the result of identify or trace as result.json, the object that --json prints."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..config.files.atomic_write import write_file
from ..log.catalogue.results import RESULT

REPORT_FILES, REPORT_FOLDERS = ("model.yaml", RESULT, "index.html"), ("figures",)
"""What the report of an identification or a trace writes into its folder."""


def with_origin(command: str, logs: Sequence[Path], plain: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result with its `command` and the absolute paths of its `logs`.

    `levid compare` and `levid list` read them.
    """
    return {**plain, "command": command, "logs": [str(log.resolve()) for log in logs]}


def save_result(folder: Path, whole: Mapping[str, Any]) -> None:
    """Write folder/result.json; raises OSError."""
    write_file(folder / RESULT, json.dumps(whole) + "\n")
