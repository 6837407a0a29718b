"""Flight recorder: write the last seconds before a fault from the ring to a log of its own."""

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

from ...config.daemon_settings import Recording
from ...config.files.folders import make_folder
from ...config.rig import RigConfig
from ...log.errors import LogError
from ...log.writer import LogWriter
from ..control.faults import Fault
from ..ipc.row_ring import Ring, RingRows
from .coil_heat_file import state_folder

_AFTER_S = 0.5
_WAIT_S = 2.0
_MAX_PENDING = 8
"""Faults that may wait for their recording; the recordings of these contain further faults."""
_FULL = (errno.ENOSPC, errno.EDQUOT)

NO_ROWS = "no rows before the fault"
"""Reason for a missing recording that is no error: the loop had not started."""


class FaultLog:
    """Detect faults in the rows of the ring and write a flight recording of each.

    `report(fault, path, problem)` is called for each recording. `path` is empty if it could not be
    written; otherwise `problem` says what is missing in it, if anything. The newest `keep_faults`
    recordings are kept. On a full disk, the oldest one is removed first if the folder holds that
    many; a recording that then cannot be completed is removed.
    """

    def __init__(
        self,
        ring: Ring,
        rate_hz: float,
        folder: Path,
        config: Recording,
        attachments: Mapping[str, bytes],
        report: Callable[[Fault, str, str], None],
    ) -> None:
        self._ring, self._rate_hz, self._folder = ring, rate_hz, folder
        self._before = int(config.before_fault_s * rate_hz)
        self._after = int(_AFTER_S * rate_hz)
        self._keep, self._attachments, self._report = config.keep_faults, attachments, report
        self._fault = Fault.NONE
        self._pending: deque[tuple[Fault, int, float]] = deque()
        self._written: list[Path] = []
        self.epoch_ns = 0

    def resume(self, scanned: int, end: int) -> None:
        """Continue for a dead recorder that scanned `scanned` rows; scan on up to row `end`."""
        before = self._ring.copy(max(scanned - 1, 0), 1)
        if scanned and before.first == scanned - 1 and len(before.rows):
            self._fault = Fault(int(before.rows["fault"][0]))
        self.scan(self._ring.copy(scanned, end - scanned))

    @property
    def idle(self) -> bool:
        """Whether all faults found so far are on disk."""
        return not self._pending

    def scan(self, read: RingRows) -> None:
        """Search rows read from the ring for new faults; write recordings that are complete."""
        if len(read.rows):
            faults = read.rows["fault"]
            new = (faults != 0) & (np.concatenate([[self._fault], faults[:-1]]) == 0)
            deadline_s = time.monotonic() + _WAIT_S
            for at in np.flatnonzero(new)[: _MAX_PENDING - len(self._pending)].tolist():
                self._pending.append((Fault(int(faults[at])), read.first + at, deadline_s))
            self._fault = Fault(int(faults[-1]))
        while self._pending:
            fault, row, deadline_s = self._pending[0]
            # A loop that died writes no more rows: stop waiting at the deadline.
            if self._ring.tail < row + self._after and time.monotonic() <= deadline_s:
                return
            self._pending.popleft()
            self.write(fault, row + self._after)

    def finish(self) -> None:
        """Write pending recordings with the rows available: no more rows will come."""
        while self._pending:
            fault, row, _ = self._pending.popleft()
            self.write(fault, row + self._after)

    def write(self, fault: Fault, end: int | None = None) -> None:
        """Write the last seconds before row `end` (default: the newest) as recording of `fault`."""
        end = self._ring.head if end is None else end
        first = max(end - self._before - self._after, 0)
        found = self._ring.copy(first, end - first)
        rows = found.rows[: max(end - found.first, 0)]  # `copy` replaces overwritten rows by later
        if not len(rows):
            self._report(fault, "", NO_ROWS if not first else "its rows were overwritten")
            return
        # Rows that existed but were overwritten; time before the first row does not count.
        lacking_s = (found.first - first) / self._rate_hz
        try:
            try:
                path, problem = self._write(fault, rows, lacking_s)
            except Exception as error:
                if not _is_full(error) or not self._prune(max(self._keep - 1, 1)):
                    raise
                path, problem = self._write(fault, rows, lacking_s)
        except Exception as error:  # noqa: BLE001 - reported; a full disk must not end the recorder
            self._report(fault, "", str(error))
            return
        self._written.append(path)
        self._prune(self._keep)
        lacks = self._lacks(lacking_s) if lacking_s else ""
        self._report(fault, str(path), "; ".join(filter(None, (lacks, problem))))

    def _write(self, fault: Fault, rows: NDArray[np.void], lacking_s: float) -> tuple[Path, str]:
        """Write a recording; return its path and problem. Raises LogError, OSError."""
        times = self.epoch_ns + np.rint(rows["cycle"] * (1e9 / self._rate_hz)).astype(np.uint64)
        make_folder(self._folder)
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
        problem, written = "", False
        try:
            log.write(rows, times)
            try:
                log.close()
            except LogError as error:
                if log.buffered:
                    raise
                problem = str(error)  # all rows are written, only the summary is missing
            written = True
        finally:
            # The last chunk holds the fault: without it the recording is useless and takes space.
            if not written:
                with suppress(OSError):
                    path.unlink()
        return path, problem

    def _lacks(self, seconds: float) -> str:
        nominal_s = self._before / self._rate_hz
        lacking_s = min(seconds, nominal_s)
        return (
            f"the first {lacking_s:.1f} of {nominal_s:g} s before the fault are missing: the "
            "recorder was too late"
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
        """Remove all but the newest `keep` recordings; return how many were removed."""
        # Names sort by the time of day, which may have been set back: recordings of this process
        # count as newer than all others.
        found = set(self._folder.glob("fault-*.mcap"))
        self._written = [path for path in self._written if path in found]
        before = sorted(found - set(self._written))
        removed = 0
        for path in [*before, *self._written][: max(len(found) - keep, 0)]:
            with suppress(OSError):
                path.unlink(missing_ok=True)
                removed += 1
        return removed


def _is_full(error: BaseException | None) -> bool:
    """Return whether the disk is full, by this error or an earlier one in its context."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _FULL:
            return True
        error = error.__context__
    return False


def fault_folder(rig: RigConfig, folder: Path) -> Path:
    """Return the folder of flight recordings: of the rig, otherwise of the service or user."""
    if rig.recording.faults is not None:
        return folder / rig.recording.faults
    return state_folder() / "faults"
