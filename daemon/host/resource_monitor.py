"""Detect resource pressure: socket floods, low memory or CPU, a slow recorder.

These do not disturb the loop directly. The journal lists them as possible causes of late cycles and
missing rows.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

from .rate_limited_log import RateLimitedLog

_POLL_S = 2.0
"""Polling interval: the kernel updates its figures that often."""
_FLOOD_HZ = 500.0
"""Requests and connections per second: many times the rate of watching clients, and a tenth of the
rate that the socket can answer."""
_LOW_MEMORY = 0.1
"""Fraction of the time in which some process waited for memory."""
_STOLEN = 0.01
"""Fraction of the processor time that the host of a virtual machine took, on average: at 1 kHz it
may by itself make one cycle in a hundred late."""
_STAT, _STEAL = Path("/proc/stat"), 8


class ResourceMonitor:
    """Check resources every two seconds, log and sum what exceeds its limit; never waits."""

    def __init__(
        self, log: Callable[[str], None], pressure: Path | None = None, stat: Path = _STAT
    ) -> None:
        self._log, self._stat = log, stat
        self._given, self._pressure = pressure, pressure or _pressure_file()
        self._polled_s: float | None = None
        self._requests, self._waited_s, self._lost = 0, 0.0, 0
        self._steal_s: float | None = None
        self._rarely = RateLimitedLog(log)
        self.flooded_s = 0.0
        """Time with too many requests, since the start."""
        self.memory_stalled_s = 0.0
        """Time that processes waited for memory while it was low, since the start."""
        self.stolen_s = 0.0
        """Processor time withheld by the host, mean of all processors, while above the limit."""

    def poll(self, now_s: float, requests: int, lost: int) -> None:
        """Check all resources if the polling interval has passed.

        requests: requests and connections; lost: rows missing in the logs; both since the start.
        """
        if self._polled_s is None:
            self._polled_s, self._requests, self._waited_s = now_s, requests, self._waited()
            self._stolen()
            return
        passed_s = now_s - self._polled_s
        if passed_s < _POLL_S:
            return
        self._update_pressure_file()
        rate, waited_s = (requests - self._requests) / passed_s, self._waited()
        stalled_s = waited_s - self._waited_s
        self._polled_s, self._requests, self._waited_s = now_s, requests, waited_s
        if rate > _FLOOD_HZ:
            self.flooded_s += passed_s
            self._rarely.line(
                "flood", now_s, f"the control socket is flooded: {rate:.0f} requests/s"
            )
        if stalled_s > _LOW_MEMORY * passed_s:
            self.memory_stalled_s += stalled_s
            self._rarely.line(
                "memory",
                now_s,
                f"memory is low: processes waited for it for {stalled_s:.1f} of {passed_s:.1f} s",
            )
        stolen_s = self._stolen()
        if stolen_s > _STOLEN * passed_s:
            self.stolen_s += stolen_s
            self._rarely.line(
                "stolen",
                now_s,
                "the host of this virtual machine withheld its processors for "
                f"{stolen_s:.2f} of {passed_s:.1f} s: cycles in that time are late",
            )
        # Rows lost while logging is suppressed count in the next line.
        if lost > self._lost and self._rarely.due("lost", now_s):
            self._log(self._lost_rows(lost))
            self._lost = lost
        self._rarely.flush(now_s)

    def end(self, lost: int) -> None:
        """Log lost rows that are not in the journal yet, at the end of the daemon."""
        if lost > self._lost:
            self._log(self._lost_rows(lost))
            self._lost = lost

    def _lost_rows(self, lost: int) -> str:
        return (
            f"lost {lost - self._lost} rows that the recorder did not read in time or could not "
            f"write, {lost} since the start"
        )

    def _update_pressure_file(self) -> None:
        """Follow the process to another control group; waiting time there counts from now."""
        pressure = self._given or _pressure_file()
        if pressure != self._pressure:
            self._pressure = pressure
            self._waited_s = self._waited()

    def _waited(self) -> float:
        waited_s = None if self._pressure is None else _memory_wait_s(self._pressure)
        return self._waited_s if waited_s is None else waited_s

    def _stolen(self) -> float:
        """Return the processor time that the host took since the last successful call, in s."""
        before_s, now_s = self._steal_s, _steal_s(self._stat)
        if now_s is None:
            return 0.0
        if before_s is None:
            self._steal_s = now_s
            return 0.0
        self._steal_s = max(before_s, now_s)  # the kernel's sum may step back
        return self._steal_s - before_s


def _pressure_file(process: Path = Path("/proc/self"), root: Path = Path("/")) -> Path | None:
    """Return the kernel's memory pressure file of this service, otherwise of the machine.

    None on an old kernel, or if the service has no access to it.
    """
    files = [root / "proc/pressure/memory"]
    try:
        own = re.search(r"^0::/(.+)$", (process / "cgroup").read_text(), re.M)
    except OSError:
        own = None
    if own is not None:
        files.insert(0, root / "sys/fs/cgroup" / own[1] / "memory.pressure")
    return next((path for path in files if _memory_wait_s(path) is not None), None)


def _memory_wait_s(path: Path) -> float | None:
    """Return how long some process waited for memory since boot, in s; None if unknown."""
    try:
        total = _TOTAL.search(path.read_text())
    except OSError:
        return None
    return 1e-6 * int(total[1]) if total else None


def _steal_s(path: Path) -> float | None:
    """Return the processor time taken by the host since boot, in s, as the mean of all processors.

    None if unknown. The first line of the file is the sum; one line per processor follows.
    """
    try:
        total, *lines = path.read_text().splitlines()
        cpus = sum(line.startswith("cpu") for line in lines)
        return float(total.split()[_STEAL]) / os.sysconf("SC_CLK_TCK") / max(cpus, 1)
    except (OSError, IndexError, ValueError):
        return None


_TOTAL = re.compile(r"^some .*\btotal=(\d+)", re.M)
