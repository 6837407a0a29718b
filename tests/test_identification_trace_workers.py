"""Workers of a trace end with whoever has them, however that ends."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

GIVE_UP_S = 60.0
SCRIPT = """
import multiprocessing, os, signal, sys, time
from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.trace.workers import local_workers

if __name__ == "__main__":
    # A shell has its background jobs ignore it, and their children too.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with local_workers(load_model(shipped("models/rig.yaml")), 2) as workers:
        futures = [workers.executor.submit(time.sleep, 600.0) for _ in range(6)]
        print(*[child.pid for child in multiprocessing.active_children()], flush=True)
        futures[0].result()
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_no_worker_is_left_behind(tmp_path: Path, number: int) -> None:
    script = tmp_path / "tracing.py"
    script.write_text(SCRIPT)
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    pids = [int(word) for word in process.stdout.readline().split()]
    assert len(pids) == 2
    time.sleep(1.0)  # they begin, and wait for what they are to do
    process.send_signal(number)
    _, said = process.communicate(timeout=GIVE_UP_S)  # its pipes are theirs as well
    give_up_s = time.monotonic() + GIVE_UP_S
    while any(_there(pid) for pid in pids):
        assert time.monotonic() < give_up_s
        time.sleep(0.05)
    if number == signal.SIGINT:
        assert said.count("Traceback") == 1  # that of the script itself
    else:
        assert "Traceback" not in said


def _there(pid: int) -> bool:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, 0)
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        return state != "Z"
    return False
