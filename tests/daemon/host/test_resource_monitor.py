"""Test that socket floods, low memory, steal time and lost rows are logged and summed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from levid.config.daemon_settings import Service
from levid.daemon.api.control_server import Server
from levid.daemon.host import resource_monitor
from levid.daemon.host.peer_credentials import Access
from levid.daemon.host.resource_monitor import ResourceMonitor


class World:
    """Time goes on, requests come, processes wait for memory."""

    def __init__(self, folder: Path) -> None:
        self.file, self.stat, self.said = folder / "memory", folder / "stat", []
        self.now_s, self.asked, self.waited_s, self.lost = 100.0, 7, 3.0, 0
        self.stolen = 1234
        self.burdens = ResourceMonitor(self.said.append, self.file, self.stat)
        self.passes(0.0)

    def passes(
        self, seconds: float, requests: int = 0, waited_s: float = 0.0, lost: int = 0
    ) -> None:
        self.now_s += seconds
        self.asked += requests
        self.waited_s += waited_s
        self.lost += lost
        self.file.write_text(
            f"some avg10=0.00 avg60=0.00 avg300=0.00 total={round(1e6 * self.waited_s)}\n"
            "full avg10=0.00 avg60=0.00 avg300=0.00 total=99000000\n"
        )
        self.stat.write_text(
            f"cpu  362075 4328 87458 1998067 1368 0 2912 {2 * self.stolen} 0 0\n"
            f"cpu0 151444 3544 46235 1032590 217 0 2372 {self.stolen} 0 0\n"
            f"cpu1 210631 784 41223 965477 1151 0 540 {self.stolen} 0 0\n"
            "intr 1 0 0\n"
        )
        self.burdens.poll(self.now_s, self.asked, self.lost)


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


def test_watching_clients_and_normal_load_are_not_reported(world: World) -> None:
    for _ in range(100):
        world.passes(2.0, requests=640, waited_s=0.02)  # 32 of them, ten times a second each
    assert (world.said, world.burdens.flooded_s, world.burdens.memory_stalled_s) == ([], 0.0, 0.0)


def test_flood_is_logged_once_a_minute_and_timed(world: World) -> None:
    for _ in range(15):
        world.passes(2.0, requests=8000)
    assert world.said == ["the control socket is flooded: 4000 requests/s"]
    for _ in range(20):
        world.passes(2.0, requests=8000)
    flood = "the control socket is flooded: 4000 requests/s"
    assert world.said[1:] == [f"{flood} (and 29 similar events before)"]
    world.passes(2.0)
    assert world.burdens.flooded_s == pytest.approx(70.0)
    for _ in range(60):  # the flood is over: what was left out is logged once
        world.passes(2.0)
    assert world.said[2:] == [f"{flood} (and 3 similar events before)"]


def test_low_memory_is_logged(world: World) -> None:
    world.passes(0.01, waited_s=0.5)  # too soon: it looks every two seconds
    assert not world.said
    world.passes(2.0, waited_s=0.5)
    assert world.said == ["memory is low: processes waited for it for 1.0 of 2.0 s"]
    assert world.burdens.memory_stalled_s == pytest.approx(1.0)


def test_time_that_a_host_took_is_logged(world: World) -> None:
    tick_s = 1.0 / os.sysconf("SC_CLK_TCK")
    world.stolen += 1
    world.passes(2.0)
    assert not world.said, "a hundredth of a second in two is what any host takes now and then"
    world.stolen += 12
    world.passes(2.0)
    (line,) = world.said
    assert f"host of this virtual machine withheld its processors for {12 * tick_s:.2f} of" in line
    assert world.burdens.stolen_s == pytest.approx(12 * tick_s)


def test_steal_time_that_is_unreadable_or_steps_back_is_ignored(world: World) -> None:
    world.stat.write_text("")
    world.burdens.poll(world.now_s + 2.0, world.asked, world.lost)
    world.now_s += 2.0
    world.passes(2.0)
    world.stolen -= 50
    world.passes(2.0)
    world.stolen += 50
    world.passes(2.0)
    assert (world.said, world.burdens.stolen_s) == ([], 0.0)


def test_steal_time_that_is_readable_only_later_is_ignored(tmp_path: Path) -> None:
    said: list[str] = []
    resource_monitor, stat = ResourceMonitor(said.append, stat=tmp_path / "stat"), tmp_path / "stat"
    resource_monitor.poll(0.0, 0, 0)
    stat.write_text("cpu  1 1 1 1 1 1 1 123400 0 0\ncpu0 1 1 1 1 1 1 1 123400 0 0\n")
    resource_monitor.poll(2.0, 0, 0)
    assert (said, resource_monitor.stolen_s) == ([], 0.0)


def test_lost_rows_are_logged_once_a_minute_and_completely(world: World) -> None:
    world.passes(2.0, lost=300)
    words = "rows that the recorder did not read in time or could not write"
    assert world.said == [f"lost 300 {words}, 300 since the start"]
    for _ in range(10):
        world.passes(2.0, lost=7)
    assert len(world.said) == 1
    for _ in range(20):  # no more rows are lost; the suppressed ones are logged
        world.passes(2.0)
    assert world.said[1:] == [f"lost 70 {words}, 370 since the start"]
    for _ in range(100):
        world.passes(2.0)
    assert len(world.said) == 2
    world.passes(0.5, lost=1)  # and then it ends
    for _ in range(2):
        world.burdens.end(world.lost)
    assert world.said[2:] == [f"lost 1 {words}, 371 since the start"]


def test_process_that_is_moved_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    groups = [tmp_path / "home", tmp_path / "small"]
    said: list[str] = []
    at = groups[0]
    monkeypatch.setattr(resource_monitor, "_pressure_file", lambda: at)

    def wait(group: Path, total_s: float) -> None:
        group.write_text(f"some avg10=0.00 avg60=0.00 avg300=0.00 total={1e6 * total_s:.0f}\n")

    wait(groups[0], 50.0)
    wait(groups[1], 900.0)
    found = ResourceMonitor(said.append, stat=tmp_path / "none")
    found.poll(0.0, 0, 0)
    at = groups[1]
    found.poll(2.0, 0, 0)
    assert found.memory_stalled_s == 0.0, "what others waited for there is not the service's"
    wait(groups[1], 901.5)
    found.poll(4.0, 0, 0)
    assert found.memory_stalled_s == pytest.approx(1.5)


def test_kernel_that_does_not_say_is_no_error(tmp_path: Path) -> None:
    found = ResourceMonitor(pytest.fail, tmp_path / "none", tmp_path / "none")
    for now_s in (0.0, 2.0, 4.0):
        found.poll(now_s, 0, 0)
    assert found.memory_stalled_s == 0.0


def test_service_is_asked_before_the_machine(tmp_path: Path) -> None:
    pressure = "some avg10=0.00 avg60=0.00 avg300=0.00 total=1\n"
    group = tmp_path / "sys/fs/cgroup/system.slice/levid.service/memory.pressure"
    machine = tmp_path / "proc/pressure/memory"
    (tmp_path / "cgroup").write_text("1:name=systemd:/x\n0::/system.slice/levid.service\n")

    def found() -> Path | None:
        return resource_monitor._pressure_file(tmp_path, tmp_path)

    assert found() is None
    for path in (machine, group):
        path.parent.mkdir(parents=True)
        path.write_text(pressure)
        assert found() == path
    group.write_text("")  # a kernel that has it switched off
    assert found() == machine
    (tmp_path / "cgroup").unlink()
    assert found() == machine


@pytest.mark.parametrize("heavy", [False, True])
def test_status_says_in_words_what_weighed_on_the_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, levid: Callable[..., Any], heavy: bool
) -> None:
    us = {"p50": 1.0, "p99": 2.0, "p99.9": 3.0, "max": 4.0}
    answer = {
        **{"rig": "here", "rate_hz": 1000.0, "state": "IDLE", "fault": "NONE", "session": None},
        **{"cycle": 5, "late": 0, "stale": 2, "lost": 0, "recording": "", "fault_log": ""},
        "timing": {"lateness_us": us, "execution_us": us},
        "preflight": [],
        **dict.fromkeys(("clients_gone", "recorder_restarts", "flooded_s"), 0),
        **dict.fromkeys(("memory_stalled_s", "stolen_s"), 0),
    }
    if heavy:
        answer |= {
            "clients_gone": 3,
            "recorder_restarts": 1,
            "flooded_s": 4.0,
            "memory_stalled_s": 0.5,
            "stolen_s": 0.25,
        }
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    handlers = {"status": lambda _, reply: reply.done(**answer)}
    server = Server(tmp_path / "levid.sock", handlers, Access(Service()))
    server.start()
    try:
        lines = levid("status").out.splitlines()
    finally:
        server.close()
    assert lines[0] == "here at 1000 Hz: idle, zero force commanded"
    assert lines[1] == "cycle 5, 0 late, 2 stale readings"
    assert lines[4:] == heavy * [
        "3 clients disconnected in flight",
        "recorder restarted 1 times",
        "socket flooded for 4 s",
        "waited 0.5 s for memory",
        "host took 0.25 s of CPU time",
    ]
