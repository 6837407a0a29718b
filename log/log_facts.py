"""Read who flew a log, what and when: from its metadata and attachments."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import yaml

VIRTUAL_FROM_NS, VIRTUAL_TO_NS = 1_577_836_800_000_000_000, 1_577_836_800_000_000_000 + 10**16
"""Log times of flights in virtual time: they begin at a fixed date, 2020-01-01."""


def rig_name(attachments: Mapping[str, bytes]) -> str:
    """Return the name in the attached rig.yaml, empty if there is none."""
    text = attachments.get("rig.yaml")
    if text is None:
        return ""
    try:
        rig = yaml.safe_load(text)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError):
        return ""
    return printable(str(rig.get("name", ""))) if isinstance(rig, dict) else ""


def versions(attachments: Mapping[str, bytes]) -> dict[str, str]:
    """Return the versions of programs that wrote a log; empty if they are not a JSON object."""
    try:
        found = json.loads(attachments.get("versions.json", b"{}"))
    except (ValueError, RecursionError):
        return {}
    return {str(k): str(v) for k, v in found.items()} if isinstance(found, dict) else {}


def is_virtual(first_log_time_ns: int) -> bool:
    """Return whether a log was flown in virtual time, where log times tell no date."""
    return VIRTUAL_FROM_NS <= first_log_time_ns < VIRTUAL_TO_NS


def date_of(path: Path, first_log_time_ns: int) -> datetime:
    """Return when a log was flown, in UTC: its first log time, else the file's date.

    Imported data and virtual flights have log times that are no dates.
    """
    if is_virtual(first_log_time_ns) or first_log_time_ns < VIRTUAL_FROM_NS:
        return datetime.fromtimestamp(path.stat().st_mtime, UTC)
    return datetime.fromtimestamp(first_log_time_ns / 1e9, UTC)


def printable(text: str) -> str:
    """Return text without control characters, which would move a terminal's cursor."""
    return "".join(c if c.isprintable() else "?" for c in text)
