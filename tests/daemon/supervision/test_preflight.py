"""Test the checks before lift-off that need no session."""

from __future__ import annotations

import os
from typing import Any

import pytest

from levid.config.daemon_settings import Realtime
from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.daemon.host.real_time_rights import real_time_rights
from levid.daemon.supervision.preflight import (
    cpu_finding,
    devices_finding,
    real_time_finding,
    recorder_finding,
)


@pytest.mark.parametrize(
    ("state", "fault", "passed"),
    [
        (State.IDLE, Fault.NONE, True),
        (State.LEVITATING, Fault.NONE, True),
        (State.SELF_TEST, Fault.NONE, True),  # nothing is known yet; a lift-off waits for its end
        (State.FAULT, Fault.SENSOR, False),
    ],
)
def test_devices_are_ready_after_the_self_test(state: State, fault: Fault, passed: bool) -> None:
    found = devices_finding(state, fault, "gap 3 stuck")
    assert found.failed != passed
    assert fault is Fault.NONE or "gap 3 stuck" in found.found


def test_recorder_has_to_run() -> None:
    assert not recorder_finding("", "").failed
    assert recorder_finding("the recorder ended", "the recorder ended").failed
    # A flight shows whether the disk has room again: its own check says whether a log fits.
    found = recorder_finding("", "disk full")
    assert not found.failed
    assert "disk full" in found.found


def timing(late_us: float, took_us: float) -> dict[str, Any]:
    return {"lateness_us": {"p99.9": late_us}, "execution_us": {"p99.9": took_us}}


def test_cycles_have_to_end_within_their_period() -> None:
    assert not cpu_finding(timing(200, 700), 10_000, 1000.0).failed
    assert cpu_finding(timing(400, 700), 10_000, 1000.0).failed
    assert cpu_finding(timing(400, 700), 100, 1000.0).outcome == "unknown"


def test_this_process_has_no_real_time_priority() -> None:
    wanted = Realtime(priority=10, lock_memory=False)
    found = real_time_finding(wanted, os.getpid())
    assert found.failed
    assert "no real-time priority" in found.found
    assert not real_time_finding(Realtime(priority=0, lock_memory=False), os.getpid()).failed
    assert real_time_finding(wanted, None).outcome == "unknown"


def test_the_rights_are_tried_in_a_child_only() -> None:
    before = os.sched_getscheduler(0)
    refused = real_time_rights(Realtime(priority=5))
    assert os.sched_getscheduler(0) == before
    assert all(line.startswith("realtime.") for line in refused)
    # A processor that does not exist is refused to anybody.
    assert any("realtime.cpus" in line for line in real_time_rights(Realtime(cpus=(4000,))))
