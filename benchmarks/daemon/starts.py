"""Starts of the daemon on a machine with too much to do: does any flight leave no log?

Four processes compute all the time. A daemon is started, and the first moment that it answers it is
asked to fly a session of two seconds; then it is ended. A flight that the recorder is not there for
must not lift off; one that lifts off must have every row in its logs. --quick: 6 starts; else 200,
two daemons at a time, in some 30 minutes.
"""

from __future__ import annotations

import contextlib
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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
_AT_A_TIME = 2
_ANSWERS_S = 300.0
_FAULT = "fault "
"""How the answer begins to a flight that ended in one."""


@dataclass
class Starts:
    """What came of all starts.

    without_log: flights that left the ground and of which rows are in no log.
    """

    asked: int = 0
    flown: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    without_log: int = 0
    lost: int = 0
    restarts: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    took_s: list[float] = field(default_factory=list)
    guard: threading.Lock = field(default_factory=threading.Lock)


def measure(quick: bool) -> Iterator[Figure]:
    found = Starts()
    try:
        with (
            tempfile.TemporaryDirectory() as name,
            busy(BUSY),
            ThreadPoolExecutor(_AT_A_TIME) as pool,
        ):
            folders = [Path(name) / str(number) for number in range(6 if quick else 200)]
            for _ in pool.map(lambda folder: start(folder, found), folders):
                print(f"{found.asked} starts, {found.flown} flown", end="\r", file=sys.stderr)
    finally:
        yield from _figures(found)


def start(folder: Path, found: Starts) -> None:
    """Start a daemon, ask it to fly at once, and look at what it left."""
    folder.mkdir()
    file, path = loopback_rig(folder), folder / "levid.sock"
    begun_s = time.monotonic()
    command = [sys.executable, "-m", "levid.cli.main", "run", str(file)]
    flew, refused, failed = False, "", ""
    with _running(command) as process:
        status: dict[str, Any] = {}
        try:
            _wait_for(process, path)
            with Client(path) as client:
                client.excite(SESSION, folder / "out", lambda *_: None)
            flew = True
        except DaemonError as error:
            refused = str(error)
            flew = refused.startswith(_FAULT)
        except Exception as error:  # noqa: BLE001 - the next start goes on
            failed = f"{type(error).__name__}: {error}"
        with contextlib.suppress(DaemonError), Client(path) as client:
            status = client.request("status")
    missing = _missing(folder / "out", steps=0 if refused else 3) if flew else ""
    with found.guard:
        found.asked += 1
        found.took_s.append(time.monotonic() - begun_s)
        found.lost += status.get("lost", 0)
        found.restarts += status.get("recorder_restarts", 0)
        found.flown += flew
        found.without_log += bool(missing)
        found.refused.update([refused[:100]] if refused else [])
        found.failed.update(filter(None, (failed, missing)))


@contextlib.contextmanager
def _running(command: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command; not tied to this thread, which is one of several."""
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        end(process)


def _wait_for(process: subprocess.Popen[bytes], path: Path) -> None:
    """Wait until the daemon answers anything at all."""
    give_up_s = time.monotonic() + _ANSWERS_S
    while process.poll() is None and time.monotonic() < give_up_s:
        with contextlib.suppress(DaemonError), Client(path) as client:
            client.request("status")
            return
        time.sleep(0.05)
    raise RuntimeError(f"no answer within {_ANSWERS_S:g} s")


def _missing(out: Path, steps: int) -> str:
    """Return what is missing of a flight's logs, empty for nothing.

    Its cycles follow one another without a gap, over all logs; of a whole flight each of so many
    steps has one.
    """
    logs = sorted(out.glob("*.mcap"))
    if not logs or (steps and len(logs) != steps):
        return f"expected {steps or 'some'} logs, found {len(logs)}"
    try:
        rows = [read_log(path).rows for path in logs]
    except LogError as error:
        return str(error)
    cycles = np.concatenate([part["cycle"].astype(np.int64) for part in rows])
    skipped = np.concatenate([part["skipped"].astype(np.int64) for part in rows])
    lost = int((np.diff(cycles) - 1 - skipped[1:]).sum())
    return f"{lost} rows are missing" if lost else ""


def _figures(found: Starts) -> Iterator[Figure]:
    for what, count in (found.refused + found.failed).most_common():
        print(f"{count} x {what}", file=sys.stderr)
    none = Target(most=0)
    refused, failed = sum(found.refused.values()), sum(found.failed.values())
    yield Figure("busy", BUSY, "", "busy processes beside")
    yield Figure("starts", found.asked, "", "starts of the daemon")
    yield Figure("flown", found.flown, "", "flights that left the ground")
    yield Figure("refused", refused, "", "starts refused, or flights that ended in a fault")
    yield Figure("without_log", found.without_log, "", "flights without a whole log", target=none)
    yield Figure("lost", found.lost, "", "rows lost", target=none)
    yield Figure("restarts", found.restarts, "", "recorders started anew", target=none)
    yield Figure("failed", failed, "", "starts that did not end", target=none)
    if found.took_s:
        yield Figure("took", statistics.median(found.took_s), "s", "start to end, median")


def main() -> None:
    arguments = table.parser(__doc__ or "").parse_args()
    table.show("Starts", arguments, lambda: measure(arguments.quick))


if __name__ == "__main__":
    main()
