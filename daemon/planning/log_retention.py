"""Delete the oldest logs below the rig's log folder, by age and by quota; never the newest flights.

A flight is a folder with logs. Only its logs are deleted: reports and models beside them stay, and
links are not followed. A folder that is empty then goes as well.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from ...config.daemon_settings import Recording

_DAY_S = 86_400.0
_MOST_FOLDERS = 100_000
"""Folders that are searched: a limit on the time of a lift-off."""


@dataclass(frozen=True)
class Flight:
    """A folder with logs: their paths and size, and when the newest was last written."""

    folder: Path
    logs: tuple[Path, ...]
    size: int
    written_s: float


def delete_old_logs(
    root: Path, settings: Recording, needed_bytes: int, now_s: float
) -> list[Flight]:
    """Delete logs below `root` that are too old, or exceed the quota with those to come.

    Returns the flights whose logs were deleted, oldest first. The newest `keep_flights` stay.
    """
    flights = sorted(_flights(root), key=lambda flight: flight.written_s)
    total = sum(flight.size for flight in flights) + needed_bytes
    most = None if settings.quota_gb is None else settings.quota_gb * 1e9
    oldest_s = None if settings.keep_days is None else now_s - settings.keep_days * _DAY_S
    deleted = []
    for flight in flights[: max(len(flights) - settings.keep_flights, 0)]:
        expired = oldest_s is not None and flight.written_s < oldest_s
        if not expired and not (most is not None and total > most):
            continue
        for log in flight.logs:
            with contextlib.suppress(FileNotFoundError):
                log.unlink()
        with contextlib.suppress(OSError):  # reports stay
            flight.folder.rmdir()
        total -= flight.size
        deleted.append(flight)
    return deleted


def size_of_logs(root: Path) -> int:
    """Return the bytes that all logs below a folder take."""
    return sum(flight.size for flight in _flights(root))


def _flights(root: Path) -> Iterator[Flight]:
    for number, (folder, _, names) in enumerate(os.walk(root)):
        if number >= _MOST_FOLDERS:
            return
        logs, size, written_s = [], 0, 0.0
        for name in names:
            path = Path(folder, name)
            if path.suffix == ".mcap" and (found := _log(path)) is not None:
                logs.append(path)
                size += found.st_blocks * 512
                written_s = max(written_s, found.st_mtime)
        if logs:
            yield Flight(Path(folder), tuple(logs), size, written_s)


def _log(path: Path) -> os.stat_result | None:
    """Return the status of a log; None for links and other files."""
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode):
            return None
        with path.open("rb") as file:
            return found if file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC else None
    except OSError:
        return None
