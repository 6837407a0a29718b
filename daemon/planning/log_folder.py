"""Create the folder for the logs of a flight: where it may be, and with room for them."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

from ...config.daemon_settings import Recording
from ...config.files import folders
from ..control.preflight_findings import Check, Finding
from .log_retention import Flight, delete_old_logs, size_of_logs
from .refused_request import RefusedError, override_hint

_MOST_NAMED = 5


def make_folder(
    folder: Path, needed_bytes: int = 0, root: str = "", recording: Recording | None = None
) -> str:
    """Create the folder for the logs of a flight, which may take `needed_bytes`.

    With a `root`, the folder must be below it, and old logs there are deleted as `recording` says.
    Returns a journal line about these, empty if there were none.

    Raises:
        RefusedError: it cannot be created, is not below `root`, holds logs, is not writable, or its
            disk is too full.
    """
    if problem := folder_problem(folder, Path(root) if root else None):
        raise RefusedError(problem)
    try:
        folders.make_folder(folder)
    except OSError as error:
        raise RefusedError(f"{folder}: cannot create the folder: {error.strerror}") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise RefusedError(f"{folder}: the daemon has no write access to this folder")
    note = ""
    if root and recording is not None:
        note = _words(delete_old_logs(Path(root), recording, needed_bytes, time.time()))
        most = recording.quota_gb
        if most is not None and size_of_logs(Path(root)) + needed_bytes > 1e9 * most:
            note = "; ".join(
                filter(
                    None, [note, f"logs exceed recording.quota_gb, {most:g} GB, with this flight"]
                )
            )
    finding = disk_finding(folder, needed_bytes)
    if finding.failed:
        raise RefusedError(f"not ready to lift off: {finding}{override_hint(finding.check)}")
    return note


def folder_problem(folder: Path, root: Path | None) -> str:
    """Return why logs may not be written into a folder, as far as that is seen; else empty."""
    if root is not None and not folder.resolve().is_relative_to(root.resolve()):  # links count
        return f"{folder}: expected a folder below {root} (recording.root)"
    if folder.exists() and not folder.is_dir():
        return f"{folder}: expected a folder, found another kind of file"
    if any(folder.glob("*.mcap")):
        return f"{folder}: expected a folder without logs; name another one"
    return ""


def disk_finding(folder: Path, needed_bytes: int) -> Finding:
    """Return whether the disk of an existing folder has room for logs of this size."""
    found = os.statvfs(folder)
    free = found.f_bavail * found.f_frsize
    return Finding.of(
        Check.DISK,
        needed_bytes <= free,
        f"{folder} has {1e-6 * free:.0f} MB free; the logs take up to {1e-6 * needed_bytes:.0f} MB",
        "remove files, or log to another disk",
    )


def _words(flights: Sequence[Flight]) -> str:
    if not flights:
        return ""
    names = ", ".join(str(flight.folder) for flight in flights[:_MOST_NAMED])
    more = f" and {len(flights) - _MOST_NAMED} more" if len(flights) > _MOST_NAMED else ""
    size = 1e-6 * sum(flight.size for flight in flights)
    return f"deleted old logs, {size:.0f} MB, of {names}{more} (recording in RIG.yaml)"
