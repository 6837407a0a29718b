"""Fly sessions for half an hour: check memory, open files, rows and restarts.

Memory and open files of each process are read after every session. Rows that the loop wrote are
compared with the logs. --quick takes a minute, which shows a jump in memory but no slow growth.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.stats import linregress, t

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.benchmarks.harness.logged_vs_flown_rows import Flown, Found, compare
from levid.benchmarks.harness.running_daemon import Daemon, loopback_rig, running
from levid.daemon.client import Client

SESSION = """
levid: session
name: soak
excitations: {{psi: {{input: psi, rms_n_m: 0.05}}}}
steps:
  - levitate: {{unload_s: 0.3, ramp_s: 1.0, settle_s: 0.5, check_coils: {{}}}}
  - move: {{beam_m: 0.02, settle_s: 0.2}}
  - record: {{name: tilt, duration_s: {record_s}, settle_s: 0.2, excite: [psi]}}
  - move: {{beam_m: 0.0, settle_s: 0.2}}
  - land: {{ramp_s: 0.5, release_s: 0.3}}
"""
PROCESSES = ("supervisor", "loop", "recorder")
MOST_MB_H = 1.0
"""Limit of slow growth: a month takes 0.7 GB, which a rig's small computer may still have."""
MOST_GROWN_MB = 1.0
"""Limit of growth in a minute: less than the rows of one session (5 s at 1 kHz, 273 bytes each)."""
_SETTLED = 2
"""The first sessions fill caches and are not counted."""
_LIMITS = {"late_cycles": 1000, "late_in_window": 100_000, "stall_s": 5}
"""Limits that tolerate the stalls of a desktop machine."""


def measure(quick: bool) -> Iterator[Figure]:
    """Fly sessions and yield the figures."""
    whole_s, record_s = (60.0, 1.5) if quick else (1800.0, 50.0)
    found, at_h = Found(), []
    sizes: dict[str, list[tuple[float, int]]] = {name: [] for name in PROCESSES}
    with tempfile.TemporaryDirectory() as name:
        file = loopback_rig(Path(name), **_LIMITS)
        with running(file, Path(name) / "levid.sock") as daemon:
            begun_s = time.monotonic()
            while time.monotonic() < begun_s + whole_s:
                found += _fly(daemon, Path(name) / f"session-{len(at_h)}", record_s)
                at_h.append((time.monotonic() - begun_s) / 3600)
                status = daemon.ask("status")
                for process in PROCESSES:
                    sizes[process].append(size(status["pids"][process]))
    none, restarts = Target(most=0), status["recorder_restarts"]
    yield Figure("sessions", len(at_h), "", "sessions flown")
    label = "rows missing, duplicate or foreign; cut logs"
    yield Figure("wrong_rows", found.wrong, "", label, target=none)
    yield Figure("restarted", restarts, "", "restarts of the recorder", target=none)
    for process in PROCESSES:
        mb, files = np.array(sizes[process][_SETTLED:]).T
        line = linregress(at_h[_SETTLED:], mb)
        # The upper 95 % bound of a line's slope, 0 of a constant; in a minute it says nothing.
        slope = np.nan_to_num(line.slope + t.ppf(0.95, len(mb) - 2) * line.stderr)
        yield Figure(f"{process}_mb", mb[-1], "MB", f"{process}: private memory at the end")
        target = Target(most=MOST_GROWN_MB) if quick else None
        label = "largest growth after two sessions"
        yield Figure(f"{process}_grown_mb", max(mb) - mb[0], "MB", label, target=target)
        target = None if quick else Target(most=MOST_MB_H)
        yield Figure(f"{process}_mb_h_95", slope, "MB/h", "slope, upper 95 % bound", target=target)
        more = max(files) - files[0]
        yield Figure(f"{process}_files", more, "", "more open files", target=none)


def size(pid: int) -> tuple[float, int]:
    """Return the private memory of a process in MB and the number of its open files."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    kib = sum(int(line.split()[1]) for line in lines if line.startswith(("Anonymous:", "Swap:")))
    return kib / 1024, len(list(Path(f"/proc/{pid}/fd").iterdir()))


def _fly(daemon: Daemon, out: Path, record_s: float) -> Found:
    """Fly a session, compare its logs with the rows of the loop, and delete them."""
    flown = Flown(daemon.pids["supervisor"], daemon.rig_file)
    with Client(daemon.socket) as client:
        text = SESSION.format(record_s=record_s)
        result = client.excite(text, out, lambda *_: flown.look())
        flown.wait_until_written()
    found = compare(flown.cycles, result.logs)
    for log in result.logs:
        log.unlink()
    return found


if __name__ == "__main__":
    benchmark_runner.run("Soak", measure)
