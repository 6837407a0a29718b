"""Read rig, versions and date of a log from its attachments and log times."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from ..config.base import ConfigError, mapping_of
from ..config.escaping import one_line
from ..config.files.reading import JsonError, parse_json

VIRTUAL_EPOCH_NS = 1_577_836_800_000_000_000
"""Log time of cycle 0 in virtual time, 2020-01-01T00:00:00Z: logs of equal runs are identical."""
_LAST_S = datetime(9999, 1, 1, tzinfo=UTC).timestamp()
"""Dates of files can be later: they are wrong, and no date in any time zone."""
_LONGEST_VIRTUAL_NS = 10**16
"""Longest flight in virtual time, 116 days; later log times are dates."""


def rig_name(attachments: Mapping[str, bytes]) -> str:
    """Return the name in the attached rig.yaml, empty if there is none."""
    text = attachments.get("rig.yaml")
    if text is None:
        return ""
    try:
        return one_line(str(mapping_of(text, "rig.yaml").get("name", "")))
    except ConfigError:
        return ""


def versions(attachments: Mapping[str, bytes]) -> dict[str, str]:
    """Return the versions of programs that wrote a log; empty if they are not a JSON object."""
    try:
        found = parse_json(attachments.get("versions.json", b"{}"))
    except JsonError:
        return {}
    return (
        {one_line(str(k)): one_line(str(v)) for k, v in found.items()}
        if isinstance(found, dict)
        else {}
    )


def is_virtual(first_log_time_ns: int) -> bool:
    """Return whether a log was flown in virtual time, where log times tell no date."""
    return 0 <= first_log_time_ns - VIRTUAL_EPOCH_NS < _LONGEST_VIRTUAL_NS


def flight_date(first_log_time_ns: int, attachments: Mapping[str, bytes]) -> datetime | None:
    """Return when a log was flown, in UTC; None for a virtual flight and for imported data."""
    if "signals.yaml" in attachments or first_log_time_ns < VIRTUAL_EPOCH_NS + _LONGEST_VIRTUAL_NS:
        return None
    return datetime.fromtimestamp(first_log_time_ns / 1e9, UTC)


def file_date(*paths: Path) -> datetime:
    """Return when the newest of these files was written, in UTC; 1970 if no file has a date."""
    newest_s = max((s for path in paths if 0.0 < (s := _written_s(path)) < _LAST_S), default=0.0)
    return datetime.fromtimestamp(newest_s, UTC)


def _written_s(path: Path) -> float:
    """Return when a file was written, in s since 1970; of a link that leads nowhere, the link."""
    try:
        return path.stat().st_mtime
    except OSError:
        return path.lstat().st_mtime
