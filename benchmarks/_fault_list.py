"""The faults: what is done, what the daemon may call it, and when force has to be zero."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import _memory_hog
from _fault_rig import CYCLES, Rig
from _memory_hog import available, to_take

_BALLAST = "ballast"
_QUICK_BYTES = 1 << 30
_HELD_S = 3.0

# Fault of the electronics: what the daemon may call it.
ELECTRONICS = {
    "drop": {"STALE"},
    "delay": {"STALE"},
    "corrupt": {"STALE"},
    "repeat": {"STALE"},
    "reorder": {"STALE"},
    "bus-off": {"STALE"},  # it is the controller of the other end
    "disconnect": {"STALE", "LINK"},  # a node leaves the bus, or the port goes
    "drop-setpoints": {"AMPLIFIER"},
    "stuck 4": {"SENSOR"},
    "frozen 7": {"SENSOR"},
    "saturated 0": {"SENSOR"},
    "trip 3": {"AMPLIFIER"},
    "encoder phi": {"DRIVE"},
    "encoder x1": {"DRIVE"},
    "skew 0.05": {"DRIVE"},
    "push 60": {"GAP", "VELOCITY", "POSE"},
    "push -60": {"GAP", "VELOCITY", "POSE"},
}

SOON = 3
"""Cycles in which force acts, at most, from the one on in which the fault is switched on."""
OWN_TIMEOUT = dict.fromkeys(
    (
        *("drop", "delay", "corrupt", "repeat", "reorder", "bus-off", "disconnect"),
        *("drop-setpoints", "loop killed", "loop stopped"),
    ),
    CYCLES,
)
"""How many cycles more those may take that are bridged first, or left to the devices to notice."""
SHOWS_LATE = ("frozen 7", "push 60", "push -60")
"""What is noticed once the platform has moved: no number of cycles was promised."""


def _kill_loop(_: Rig, status: dict[str, Any]) -> set[str]:
    os.kill(status["pids"]["loop"], signal.SIGKILL)
    return {"LOOP"}


def _stop_loop(_: Rig, status: dict[str, Any]) -> set[str]:
    os.kill(status["pids"]["loop"], signal.SIGSTOP)
    return {"LOOP"}


def _kill_supervisor(rig: Rig, _: dict[str, Any]) -> set[str]:
    rig.daemon.kill()
    rig.daemon.wait()
    return {"SUPERVISOR"}


def _stop_supervisor(rig: Rig, _: dict[str, Any]) -> set[str]:
    rig.daemon.send_signal(signal.SIGSTOP)
    threading.Timer(3.0, rig.daemon.send_signal, [signal.SIGCONT]).start()
    return {"SUPERVISOR"}


def _stop(rig: Rig, _: dict[str, Any]) -> set[str]:
    rig.ask("stop")
    return {"STOPPED"}


PROCESSES: dict[str, Callable[[Rig, dict[str, Any]], set[str]]] = {
    "loop killed": _kill_loop,
    "loop stopped": _stop_loop,
    "supervisor killed": _kill_supervisor,
    "supervisor stopped": _stop_supervisor,
    "stop": _stop,
}


def _full_disk(rig: Rig, _: dict[str, Any]) -> Callable[[dict[str, Any]], bool]:
    """Fill the disk that the log is on, to its last byte."""
    assert rig.small is not None
    rig.may_be_cut()
    with (rig.small / _BALLAST).open("wb", buffering=0) as file:
        for size in (1 << 16, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(bytes(size))
    return lambda s: os.strerror(errno.ENOSPC) in s["recording"]


def make_room(rig: Rig) -> None:
    """Let the small disk be as it was, and keep the log of the flight where the others are."""
    assert rig.small is not None
    rig.until(lambda s: s["state"] in ("IDLE", "FAULT"))
    (rig.small / _BALLAST).unlink()
    shutil.move(rig.flight, rig.folder)


def _kill_recorder(rig: Rig, status: dict[str, Any]) -> Callable[[dict[str, Any]], bool]:
    rig.may_be_cut()
    os.kill(status["pids"]["recorder"], signal.SIGKILL)
    return lambda s: s["recorder_restarts"] > status["recorder_restarts"]


def _flood(rig: Rig, _: dict[str, Any]) -> None:
    def flood() -> None:
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as end:
            end.settimeout(1.0)
            end.connect(str(rig.path))
            for _ in range(100):
                end.sendall(b'{"op": "status"}\n' * 100)

    for _ in range(8):
        threading.Thread(target=flood, daemon=True).start()


def _pressure(rig: Rig, _: dict[str, Any]) -> None:
    """Hold most of the memory that is free for some seconds of the flight."""
    wanted = to_take(available(), _QUICK_BYTES if rig.quick else None)
    with subprocess.Popen(
        [sys.executable, _memory_hog.__file__, str(wanted)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as hog:
        assert hog.stdout is not None
        held = hog.stdout.readline()
        if not held.strip() or int(held) <= 0:
            raise RuntimeError(f"memory pressure: none of {wanted} bytes could be held")
        time.sleep(_HELD_S)


def _client_gone(rig: Rig, _: dict[str, Any]) -> None:
    with socket.socket(socket.AF_UNIX) as end:
        end.connect(str(rig.path))
        end.sendall(b'{"op": "move", "move": {"beam_m": 0.001}}\n')


HARMLESS: dict[str, Callable[[Rig, dict[str, Any]], Callable[[dict[str, Any]], bool] | None]] = {
    "disk full": _full_disk,
    "recorder killed": _kill_recorder,
    "socket flooded": _flood,
    "memory pressure": _pressure,
    "client gone": _client_gone,
}
