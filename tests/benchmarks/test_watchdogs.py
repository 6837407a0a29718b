"""Kills and stops in flight, force counted at the electronics."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from levid.benchmarks.daemon import fault_list, fault_rig, watchdogs

pytestmark = pytest.mark.real_time


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("watchdogs")
    with contextlib.closing(watchdogs.Rig("serial", folder, **watchdogs.rig_keys("land"))) as made:
        yield made


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
def test_a_lost_process_is_zero_force_a_landing_or_nothing_as_the_table_says(
    rig: Any, deed: str, state: str
) -> None:
    lists = fault_list
    flight = watchdogs.lift_off(rig, lists.Case("serial", 0, deed, "", state, 0.2), rig.folder)
    try:
        assert watchdogs.attempt(rig, flight, deed, "land", state, watchdogs.Outcomes()) == ""
    finally:
        flight.hang_up()
        watchdogs.come_to_rest(rig)


def test_the_rig_is_one_that_the_table_speaks_of(tmp_path: Path) -> None:
    from levid.config.base import parse
    from levid.config.rig import RigConfig
    from levid.daemon.control.detection_times import longest_stall, zero_after_s

    for bus in watchdogs.BUSES:
        plain = fault_rig.rig_of(bus, tmp_path, **watchdogs.rig_keys("land"))
        config = parse(plain, RigConfig, bus)
        assert zero_after_s(config) == watchdogs.LOST_CYCLES / config.rate_hz
        assert longest_stall(config) == 1
        assert longest_stall(config) / config.rate_hz < watchdogs._HELD_S
