"""The flight recorder: what the ring holds of the last seconds before a fault goes to disk."""

from __future__ import annotations

import errno
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...config.service import Recording
from ...log.errors import LogError
from ...log.writer import LogWriter
from ..control.faults import Fault
from ..ipc.row_ring import Ring, RingRows
from .coil_heat import state_folder

_AFTER_S = 0.5
_PATIENCE_S = 2.0
_MOST_DUE = 8
"""Faults that wait for their recording at a time; others are in those of these."""
_FULL = (errno.ENOSPC, errno.EDQUOT)

NO_ROWS = "there were no rows before it"
"""Why a fault has no recording where nothing failed: the loop had not begun."""


class FaultLog:
    """Sees a fault come in the rows that go by, and writes a log of its own around it.

    `told(fault, path, why)` is called when one was written, or could not be: then path is empty.
    With a path, `why` says what it lacks, if anything. The newest `keep_faults` of the folder are
    kept. On a full disk one of more than that goes first; what then fails to be written whole is
    removed.
    """

    def __init__(
        self,
        ring: Ring,
        rate_hz: float,
        folder: Path,
        config: Recording,
        attachments: Mapping[str, bytes],
        told: Callable[[Fault, str, str], None],
    ) -> None:
        self._ring, self._rate_hz, self._folder = ring, rate_hz, folder
        self._before = int(config.before_fault_s * rate_hz)
        self._after = int(_AFTER_S * rate_hz)
        self._keep, self._attachments, self._told = config.keep_faults, attachments, told
        self._fault = Fault.NONE
        self._due: deque[tuple[Fault, int, float]] = deque()
        self._written: list[Path] = []
        self.epoch_ns = 0

    def resume(self, seen: int, up_to: int) -> None:
        """Take over from a recorder that died when it had dealt with the faults of `seen` rows."""
        before = self._ring.copy(max(seen - 1, 0), 1)
        if seen and before.first == seen - 1 and len(before.rows):
            self._fault = Fault(int(before.rows["fault"][0]))
        self.see(self._ring.copy(seen, up_to - seen))

    @property
    def nothing_due(self) -> bool:
        """Whether all faults seen so far are on disk."""
        return not self._due

    def see(self, taken: RingRows) -> None:
        """Look through rows that were taken from the ring; write what is due."""
        if len(taken.rows):
            faults = taken.rows["fault"]
            came = (faults != 0) & (np.concatenate([[self._fault], faults[:-1]]) == 0)
            give_up_s = time.monotonic() + _PATIENCE_S
            for at in np.flatnonzero(came)[: _MOST_DUE - len(self._due)].tolist():
                self._due.append((Fault(int(faults[at])), taken.first + at, give_up_s))
            self._fault = Fault(int(faults[-1]))
        while self._due:
            fault, row, give_up_s = self._due[0]
            # A loop that died with its fault writes no more rows.
            if self._ring.tail < row + self._after and time.monotonic() <= give_up_s:
                return
            self._due.popleft()
            self.write(fault, row + self._after)

    def finish(self) -> None:
        """Write what is due, as far as it goes: no more rows will come."""
        while self._due:
            fault, row, _ = self._due.popleft()
            self.write(fault, row + self._after)

    def write(self, fault: Fault, end: int | None = None) -> None:
        """Write the last seconds before row `end`, or before the newest, as those of `fault`."""
        end = self._ring.head if end is None else end
        first = max(end - self._before - self._after, 0)
        found = self._ring.copy(first, end - first)
        rows = found.rows[: max(end - found.first, 0)]  # later ones stand for those that are gone
        if not len(rows):  # whoever asked for it waits to hear of it
            self._told(fault, "", NO_ROWS if not first else "its rows are gone")
            return
        # Of before the first row there is nothing to tell: this is about rows that there were.
        lacking_s = (found.first - first) / self._rate_hz
        try:
            try:
                path, why = self._write(fault, rows, lacking_s)
            except Exception as error:
                if not _is_full(error) or not self._prune(max(self._keep - 1, 1)):
                    raise
                path, why = self._write(fault, rows, lacking_s)
        except Exception as error:  # noqa: BLE001 - told; a full disk must not end the recorder
            self._told(fault, "", str(error))
            return
        self._written.append(path)
        self._prune(self._keep)
        lacks = self._lacks(lacking_s) if lacking_s else ""
        self._told(fault, str(path), "; ".join(filter(None, (lacks, why))))

    def _write(self, fault: Fault, rows: NDArray[np.void], lacking_s: float) -> tuple[Path, str]:
        """Write one and return it, and what is wrong with it. Raises LogError, OSError."""
        times = self.epoch_ns + np.rint(rows["cycle"] * (1e9 / self._rate_hz)).astype(np.uint64)
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._free_path(int(times[-1]), fault)
        log = LogWriter(
            path,
            self._ring.dtype,
            rate_hz=self._rate_hz,
            metadata={
                **{"kind": "fault", "name": fault.name, "step": "0", "session": ""},
                **({"lacks_s": f"{lacking_s:.3f}"} if lacking_s else {}),
            },
            attachments=self._attachments,
        )
        why, written = "", False
        try:
            log.write(rows, times)
            try:
                log.close()
            except LogError as error:
                if log.buffered:
                    raise
                why = str(error)  # all rows are in it: it opens, it lacks its summary only
            written = True
        finally:
            # The fault is in the last chunk: without it the file tells nothing of the fault, counts
            # as one that is kept, and takes room that the next one could have.
            if not written:
                with suppress(OSError):
                    path.unlink()
        return path, why

    def _lacks(self, seconds: float) -> str:
        promised_s = self._before / self._rate_hz
        lacking_s = min(seconds, promised_s)
        return (
            f"it lacks the first {lacking_s:.1f} of {promised_s:g} s before the fault, for which "
            f"the recorder was too late"
        )

    def _free_path(self, time_ns: int, fault: Fault) -> Path:
        at = datetime.fromtimestamp(time_ns * 1e-9, UTC).strftime("%Y%m%dT%H%M%S.%f")[:-3]
        path = self._folder / f"fault-{at}Z-{fault.name}.mcap"
        number = 1
        while path.exists():
            number += 1
            path = self._folder / f"fault-{at}Z-{fault.name}.{number}.mcap"
        return path

    def _prune(self, keep: int) -> int:
        """Remove all but the newest `keep`; return how many went."""
        # The time of day stands first in the names: their order is that of the faults, but where
        # the clock is behind. What this process wrote is newer than all else, whatever it says.
        found = set(self._folder.glob("fault-*.mcap"))
        self._written = [path for path in self._written if path in found]
        before = sorted(found - set(self._written))
        gone = 0
        for path in [*before, *self._written][: max(len(found) - keep, 0)]:
            with suppress(OSError):  # the new one is written all the same
                path.unlink(missing_ok=True)
                gone += 1
        return gone


def _is_full(error: BaseException | None) -> bool:
    """Return whether the disk had no room; a LogError has the system's error behind it."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _FULL:
            return True
        error = error.__context__
    return False


def fault_folder(rig: RigConfig, folder: Path) -> Path:
    """Return where flight recordings go: as the rig says, else among this user's or service's."""
    if rig.recording.faults is not None:
        return folder / rig.recording.faults
    return state_folder() / "faults"
