"""Start the daemon on a busy machine: check that every flight has a complete log.

Four processes compute continuously. A session of two seconds is requested as soon as a new daemon
answers. Without a recorder the daemon must refuse to lift off; after lift-off every row must be in
the logs. --quick: 6 starts, otherwise 200, two at a time, in some 30 minutes.
"""

from __future__ import annotations

import contextlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from levid.benchmarks.harness import table
from levid.benchmarks.harness.child_processes import busy, end
from levid.benchmarks.harness.running_daemon import loopback_rig
from levid.benchmarks.harness.table import Figure, Target
from levid.daemon.client import Client, DaemonError
from levid.log.errors import LogError
from levid.log.reader import read_log

BUSY = 4
SESSION = """
levid: session
name: start
excitations: {z: {input: z, rms_n: 0.3}}
steps:
  - levitate: {unload_s: 0.2, ramp_s: 0.4, settle_s: 0.1, check_coils: false}
  - record: {name: z, duration_s: 0.5, fade_s: 0.1, settle_s: 0.1, excite: [z]}
  - land: {ramp_s: 0.4, release_s: 0.2}
"""
_STEPS = 3
_AT_A_TIME = 2
_ANSWERS_S = 300.0
_FAULT = "fault "
"""Start of the daemon's answer if a flight ended in a fault."""


@dataclass
class Start:
    """Result of one start: refused and failed are messages, missing says what the logs lack."""

    flew: bool = False
    refused: str = ""
    failed: str = ""
    missing: str = ""
    lost: int = 0
    restarts: int = 0
    took_s: float = 0.0


def measure(quick: bool) -> Iterator[Figure]:
    """Run all starts; yield their figures, also if they are interrupted."""
    found: list[Start] = []
    try:
        with (
            tempfile.TemporaryDirectory() as name,
            busy(BUSY),
            ThreadPoolExecutor(_AT_A_TIME) as pool,
        ):
            folders = [Path(name) / str(number) for number in range(6 if quick else 200)]
            for one in pool.map(start, folders):
                found.append(one)
                print(f"{len(found)} starts", end="\r", file=sys.stderr)
                for problem in filter(None, (one.refused, one.failed, one.missing)):
                    print(problem, file=sys.stderr)
    finally:
        none, refused = Target(most=0), sum(bool(one.refused) for one in found)
        missing = sum(bool(one.missing) for one in found)
        failed = sum(bool(one.failed) for one in found)
        yield Figure("starts", len(found), "", f"starts beside {BUSY} busy processes")
        yield Figure("flown", sum(one.flew for one in found), "", "flights with lift-off")
        yield Figure("refused", refused, "", "requests refused, or flights that ended in a fault")
        yield Figure("without_log", missing, "", "flights without a complete log", target=none)
        yield Figure("lost", sum(one.lost for one in found), "", "rows lost", target=none)
        restarts = sum(one.restarts for one in found)
        yield Figure("restarts", restarts, "", "restarts of the recorder", target=none)
        yield Figure("failed", failed, "", "starts that did not end", target=none)
        took_s = statistics.median([one.took_s for one in found] or [0.0])
        yield Figure("took", took_s, "s", "start to end, median")


def start(folder: Path) -> Start:
    """Start a daemon, request a flight at once, and check its logs."""
    folder.mkdir()
    file, path = loopback_rig(folder), folder / "levid.sock"
    found, begun_s = Start(), time.monotonic()
    command = [sys.executable, "-m", "levid.cli.main", "run", str(file)]
    # Not `started`: that ties a process to its thread, and there are several threads here.
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        _wait_for(process, path)
        with Client(path) as client:
            client.excite(SESSION, folder / "out", lambda *_: None)
        found.flew = True
    except DaemonError as error:
        found.refused = str(error)
        found.flew = found.refused.startswith(_FAULT)
    except (OSError, RuntimeError, ValueError) as error:
        found.failed = f"{type(error).__name__}: {error}"
    finally:
        with contextlib.suppress(DaemonError), Client(path) as client:
            status = client.request("status")
            found.lost, found.restarts = status["lost"], status["recorder_restarts"]
        end(process)
    if found.flew:
        found.missing = _missing(folder / "out", whole=not found.refused)
    found.took_s = time.monotonic() - begun_s
    return found


def _wait_for(process: subprocess.Popen[bytes], path: Path) -> None:
    """Wait until the daemon answers; raises RuntimeError on a timeout."""
    give_up_s = time.monotonic() + _ANSWERS_S
    while process.poll() is None and time.monotonic() < give_up_s:
        with contextlib.suppress(DaemonError), Client(path) as client:
            client.request("status")
            return
        time.sleep(0.05)
    raise RuntimeError(f"no answer within {_ANSWERS_S:g} s")


def _missing(out: Path, whole: bool) -> str:
    """Return what the logs of a flight lack, empty if they are complete.

    Cycles must continue without a gap over all logs; each step of a whole flight has a log.
    """
    logs = sorted(out.glob("*.mcap"))
    if not logs or (whole and len(logs) != _STEPS):
        return f"expected {_STEPS if whole else 'some'} logs, found {len(logs)}"
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
