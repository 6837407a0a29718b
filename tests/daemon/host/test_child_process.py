"""Test the silence of a child: time without a processor does not count."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.host.child_process import Child, ChildSilence
from levid.daemon.ipc.control_words import Word
from levid.daemon.ipc.row_ring import HUNG_S
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.recording import recorder_link as link_module
from levid.daemon.recording.recorder_link import RecorderLink


class Starved:
    """A child that waits for a processor for a share of all time, from `since_s` on."""

    def __init__(self, share: float, since_s: float = 0.0) -> None:
        self.now_s, self.share, self.since_s = 0.0, share, since_s

    @property
    def waited_s(self) -> float:
        return self.share * max(self.now_s - self.since_s, 0.0)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_silence_counts_the_time_that_a_child_had(share: float) -> None:
    child: Any = Starved(share)
    silence = ChildSilence(child)
    silence.begin(0.0)
    for n in range(1, 10_001):
        child.now_s = 0.01 * n
        passed_s = silence.passed_s(child.now_s)
    # The first half a second is not looked into.
    assert passed_s == pytest.approx(0.5 + (1.0 - share) * 99.5, abs=0.1)
    silence.begin(100.0)
    assert silence.passed_s(100.2) == pytest.approx(0.2)


def test_kernel_tells_how_long_a_process_waited_for_a_processor() -> None:
    """Beside others on its one processor it waits; one that is stopped does not."""
    cpu = min(os.sched_getaffinity(0))
    command = [sys.executable, "-c", f"import os; os.sched_setaffinity(0, [{cpu}])\nwhile 1: pass"]
    processes = [subprocess.Popen(command) for _ in range(3)]
    child = Child("busy", "", b"")
    child._process = processes[0]
    try:
        give_up_s = time.monotonic() + 60.0
        while child.waited_s < 0.2:
            assert time.monotonic() < give_up_s
            time.sleep(0.05)
        processes[0].send_signal(signal.SIGSTOP)
        time.sleep(0.3)
        before_s = child.waited_s
        time.sleep(0.5)
        assert child.waited_s == before_s
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert child.waited_s == 0.0


@pytest.mark.parametrize("begun", [False, True])
def test_recorder_on_a_starved_machine_is_not_killed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, begun: bool
) -> None:
    now_s, killed, said = 0.0, [], []
    shared = SharedMemory(load_rig(shipped("rigs/loopback.yaml")))
    monkeypatch.setattr(link_module.time, "monotonic", lambda: now_s)
    link = RecorderLink(b"", shared.fd, shared.board, tmp_path, said.append)
    child: Any = SimpleNamespace(
        running=True, waited_s=0.0, kill=killed.append, start=lambda *_: None, end=""
    )
    monkeypatch.setattr(link, "_child", child)
    link._silence = ChildSilence(child)
    link._start(0.0)
    if begun:
        shared.board[Word.RECORDER_BEAT] += 1
    for n in range(40_000):  # it gets a twentieth of a processor: 400 s make 20
        now_s = 0.01 * n
        child.waited_s = 0.95 * now_s
        link.watch()
    assert bool(killed) is begun  # 20 s are too many for one that has begun
    if begun:
        assert f"hung for {HUNG_S:g} s" in said[0]
    killed.clear()
    for n in range(40_000, 50_000):  # it is blocked, or in a loop of its own, for 100 s
        now_s = 0.01 * n
        link.watch()
    assert killed
    shared.close()
