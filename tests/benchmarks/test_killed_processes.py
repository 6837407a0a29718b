"""Kills and stops of processes in flight; force is counted at the electronics."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from levid.benchmarks.daemon import killed_processes
from levid.benchmarks.daemon.fault_injection_rig import BUSES, Rig, rig_of
from levid.config.base import parse
from levid.config.rig import RigConfig
from levid.daemon.control.watchdog_times import longest_stall, zero_after_s


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("killed_processes")
    with contextlib.closing(Rig("serial", folder, **killed_processes.rig_keys("land"))) as made:
        yield made


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("deed", "state"),
    [
        ("loop killed", "LEVITATING"),
        ("loop held up", "EXCITING"),
        ("planner killed", "LEVITATING"),
        ("recorder stopped", "LEVITATING"),
        ("supervisor stopped", "LEVITATING"),
        ("supervisor killed", "EXCITING"),
    ],
)
def test_a_lost_process_meets_the_deadline_of_the_documentation(
    rig: Rig, deed: str, state: str
) -> None:
    rig.lift_off(state, 0.2)
    try:
        assert killed_processes.attempt(rig, deed, "land", state, []) == ""
    finally:
        rig.come_to_rest()


@pytest.mark.parametrize("bus", BUSES)
def test_the_rig_has_the_deadlines_of_the_documentation(tmp_path: Path, bus: str) -> None:
    config = parse(rig_of(bus, tmp_path, **killed_processes.rig_keys("land")), RigConfig, bus)
    assert zero_after_s(config) == killed_processes.LOST_CYCLES / config.rate_hz
    assert longest_stall(config) == 1
    assert longest_stall(config) / config.rate_hz < killed_processes.HELD_S
