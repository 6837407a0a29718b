"""Start the daemon on a busy machine: check that every flight has a complete log.

Four processes compute continuously. A session of two seconds is requested as soon as a new daemon
answers. Without a recorder the daemon must refuse to lift off; after lift-off every row must be in
the logs. --quick: 6 starts, otherwise 200, two at a time, in some 30 minutes.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from levid.benchmarks.harness import table
from levid.benchmarks.harness.child_processes import busy, end
from levid.benchmarks.harness.running_daemon import loopback_rig
from levid.benchmarks.harness.table import Figure, Target
from levid.daemon.client import Client, DaemonError
from levid.log.errors import LogError
from levid.log.reader import read_log

SESSION = """
levid: session
name: start
excitations: {z: {input: z, rms_n: 0.3}}
steps:
  - levitate: {unload_s: 0.2, ramp_s: 0.4, settle_s: 0.1, check_coils: false}
  - record: {name: z, duration_s: 0.5, fade_s: 0.1, settle_s: 0.1, excite: [z]}
  - land: {ramp_s: 0.4, release_s: 0.2}
"""
_STEPS, _AT_A_TIME, _ANSWERS_S = 3, 2, 300.0


def measure(quick: bool) -> Iterator[Figure]:
    """Run all starts; yield the figures."""
    count = 6 if quick else 200
    with tempfile.TemporaryDirectory() as name, busy(4), ThreadPoolExecutor(_AT_A_TIME) as pool:
        found = list(pool.map(start, [Path(name) / str(number) for number in range(count)]))
    refused = [answer for answer, _ in found if answer]
    problems = [problem for _, problem in found if problem]
    print(*refused, *problems, sep="\n", file=sys.stderr)
    yield Figure("starts", count, "", "starts beside 4 busy processes")
    yield Figure("refused", len(refused), "", "requests refused, or flights that ended in a fault")
    label = "flights without a complete log"
    yield Figure("without_log", len(problems), "", label, target=Target(most=0))


def start(folder: Path) -> tuple[str, str]:
    """Start a daemon and request a flight at once; return its refusal, and what its logs lack."""
    folder.mkdir()
    file, path, refusal = loopback_rig(folder), folder / "levid.sock", ""
    command = [sys.executable, "-m", "levid.cli.main", "run", str(file)]
    # Not `started`: that ties a process to its thread, and there are several threads here.
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        _wait_for(path)
        with Client(path) as client:
            client.excite(SESSION, folder / "out", lambda *_: None)
    except DaemonError as error:
        refusal = str(error)
    finally:
        end(process)
    if refusal and not refusal.startswith("fault "):
        return refusal, ""  # it has not lifted off
    return refusal, _missing(folder / "out", 1 if refusal else _STEPS)


def _wait_for(path: Path) -> None:
    """Wait until the daemon answers; raises DaemonError on a timeout."""
    give_up_s = time.monotonic() + _ANSWERS_S
    while time.monotonic() < give_up_s:
        with contextlib.suppress(DaemonError), Client(path) as client:
            client.request("status")
            return
        time.sleep(0.05)
    raise DaemonError(f"no answer within {_ANSWERS_S:g} s")


def _missing(out: Path, least: int) -> str:
    """Return what the logs of a flight lack: a log of each step, cycles without a gap."""
    logs = sorted(out.glob("*.mcap"))
    if len(logs) < least:
        return f"expected {least} logs, found {len(logs)}"
    try:
        rows = [read_log(path).rows for path in logs]
    except LogError as error:
        return str(error)
    cycles, skipped = (
        np.concatenate([part[name].astype(np.int64) for part in rows])
        for name in ("cycle", "skipped")
    )
    lost = int((np.diff(cycles) - 1 - skipped[1:]).sum())
    return f"{lost} rows are missing" if lost else ""


if __name__ == "__main__":
    table.run("Starts", measure)
