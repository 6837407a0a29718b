"""What is done from outside the electronics: to processes, the bus, the disk, memory and socket."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from levid.benchmarks.daemon.fault_flight import Flight, NotInjectedError
from levid.benchmarks.daemon.fault_rig import EXPIRE_CYCLES, RATE_HZ, STALL_S, Rig
from levid.benchmarks.harness.memory_pressure import NoPressureError, can_press, pressed, stalled_us

Status = dict[str, Any]
_TIOCVHANGUP = 0x5437
_PIDFD_OPEN, _PIDFD_GETFD = 434, 438
_FLOODING = 8
_BATCH = 50


@dataclass(frozen=True)
class Done:
    """What was done: `undo` takes it back once force is gone, where anything has to.

    since: periods with force, since the start, when the loop could first act on it; None where that
    is when it was done.
    """

    undo: Callable[[], None] | None = None
    since: int | None = None


def _kill_loop(_: Rig, status: Status) -> Done:
    os.kill(status["pids"]["loop"], signal.SIGKILL)
    return Done()


def _stop_loop(_: Rig, status: Status) -> Done:
    os.kill(status["pids"]["loop"], signal.SIGSTOP)
    return Done()


def _hold_loop_up(rig: Rig, status: Status) -> Done:
    pid, longest_s = status["pids"]["loop"], (EXPIRE_CYCLES - 1) / RATE_HZ
    os.kill(pid, signal.SIGSTOP)
    began_s = time.monotonic()
    time.sleep(0.5 * (STALL_S + 1.0 / RATE_HZ + longest_s))
    since = rig.forced_periods()
    os.kill(pid, signal.SIGCONT)
    held_s = time.monotonic() - began_s
    if held_s > longest_s:
        raise NotInjectedError(f"the loop was held up for {held_s:.3f} s: setpoints expire first")
    return Done(since=since)


def _kill_supervisor(rig: Rig, _: Status) -> Done:
    assert rig.daemon is not None
    rig.daemon.kill()
    rig.daemon.wait()
    return Done()


def _stop_supervisor(rig: Rig, _: Status) -> Done:
    assert rig.daemon is not None
    rig.daemon.send_signal(signal.SIGSTOP)
    return Done(partial(rig.daemon.send_signal, signal.SIGCONT))


def _stop(rig: Rig, _: Status) -> Done:
    rig.ask("stop")
    return Done()


def _lose_bus(rig: Rig, status: Status) -> Done:
    """Take the bus away at the host's end: the port hangs up, or its socket is shut."""
    try:
        if rig.bus == "serial":
            _hang_up(rig.folder / "port")
        else:
            for end in _sockets_of(status["pids"]["loop"]):
                with end, contextlib.suppress(OSError):  # not connected: it is shut all the same
                    end.shutdown(socket.SHUT_RDWR)
    except PermissionError as error:  # of a root that may not all
        raise NotInjectedError(str(error)) from None
    return Done()


def _hang_up(path: Path) -> None:
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        fcntl.ioctl(port, _TIOCVHANGUP)
    finally:
        os.close(port)


def _nothing(_: Rig, __: Status) -> Done:
    return Done()  # the session is what is wrong


DEEDS: dict[str, Callable[[Rig, Status], Done]] = {
    "loop held up": _hold_loop_up,
    "loop killed": _kill_loop,
    "loop stopped": _stop_loop,
    "supervisor killed": _kill_supervisor,
    "supervisor stopped": _stop_supervisor,
    "stop": _stop,
    "host's end lost": _lose_bus,
    "heat": _nothing,
}
"""End the flight."""


def _sockets_of(pid: int) -> Iterator[socket.socket]:
    """Yield the IPv4 datagram sockets of another process, as our own."""
    libc = ctypes.CDLL(None, use_errno=True)
    process = libc.syscall(_PIDFD_OPEN, pid, 0)
    if process < 0:
        raise NotInjectedError(os.strerror(ctypes.get_errno()))
    try:
        for link in Path(f"/proc/{pid}/fd").iterdir():
            if not str(link.readlink()).startswith("socket:"):
                continue
            fd = libc.syscall(_PIDFD_GETFD, process, int(link.name), 0)
            if fd < 0:
                raise NotInjectedError(os.strerror(ctypes.get_errno()))
            end = socket.socket(fileno=fd)
            if end.family == socket.AF_INET and end.type == socket.SOCK_DGRAM:
                yield end
            else:
                end.close()
    finally:
        os.close(process)


