"""Test that a refused real-time setting is a warning and that the others apply."""

import gc
import os
import subprocess
import sys

import pytest

from levid.config.daemon_settings import Realtime
from levid.daemon.host import real_time_scheduling
from levid.daemon.host.real_time_scheduling import (
    apply_realtime,
    avoid_cpus,
    cpu_latency_us,
    no_collections,
    virtual_machine,
)

NOTHING = Realtime(priority=0, lock_memory=False, cpu_latency_us=None)


def test_what_is_not_asked_for_is_not_warned_of() -> None:
    assert apply_realtime(NOTHING) == []


def test_processor_that_is_not_there_is_a_warning() -> None:
    before = os.sched_getaffinity(0)
    (warning,) = apply_realtime(NOTHING.model_copy(update={"cpus": (4000,)}))
    assert warning.startswith(
        "realtime.cpus [4000]: no such processor: the loop moves between processors; choose from "
    )
    assert os.sched_getaffinity(0) == before


def test_others_keep_off_the_loops_processors_if_there_are_any() -> None:
    before = os.sched_getaffinity(0)
    try:
        avoid_cpus(())
        assert os.sched_getaffinity(0) == before
        avoid_cpus((4000,))
        assert os.sched_getaffinity(0) == before
        avoid_cpus(before)
        assert os.sched_getaffinity(0) == before
        if len(before) > 1:
            avoid_cpus((max(before),))
            assert os.sched_getaffinity(0) == before - {max(before)}
    finally:
        os.sched_setaffinity(0, before)


def test_process_without_rights_is_warned_of_each_part_it_lacks() -> None:
    # In a process of its own, which gives away the rights it may have.
    program = """
import os, resource
from levid.config.daemon_settings import Realtime
from levid.daemon.host.real_time_scheduling import apply_realtime
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
if os.geteuid() == 0:
    os.setgroups([])
    os.setgid(54321)
    os.setuid(54321)
print(*apply_realtime(Realtime(cpu_latency_us=0)), sep="\\n")
"""
    told = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    assert "not permitted: any other process may delay the loop; add '* - rtprio 95' to" in told
    assert "more than this user may lock: a swapped-out page may stall the loop; add '" in told
    assert told.count("run levid as the service (levid install-service)") == 3
    assert [line.split()[0].rstrip(":") for line in told.splitlines()] == [
        "realtime.lock_memory",
        "realtime.cpu_latency_us",
        "realtime.priority",
    ]


@pytest.mark.parametrize(
    ("flags", "asked", "latency_us"),
    [
        ("fpu hypervisor lahf_lm", "auto", None),
        ("fpu lahf_lm", "auto", 0),
        ("fpu hypervisor lahf_lm", 0, 0),
        ("fpu lahf_lm", 50, 50),
        ("fpu lahf_lm", None, None),
    ],
)
def test_processors_of_a_virtual_machine_may_sleep_unless_told_otherwise(
    tmp_path, monkeypatch, flags: str, asked, latency_us: int | None
) -> None:
    (tmp_path / "cpuinfo").write_text(f"processor\t: 0\nflags\t\t: {flags}\nbugs\t\t: none\n")
    found = virtual_machine(tmp_path / "cpuinfo", tmp_path / "none")
    monkeypatch.setattr(real_time_scheduling, "virtual_machine", lambda: found)
    assert cpu_latency_us(Realtime(cpu_latency_us=asked)) == latency_us


def test_machine_without_description_is_not_virtual(tmp_path) -> None:
    nowhere, tree = tmp_path / "none", tmp_path / "tree"
    assert not virtual_machine(nowhere, nowhere)
    (tree / "fw-cfg@9020000").mkdir(parents=True)
    assert virtual_machine(nowhere, tree)


def test_collector_is_back_afterwards() -> None:
    with no_collections():
        assert not gc.isenabled()
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0
