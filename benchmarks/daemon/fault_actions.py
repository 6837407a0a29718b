"""Inject faults into processes, the bus, the disk and the control socket."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from levid.benchmarks.daemon.fault_flight import Flight, NotInjectedError
from levid.benchmarks.daemon.fault_rig import EXPIRE_CYCLES, RATE_HZ, STALL_S, Rig

Status = dict[str, Any]
_TIOCVHANGUP = 0x5437
_FLOODING, _BATCH = 8, 50


@dataclass(frozen=True)
class Action:
    """An injected fault: `undo` reverts it after the force has ended.

    since: periods with force until the loop could first react, None if that was at the injection.
    """

    undo: Callable[[], None] | None = None
    since: int | None = None


@dataclass(frozen=True)
class Expected:
    """Expected effects of a harmless fault.

    reported: whether a status shows it. lands: whether the flight must land. cut_at: cycle at which
    its log may end.
    """

    reported: Callable[[Status], bool]
    lands: bool = False
    cut_at: int | None = None


def reason_to_skip(rig: Rig, kind: str) -> str:
    """Return why this machine cannot inject a kind, empty if it can."""
    if kind == "disk full" and rig.small is None:
        return "no right to mount a small file system"
    if kind == "host's end lost" and os.geteuid() != 0:
        return "no right to hang up a port"
    return ""


def _signal(process: str, number: signal.Signals) -> Callable[[Rig, Status], Action]:
    def send(_: Rig, status: Status) -> Action:
        os.kill(status["pids"][process], number)
        return Action()

    return send


def _hold_loop_up(rig: Rig, status: Status) -> Action:
    """Stop the loop for longer than `stall_s`, but for less than until its setpoints expire."""
    pid, longest_s = status["pids"]["loop"], (EXPIRE_CYCLES - 1) / RATE_HZ
    os.kill(pid, signal.SIGSTOP)
    began_s = time.monotonic()
    time.sleep(0.5 * (STALL_S + 1.0 / RATE_HZ + longest_s))
    since = rig.forced_periods()
    os.kill(pid, signal.SIGCONT)
    held_s = time.monotonic() - began_s
    if held_s > longest_s:
        raise NotInjectedError(f"expected a stop of {longest_s:.3f} s or less, found {held_s:.3f}")
    return Action(since=since)


def _kill_supervisor(rig: Rig, _: Status) -> Action:
    assert rig.daemon is not None
    rig.daemon.kill()
    rig.daemon.wait()
    return Action()


def _stop_supervisor(rig: Rig, _: Status) -> Action:
    assert rig.daemon is not None
    rig.daemon.send_signal(signal.SIGSTOP)
    return Action(partial(rig.daemon.send_signal, signal.SIGCONT))


def _request_stop(rig: Rig, _: Status) -> Action:
    rig.ask("stop")
    return Action()


def _hang_up_port(rig: Rig, _: Status) -> Action:
    """Hang up the host's end of the serial port."""
    port = os.open(rig.folder / "port", os.O_RDWR | os.O_NOCTTY)
    try:
        fcntl.ioctl(port, _TIOCVHANGUP)
    except PermissionError as error:
        raise NotInjectedError(str(error)) from None
    finally:
        os.close(port)
    return Action()


ENDING: dict[str, Callable[[Rig, Status], Action]] = {
    "loop held up": _hold_loop_up,
    "loop killed": _signal("loop", signal.SIGKILL),
    "loop stopped": _signal("loop", signal.SIGSTOP),
    "supervisor killed": _kill_supervisor,
    "supervisor stopped": _stop_supervisor,
    "stop": _request_stop,
    "host's end lost": _hang_up_port,
    "heat": lambda *_: Action(),  # the session itself overloads a coil
}
"""Faults that must end the force."""


@contextmanager
def _full_disk(rig: Rig, _: Flight) -> Iterator[Expected]:
    """Fill the disk of the log completely."""
    assert rig.small is not None
    ballast = rig.small / "ballast"
    try:
        with ballast.open("wb", buffering=0) as file:
            for size in (1 << 16, 1):
                with contextlib.suppress(OSError):
                    while True:
                        file.write(bytes(size))
        full = os.strerror(errno.ENOSPC)
        yield Expected(lambda s: full in s["recording"], cut_at=rig.ask("status")["cycle"])
    finally:
        ballast.unlink(missing_ok=True)


@contextmanager
def _kill_recorder(_: Rig, flight: Flight) -> Iterator[Expected]:
    before = flight.status["recorder_restarts"]
    os.kill(flight.status["pids"]["recorder"], signal.SIGKILL)
    yield Expected(lambda s: s["recorder_restarts"] > before)


@contextmanager
def _flood(rig: Rig, flight: Flight) -> Iterator[Expected]:
    """Request the status continuously on several connections."""
    before_s, done = flight.status["flooded_s"], threading.Event()

    def request() -> None:
        while not done.is_set():
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as end:
                end.settimeout(1.0)
                end.connect(str(rig.path))
                while not done.is_set():
                    end.sendall(b'{"op": "status"}\n' * _BATCH)
                    lines = 0
                    while lines < _BATCH and (data := end.recv(1 << 16)):
                        lines += data.count(b"\n")

    threads = [threading.Thread(target=request, daemon=True) for _ in range(_FLOODING)]
    for thread in threads:
        thread.start()
    try:
        yield Expected(lambda s: s["flooded_s"] > before_s)
    finally:
        done.set()
        for thread in threads:
            thread.join(5.0)


@contextmanager
def _client_gone(_: Rig, flight: Flight, lands: bool = False) -> Iterator[Expected]:
    before = flight.status["clients_gone"]
    flight.hang_up()
    yield Expected(lambda s: s["clients_gone"] > before, lands=lands)


HARMLESS: dict[str, Callable[[Rig, Flight], AbstractContextManager[Expected]]] = {
    "disk full": _full_disk,
    "recorder killed": _kill_recorder,
    "socket flooded": _flood,
    "client gone, go on": _client_gone,
    "client gone, land": partial(_client_gone, lands=True),
}
"""Faults that must not end the flight; each lasts as long as its context."""