@dataclass
class Seen:
    """What is to be seen of a fault that must not disturb.

    told: whether a status names it, None where the daemon has no word for it. lands: whether the
    flight is to be landed by it. cut_at: the cycle from which on its log may end. answers: requests
    that were answered, and for how long they were asked. stalled_us: what all processes waited for
    memory, as the kernel says.
    """

    told: Callable[[Status], bool] | None = None
    lands: bool = False
    cut_at: int | None = None
    answers: int = 0
    seconds: float = 0.0
    stalled_us: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)


@contextlib.contextmanager
def _full_disk(rig: Rig, _: Flight) -> Iterator[Seen]:
    """Fill the disk that the log is on, to its last byte."""
    assert rig.small is not None
    ballast = rig.small / "ballast"
    try:
        with ballast.open("wb", buffering=0) as file:
            for size in (1 << 16, 1):
                with contextlib.suppress(OSError):
                    while True:
                        file.write(bytes(size))
        # What is written before the disk is full is not to be missed.
        seen = Seen(lambda s: os.strerror(errno.ENOSPC) in s["recording"])
        seen.cut_at = rig.ask("status")["cycle"]
        yield seen
    finally:
        ballast.unlink(missing_ok=True)


@contextlib.contextmanager
def _kill_recorder(_: Rig, flight: Flight) -> Iterator[Seen]:
    before = flight.status
    os.kill(before["pids"]["recorder"], signal.SIGKILL)
    yield Seen(lambda s: s["recorder_restarts"] > before["recorder_restarts"])


@contextlib.contextmanager
def _flood(rig: Rig, flight: Flight) -> Iterator[Seen]:
    """Ask for the status as often as it is answered, on several connections, all the while."""
    before_s = flight.status["flooded_s"]
    seen = Seen(lambda s: s["flooded_s"] > before_s)
    done, began_s = threading.Event(), time.monotonic()

    def ask() -> None:
        while not done.is_set():
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as end:
                end.settimeout(1.0)
                end.connect(str(rig.path))
                while not done.is_set():
                    end.sendall(b'{"op": "status"}\n' * _BATCH)
                    answered = _lines(end, _BATCH)
                    with seen.lock:
                        seen.answers += answered

    threads = [threading.Thread(target=ask, daemon=True) for _ in range(_FLOODING)]
    for thread in threads:
        thread.start()
    try:
        yield seen
    finally:
        done.set()
        for thread in threads:
            thread.join(5.0)
        seen.seconds = time.monotonic() - began_s


def _lines(end: socket.socket, most: int) -> int:
    lines = 0
    while lines < most and (data := end.recv(1 << 16)):
        lines += data.count(b"\n")
    return lines


@contextlib.contextmanager
def _pressure(rig: Rig, flight: Flight) -> Iterator[Seen]:
    """Have the daemon's processes short of memory."""
    before_us = stalled_us()
    pids = list(flight.status["pids"].values())
    try:
        with pressed(pids, rig.folder):
            before_s = flight.status["memory_stalled_s"]
            seen = Seen(lambda s: s["memory_stalled_s"] > before_s)
            yield seen
            seen.stalled_us = stalled_us() - before_us
    except NoPressureError as error:
        raise NotInjectedError(str(error)) from None


def _client_gone(lands: bool) -> Callable[[Rig, Flight], Any]:
    @contextlib.contextmanager
    def deed(_: Rig, flight: Flight) -> Iterator[Seen]:
        before = flight.status["clients_gone"]
        flight.hang_up()
        yield Seen(lambda s: s["clients_gone"] > before, lands=lands)

    return deed


HARMLESS: dict[str, Callable[[Rig, Flight], contextlib.AbstractContextManager[Seen]]] = {
    "disk full": _full_disk,
    "recorder killed": _kill_recorder,
    "socket flooded": _flood,
    "memory pressure": _pressure,
    "client gone, go on": _client_gone(lands=False),
    "client gone, land": _client_gone(lands=True),
}
"""Lasts for as long as it is entered."""


def cannot(rig: Rig, kind: str) -> str:
    """Return why a kind that only root can do is left out here, empty where it is not."""
    if kind == "disk full" and rig.small is None:
        return "no right to mount a small file system"
    if kind == "memory pressure" and not can_press():
        return "no right to make a memory group"
    if kind == "host's end lost" and os.geteuid() != 0:
        return "no right to another process' port"
    return ""
