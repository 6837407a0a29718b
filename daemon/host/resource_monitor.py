"""What weighs on the daemon: a flooded socket, memory or processors that lack, a slow recorder.

None of it disturbs the loop. Whoever looks for the cause of late cycles, or for rows that a log
does not have, is to find it in the journal.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

_LOOK_S = 2.0
"""The kernel brings its sums up to date that often."""
_QUIET_S = 60.0
"""Of each burden one line in that time, at most."""
_FLOOD_HZ = 500.0
"""Requests and connections a second: many times what clients that watch send, and a tenth of what
the socket answers."""
_SHORT = 0.1
"""Share of the time in which some process waited for memory."""
_TAKEN = 0.01
"""Share of the time for which a host kept a virtual machine's processors, on average, from running:
at 1 kHz as many cycles in a hundred may be late by that alone."""
_STAT, _STEAL = Path("/proc/stat"), 8


class Burdens:
    """Looks every two seconds, says what it finds, and adds it up; nothing in here waits."""

    def __init__(
        self, say: Callable[[str], None], pressure: Path | None = None, stat: Path = _STAT
    ) -> None:
        self._say, self._stat = say, stat
        self._given, self._pressure = pressure, pressure or _pressure_file()
        self._looked_s: float | None = None
        self._asked, self._waited_s, self._lost = 0, 0.0, 0
        self._gone_s: float | None = None
        self._said_s: dict[str, float] = {}
        self.flooded_s = 0.0
        """For how long there were too many requests, since the start."""
        self.memory_stalled_s = 0.0
        """For how long some process waited for memory, in looks that found the machine short."""
        self.stolen_s = 0.0
        """For how long a host kept each of this machine's processors, on average, in looks that
        found it too long."""

    def look(self, now_s: float, asked: int, lost: int) -> None:
        """Look, if it is time.

        asked: requests and connections, lost: rows that no log has, both since the start.
        """
        if self._looked_s is None:
            self._looked_s, self._asked, self._waited_s = now_s, asked, self._waited()
            self._stolen()
            return
        passed_s = now_s - self._looked_s
        if passed_s < _LOOK_S:
            return
        self._follow()
        rate, waited_s = (asked - self._asked) / passed_s, self._waited()
        stalled_s = waited_s - self._waited_s
        self._looked_s, self._asked, self._waited_s = now_s, asked, waited_s
        if rate > _FLOOD_HZ:
            self.flooded_s += passed_s
            self._tell("flood", now_s, f"the control socket is flooded: {rate:.0f} requests/s")
        if stalled_s > _SHORT * passed_s:
            self.memory_stalled_s += stalled_s
            self._tell(
                "memory",
                now_s,
                f"memory is short: processes waited for it for {stalled_s:.1f} of {passed_s:.1f} s",
            )
        gone_s = self._stolen()
        if gone_s > _TAKEN * passed_s:
            self.stolen_s += gone_s
            self._tell(
                "stolen",
                now_s,
                f"the host of this virtual machine kept each of its processors for {gone_s:.2f} of "
                f"{passed_s:.1f} s: no cycle is on time in that",
            )
        # What is lost in a quiet minute is told after it: no row is left out.
        if lost > self._lost and self._tell("lost", now_s, self._losses(lost)):
            self._lost = lost

    def end(self, lost: int) -> None:
        """Say what was not told yet of rows that are lost: nobody looks any more."""
        if lost > self._lost:
            self._say(self._losses(lost))
            self._lost = lost

    def _losses(self, lost: int) -> str:
        return (
            f"rows are lost: {lost - self._lost} that the recorder did not take in time or could "
            f"not write, {lost} since the start"
        )

    def _tell(self, what: str, now_s: float, words: str) -> bool:
        """Say it, unless that was said less than a minute ago; return whether it was."""
        if now_s - self._said_s.get(what, -_QUIET_S) < _QUIET_S:
            return False
        self._said_s[what] = now_s
        self._say(words)
        return True

    def _follow(self) -> None:
        """Look where the process is now: in another group than before, nothing has been waited."""
        pressure = self._given or _pressure_file()
        if pressure != self._pressure:
            self._pressure = pressure
            self._waited_s = self._waited()

    def _waited(self) -> float:
        waited_s = None if self._pressure is None else _some_s(self._pressure)
        return self._waited_s if waited_s is None else waited_s

    def _stolen(self) -> float:
        """Return what a host took since the last look that told."""
        before_s, now_s = self._gone_s, _steal_s(self._stat)
        if now_s is None:
            return 0.0
        if before_s is None:
            self._gone_s = now_s
            return 0.0
        self._gone_s = max(before_s, now_s)  # the kernel's sum may step back
        return self._gone_s - before_s


def _pressure_file(process: Path = Path("/proc/self"), root: Path = Path("/")) -> Path | None:
    """Return where the kernel says what waits for memory: of this service, else of the machine.

    None for an old kernel, and where a service does not see it.
    """
    found = [root / "proc/pressure/memory"]
    try:
        own = re.search(r"^0::/(.+)$", (process / "cgroup").read_text(), re.M)
    except OSError:
        own = None
    if own is not None:
        found.insert(0, root / "sys/fs/cgroup" / own[1] / "memory.pressure")
    return next((path for path in found if _some_s(path) is not None), None)


def _some_s(path: Path) -> float | None:
    """Return for how long some process has waited since the machine started, None if unknown."""
    try:
        found = _TOTAL.search(path.read_text())
    except OSError:
        return None
    return 1e-6 * int(found[1]) if found else None


def _steal_s(path: Path) -> float | None:
    """Return for how long a host kept a processor that had work, since the start; None if unknown.

    The first line sums all processors, of which each has one of those behind it.
    """
    try:
        of_all, *lines = path.read_text().splitlines()
        each = sum(line.startswith("cpu") for line in lines)
        return float(of_all.split()[_STEAL]) / os.sysconf("SC_CLK_TCK") / max(each, 1)
    except (OSError, IndexError, ValueError):
        return None


_TOTAL = re.compile(r"^some .*\btotal=(\d+)", re.M)
