"""Test the loop process outside its cycles: opening devices, ending meanwhile."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from daemon_process import GIVE_UP_S, calm
from waiting import wait_until

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.daemon.ipc import shared_memory as shared_module
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.ipc.shared_status_words import ControlWords, Word
from levid.daemon.loop import loop_process
from levid.drivers.base import LinkError

RIG_FILE = shipped("rigs/loopback.yaml")


def test_devices_that_open_at_the_second_try_are_not_ready_before_their_self_test(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    control_words, devices = ControlWords(memoryview(bytearray(ControlWords.SIZE))), object()
    answers: list[Any] = [LinkError("no cable"), devices]

    def open_devices(_: object) -> Any:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def wait(_: float) -> None:
        assert (control_words.fault, control_words.state) == (Fault.LINK, State.FAULT)
        control_words.clear()

    monkeypatch.setattr(loop_process, "open_devices", open_devices)
    monkeypatch.setattr(loop_process.time, "sleep", wait)
    said: list[str] = []
    rig = load_rig(RIG_FILE)
    opened = loop_process._opened(rig, Path(), control_words, lambda _: None, said.append)
    assert said == ["no flight recording of LINK: it occurred while devices were opened"]
    assert opened is devices
    assert signal.alarm(0) == 0  # what bounded it is taken back
    # The supervisor answers a clear once the loop is neither OFF nor in its self-test.
    assert (control_words.fault, control_words.state) == (Fault.NONE, State.OFF)
    assert control_words[Word.CLEARED] == control_words[Word.CLEAR]


# A loop whose devices take long where it is told to, and say what becomes of them.
LOOP = """
import sys, time
from levid.daemon.loop import loop_process
from levid.drivers.open_backends import open_devices

slow, *arguments = sys.argv[1:]
loop_process._CLOSING_S = 1

def opened(context):
    devices = open_devices(context)
    def take_long(what):
        if what in slow.split("+"):
            print(what, flush=True)
            time.sleep(100)
    def close():
        take_long("close")
        print("closed", flush=True)
    for backend in devices.backends:
        backend.recover, backend.close = lambda: take_long("recover"), close
    try:
        take_long("open")
    except BaseException:
        close()
        raise
    return devices

loop_process.open_devices = opened
loop_process.main(*arguments)
"""


def test_process_of_another_levid_touches_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = load_rig(RIG_FILE)
    shared = SharedMemory(rig)
    assert SharedMemory(rig, shared.fd).control_words[Word.LOOPS] == 0
    monkeypatch.setattr(shared_module, "Word", [*Word, SimpleNamespace(name="NEW")])
    with pytest.raises(SystemExit, match="levid was upgraded"):
        SharedMemory(rig, shared.fd)


@pytest.mark.parametrize(("machine", "doubts"), [("x86_64", 0), ("aarch64", 1)])
def test_machine_that_may_show_writes_out_of_order_is_warned_of(
    machine: str, doubts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("platform.machine", lambda: machine)
    found = shared_module.memory_order_warnings()
    assert len(found) == doubts
    assert all(machine in warning for warning in found)


@pytest.mark.parametrize(
    ("slow", "lines", "code"),
    [
        ("open", ["open", "closed"], 128 + signal.SIGTERM),
        ("recover", ["recover", "closed"], 128 + signal.SIGTERM),
        # A device that does not let itself be closed is left to itself.
        ("open+close", ["open", "close"], -signal.SIGALRM),
    ],
)
def test_loop_that_is_ended_while_a_driver_blocks_closes_its_devices(
    tmp_path: Path, slow: str, lines: list[str], code: int
) -> None:
    rig = calm(load_rig(RIG_FILE), tmp_path)
    shared = SharedMemory(rig)
    control_words = shared.control_words
    process = subprocess.Popen(
        [sys.executable, "-c", LOOP, slow, str(shared.fd), str(os.getpid()), str(RIG_FILE.parent)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        pass_fds=(shared.fd,),
    )
    try:
        assert process.stdin is not None
        assert process.stdout is not None
        with process.stdin as pipe:
            pipe.write(rig.model_dump_json().encode())
        if slow == "recover":
            for state, then in ((State.IDLE, control_words.stop), (State.FAULT, lambda: None)):
                wait_until(lambda state=state: control_words.state is state, GIVE_UP_S)
                then()
            control_words.clear()
        said = [process.stdout.readline().decode().strip()]
        process.terminate()
        said += process.stdout.read().decode().split()
        assert process.wait(GIVE_UP_S) == code
        assert said == lines
        if code > 0:
            assert control_words.state is State.OFF
    finally:
        process.kill()
        process.wait()
        shared.close()


def test_coils_cool_down_while_devices_are_opened_for_the_first_time(tmp_path: Path) -> None:
    """There are no cycles yet to count that by, and it may have failed for hours."""
    rig = calm(load_rig(RIG_FILE), tmp_path)
    shared = SharedMemory(rig)
    control_words = shared.control_words
    shared.heat[:] = 50.0
    control_words[Word.HEAT_MONOTONIC_NS] = time.monotonic_ns() - 60_000_000_000
    process = subprocess.Popen(
        [sys.executable, "-c", LOOP, "", str(shared.fd), str(os.getpid()), str(RIG_FILE.parent)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        pass_fds=(shared.fd,),
    )
    try:
        assert process.stdin is not None
        with process.stdin as pipe:
            pipe.write(rig.model_dump_json().encode())
        wait_until(lambda: control_words.state is State.IDLE, GIVE_UP_S)
        process.kill()
        process.wait()
        most = 50.0 * math.exp(-60.0 / rig.limits.coil_time_constant_s)
        assert 0.2 * most < shared.heat.min() <= shared.heat.max() < 1.01 * most
    finally:
        process.kill()
        process.wait()
        shared.close()
