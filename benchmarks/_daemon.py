"""A daemon in real time, `levid run` in processes of its own, for benchmarks that fly with it."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from levid.daemon.client import Client, DaemonError
from levid.log.reader import read_log

_READY_S = 60.0
_AGAIN_S = 0.2
_SKIPPED_MORE = 255
"""What a row says of so many skipped periods or more: how many, it does not know."""


@contextmanager
def running(rig_file: Path, socket: Path) -> Iterator[dict[str, int]]:
    """Run a daemon on this rig, whose `socket` is given; give its processes once it is idle.

    Devices that are just being started may take their time to answer.
    """
    daemon = subprocess.Popen(
        [sys.executable, "-m", "levid.cli.main", "run", str(rig_file)], stderr=subprocess.DEVNULL
    )
    try:
        yield _idle(daemon, socket)
    finally:
        daemon.terminate()
        daemon.wait()


def missing_rows(logs: Iterable[Path]) -> int:
    """Return how many cycles that were flown stand in none of the logs of a flight, any order."""
    rows = np.concatenate([read_log(path).rows for path in logs])
    rows = rows[np.argsort(rows["cycle"], kind="stable")]
    periods = np.diff(rows["cycle"].astype(np.int64)) - 1
    skipped = rows["skipped"][1:]
    return int(np.maximum(periods - skipped, 0)[skipped < _SKIPPED_MORE].sum())


def _idle(daemon: subprocess.Popen[bytes], socket: Path) -> dict[str, int]:
    give_up_s = time.monotonic() + _READY_S
    said = "nothing"
    while time.monotonic() < give_up_s and daemon.poll() is None:
        try:
            with Client(socket) as client:
                status = client.request("status")
                if status["state"] == "IDLE":
                    pids: dict[str, int] = status["pids"]
                    return pids
                said = f"{status['state']}, {status['fault']}: {status['detail']}"
                if status["fault"] != "NONE":
                    client.request("clear")
        except DaemonError as error:
            said = str(error)
        time.sleep(_AGAIN_S)
    sys.exit(f"the daemon did not become idle, the last was: {said}")
