"""The flight recorder: what the ring holds of the last seconds before a fault goes to disk."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from ..config.rig import RigConfig
from ..config.service import Recording
from ..log.writer import LogWriter
from .faults import Fault
from .heat import state_folder
from .ring import Ring, Rows

_AFTER_S = 0.5
_PATIENCE_S = 2.0
_MOST_DUE = 8
"""Faults that wait for their recording at a time; others are in those of these."""


class FaultLog:
    """Sees a fault come in the rows that go by, and writes a log of its own around it.

    `told(fault, path, why)` is called when one was written, or could not be: then path is empty.
    With a path, `why` says what it lacks, if anything. The newest `keep_faults` of the folder are
    kept.
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

    def see(self, taken: Rows) -> None:
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
            self._told(
                fault, "", "there were no rows before it" if not first else "its rows are gone"
            )
            return
        # Of before the first row there is nothing to tell: this is about rows that there were.
        lacking_s = (found.first - first) / self._rate_hz
        times = self.epoch_ns + np.rint(rows["cycle"] * (1e9 / self._rate_hz)).astype(np.uint64)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            path = self._free_path(int(times[-1]), fault)
            with LogWriter(
                path,
                self._ring.dtype,
                rate_hz=self._rate_hz,
                metadata={
                    **{"kind": "fault", "name": fault.name, "step": "0", "session": ""},
                    **({"lacks_s": f"{lacking_s:.3f}"} if lacking_s else {}),
                },
                attachments=self._attachments,
            ) as log:
                log.write(rows, times)
            self._prune(path)
        except Exception as error:  # noqa: BLE001 - told; a full disk must not end the recorder
            self._told(fault, "", str(error))
        else:
            self._told(fault, str(path), self._lacks(lacking_s) if lacking_s else "")

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

    def _prune(self, written: Path) -> None:
        # The time of day stands first in the names: their order is that of the faults, but where
        # the clock is behind. What this process wrote is newer than all else, whatever it says.
        self._written.append(written)
        found = set(self._folder.glob("fault-*.mcap"))
        self._written = [path for path in self._written if path in found]
        before = sorted(found - set(self._written))
        for path in [*before, *self._written][: max(len(found) - self._keep, 0)]:
            path.unlink(missing_ok=True)


def fault_folder(rig: RigConfig, folder: Path) -> Path:
    """Return where flight recordings go: as the rig says, else among this user's or service's."""
    if rig.recording.faults is not None:
        return folder / rig.recording.faults
    return state_folder() / "faults"
