"""Test the monitor of the loop process: a stop while devices are opened, a hang, the end."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.control.faults import Fault
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.ipc.shared_status_words import ControlWords, Word
from levid.daemon.supervision.loop_monitor import LoopMonitor

HUNG_S = 30.0


@pytest.fixture
def control_words() -> Iterator[ControlWords]:
    shared = SharedMemory(load_rig(shipped("rigs/loopback.yaml")))
    yield shared.control_words
    shared.close()


@pytest.fixture
def lost() -> list[str]:
    """The reasons for which the loop was lost."""
    return []


@pytest.fixture
def monitor(loop, control_words: ControlWords, lost: list[str], time) -> LoopMonitor:
    monitor = LoopMonitor(loop, control_words, HUNG_S, lambda: None, lost.append)
    monitor.start((), ())
    return monitor


def test_stop_while_devices_are_being_opened_ends_the_loop(
    monitor: LoopMonitor, loop, control_words: ControlWords, lost: list[str]
) -> None:
    """It may be homing drives: a stop must not wait for the end of that."""
    monitor.watch(False)
    assert loop.done == ["started"]
    control_words.stop()
    monitor.watch(False)
    assert loop.done == ["started", "terminated"]
    monitor.watch(False)
    assert control_words.fault is Fault.LOOP
    assert lost == ["stopped while its devices were being opened; exit code 143"]
    assert control_words.detail == lost[0]


def test_suspended_machine_has_not_lost_its_loop(
    monitor: LoopMonitor, control_words: ControlWords, lost: list[str], time
) -> None:
    control_words[Word.BUSY] = 0
    monitor.watch(False)
    for _ in range(100):  # suspended for a minute each time
        time.now_s += 60.0
        monitor.watch(False)
    assert not lost
    for _ in range(4000):
        time.now_s += 0.01
        monitor.watch(False)
    assert f"it did not advance for {HUNG_S:.1f} s" in lost[0]


def test_loop_that_ignores_a_stop_is_killed(
    monitor: LoopMonitor, loop, control_words: ControlWords, lost: list[str], time
) -> None:
    control_words[Word.BUSY] = 0
    control_words.stop()
    for _ in range(40):
        time.now_s += 0.01
        control_words[Word.CYCLE] += 10
        monitor.watch(False)
    assert loop.done[-1] == "killed"
    assert "it did not react to a stop" in lost[0]


def test_loop_that_opens_devices_is_ended_at_once(
    monitor: LoopMonitor, loop, control_words: ControlWords
) -> None:
    monitor.end_at_once()
    assert loop.done == ["started", "terminated", "waited"]
    assert control_words[Word.ZERO] == Fault.SUPERVISOR
