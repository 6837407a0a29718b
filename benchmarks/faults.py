"""Random faults while flying, against electronics in a process of their own, on CAN FD and serial.

From one list zero force and the right name must follow, from the other nothing but a word of it;
after either the daemon has to be usable, and every log has to open. --quick: 40 faults; else 1,000,
which takes over an hour. The clock is not stepped here, for the machine has others on it: that is
in tests/rig_vm, on a machine of its own.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import _memory_hog
import _table
import yaml
from _memory_hog import available, to_take
from _table import Figure

from levid.config.shipped import shipped
from levid.daemon.client import Client, DaemonError
from levid.log.errors import LogError
from levid.log.reader import read_log

RATE_HZ = 250
CYCLES = 25
"""Stale readings that are bridged, and cycles until setpoints expire: a busy machine's patience."""
_GIVE_UP_S = 40.0
_SMALL_BYTES, _BALLAST = 8 << 20, "ballast"
_QUICK_BYTES = 1 << 30
_HELD_S = 3.0

# fault of the electronics: what the daemon may call it
ELECTRONICS = {
    "drop": {"STALE", "DRIVE"},
    "delay": {"STALE", "DRIVE"},
    "corrupt": {"STALE", "DRIVE"},
    "repeat": {"STALE", "DRIVE"},
    "reorder": {"STALE", "DRIVE"},
    "bus-off": {"STALE", "LINK", "DRIVE", "AMPLIFIER"},
    "disconnect": {"STALE", "LINK", "DRIVE"},
    "drop-setpoints": {"AMPLIFIER", "STALE", "DRIVE"},
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


_SOON = 3 + 2
"""Cycles within which force is to be zero, and two that may pass between a look and the fault."""
_PROMISED: dict[str, float] = {
    # What is bridged first, or what the devices bridge.
    **dict.fromkeys(
        ("drop", "delay", "corrupt", "repeat", "reorder", "bus-off", "disconnect"), _SOON + CYCLES
    ),
    "drop-setpoints": _SOON + CYCLES,
    "loop killed": _SOON + CYCLES,
    "loop stopped": _SOON + CYCLES,
    # What is noticed once it shows: when the platform has moved.
    "frozen 7": math.inf,
    "push 60": math.inf,
    "push -60": math.inf,
}
"""Periods of force at the device, if other than _SOON."""


@dataclass
class Tally:
    """What came of the trials."""

    trials: int = 0
    stops: int = 0
    stopped: int = 0
    named: int = 0
    others: int = 0
    undisturbed: int = 0
    to_tell: int = 0
    told: int = 0
    usable: int = 0
    unreadable: int = 0
    in_time: int = 0
    within: list[tuple[int, str]] = field(default_factory=list)
    wrong: Counter[str] = field(default_factory=Counter)


class Rig:
    """Electronics and daemon on one bus, in processes of their own."""

    def __init__(self, bus: str, folder: Path, quick: bool = False) -> None:
        self.bus, self.folder, self.quick, self.flights = bus, folder, quick, 0
        self.cut: set[str] = set()
        self.small = _small_disk(folder / "small")
        self.flight = folder
        self.path = folder / "levid.sock"
        self.file = folder / "rig.yaml"
        self.file.write_text(yaml.safe_dump(_rig(bus, folder)))
        # Real electronics do not wait for a processor: with the right to it, these do not for long.
        nice = shutil.which("nice") if os.geteuid() == 0 else None
        self.electronics = subprocess.Popen(
            [
                *([nice, "-n", "-15"] if nice else []),
                sys.executable,
                "-m",
                "levid.cli.main",
                "electronics",
                str(self.file),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=(folder / "electronics.log").open("w"),
            text=True,
        )
        while "answer" not in (folder / "electronics.log").read_text():
            assert self.electronics.poll() is None, "the electronics did not start"
            time.sleep(0.05)
        self.daemon = self.start()

    def start(self) -> subprocess.Popen[bytes]:
        log = (self.folder / "daemon.log").open("ab")
        return subprocess.Popen(
            [sys.executable, "-m", "levid.cli.main", "run", str(self.file)], stderr=log
        )

    def close(self) -> None:
        for process in (self.daemon, self.electronics):
            process.terminate()
            process.wait()
        if self.small is not None:
            subprocess.run(["umount", "--lazy", str(self.small)], check=True)

    def say(self, line: str) -> str:
        """Have the electronics do something; return their answer."""
        assert self.electronics.stdin is not None
        assert self.electronics.stdout is not None
        self.electronics.stdin.write(f"{line}\n")
        self.electronics.stdin.flush()
        while (answer := self.electronics.stdout.readline()) == "\n":
            pass  # a fault is answered with its line, and another end of line
        if not answer:
            raise RuntimeError((self.folder / "electronics.log").read_text())
        return answer

    def ask(self, op: str, **more: Any) -> dict[str, Any]:
        with Client(self.path) as client:
            return client.request(op, **more)

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any] | None:
        """Return the first status that fulfils the condition, None where none does."""
        give_up_s = time.monotonic() + _GIVE_UP_S
        while time.monotonic() < give_up_s:
            with contextlib.suppress(DaemonError):
                if condition(status := self.ask("status")):
                    return status
            time.sleep(0.02)
        return None

    def lift_off(self, on: Path) -> dict[str, Any]:
        """Fly, from whatever state the last trial left, with logs `on`; raises DaemonError."""
        self.say("clear")
        give_up_s = time.monotonic() + _GIVE_UP_S
        while True:
            try:
                if self.ask("status")["fault"] != "NONE":
                    self.ask("clear")
                if self.ask("status")["state"] == "IDLE":
                    self.flights += 1
                    self.flight = on / f"flight-{self.flights}"
                    step = {"unload_s": 0.2, "ramp_s": 0.4, "settle_s": 0.2}
                    out = str(self.flight)
                    self.ask("levitate", levitate=step, land={"ramp_s": 0.3}, out=out)
                    return self.ask("status")
            except DaemonError:
                if time.monotonic() > give_up_s:
                    raise
            time.sleep(0.05)

    def may_be_cut(self) -> None:
        """Note that the log of this flight may have lost all its rows: it could not be written."""
        self.cut.add(self.flight.name)

    def recordings(self) -> set[Path]:
        """Return the flight recordings that there are."""
        return set((self.folder / "faults").glob("*.mcap"))

    def forces(self) -> bool:
        """Return whether any amplifier drives a force."""
        return any(json.loads(self.say("status"))["acting_n"])

    def forced_periods(self) -> int:
        """Return for how many periods any amplifier drove a force, since the start."""
        return int(json.loads(self.say("status"))["forced_periods"])


def measure(quick: bool) -> list[Figure]:
    trials = 20 if quick else 500
    tally = Tally()
    for seed, bus in enumerate(("canfd", "serial")):
        rng = random.Random(seed)
        with tempfile.TemporaryDirectory() as folder:
            rig = Rig(bus, Path(folder), quick)
            try:
                for number in range(trials):
                    _trial(rig, rng, tally)
                    print(f"{bus} {number + 1}/{trials}", end="\r", file=sys.stderr)
                tally.trials += 1
                tally.usable += _flies(rig, tally) is not None  # after the last
            finally:
                rig.close()
            tally.unreadable += unreadable(Path(folder), rig.cut)
    for what, count in tally.wrong.most_common():
        print(f"{count} x {what}", file=sys.stderr)
    slowest, what = max(tally.within, default=(0, "nothing"))
    print(f"slowest to stop: {what}", file=sys.stderr)
    return [
        Figure("faults", tally.stops + tally.others, "", "faults injected in flight"),
        Figure("stopped", tally.stopped / max(tally.stops, 1), "", "that must stop: zero force"),
        Figure("named", tally.named / max(tally.stops, 1), "", "named rightly"),
        Figure("in_time", tally.in_time / max(tally.stops, 1), "", "in as many cycles as promised"),
        Figure("slowest_stop", slowest, "cycles", "most to zero force at the device"),
        Figure("undisturbed", tally.undisturbed / max(tally.others, 1), "", "flew on"),
        Figure("told", tally.told / max(tally.to_tell, 1), "", "of those with something to tell"),
        Figure("usable", tally.usable / max(tally.trials, 1), "", "lift-offs that succeeded"),
        Figure("unreadable", tally.unreadable, "", "logs that do not open"),
    ]


def _flies(rig: Rig, tally: Tally, on: Path | None = None) -> dict[str, Any] | None:
    """Lift off with what the trial before left behind; return the status if it flies."""
    try:
        status = rig.lift_off(on or rig.folder)
        if rig.until(lambda s: s["state"] == "LEVITATING" and rig.forces()):
            return status
        error = "no force acts"
    except DaemonError as refused:
        error = str(refused)
    tally.wrong[f"{rig.bus}: does not fly: {error}"] += 1
    return None


def _trial(rig: Rig, rng: random.Random, tally: Tally) -> None:
    tally.trials += 1
    harmless = [name for name in HARMLESS if name != "disk full" or rig.small is not None]
    name = rng.choice([*ELECTRONICS, *PROCESSES, *harmless])
    status = _flies(rig, tally, rig.small if name == "disk full" else None)
    if status is None:
        return
    tally.usable += 1
    if name in HARMLESS:
        _harmless(rig, name, status, tally)
        return
    tally.stops += 1
    recorded = rig.recordings()
    began, forced = time.monotonic(), rig.forced_periods()
    if name in ELECTRONICS:
        rig.say(name)
        expected = ELECTRONICS[name]
    else:
        expected = PROCESSES[name](rig, status)
    while rig.forces() and time.monotonic() - began < _GIVE_UP_S:
        time.sleep(0.005)
    if rig.forces():
        tally.wrong[f"{rig.bus}: {name}: force after {_GIVE_UP_S:g} s"] += 1
    else:
        tally.stopped += 1
        cycles = rig.forced_periods() - forced
        tally.within.append((cycles, f"{rig.bus}: {name}"))
        if cycles <= _PROMISED.get(name, _SOON):
            tally.in_time += 1
        else:
            tally.wrong[f"{rig.bus}: {name} takes {cycles} cycles"] += 1
    found = _name(rig, recorded)
    if found in expected:
        tally.named += 1
    else:
        tally.wrong[f"{rig.bus}: {name} is called {found}"] += 1


def _name(rig: Rig, before: set[Path]) -> str:
    """Return what the daemon calls the fault; a dead one has left a flight recording.

    `before`: the recordings that there were before the fault.
    """
    if rig.daemon.poll() is not None or not rig.path.exists():
        rig.daemon.wait()
        found = recorded_name(rig.recordings, before, _GIVE_UP_S)
        time.sleep(1.5)  # its processes have to let go of the bus
        rig.daemon = rig.start()
        return found
    status = rig.until(lambda s: s["fault"] != "NONE")
    return str(status["fault"]) if status else "nothing"


def recorded_name(recordings: Callable[[], set[Path]], before: set[Path], seconds: float) -> str:
    """Return the fault in the first recording that is new; wait so long until it can be read."""
    give_up_s = time.monotonic() + seconds
    while time.monotonic() < give_up_s:
        for path in sorted(recordings() - before):
            with contextlib.suppress(LogError):  # it is being written
                return read_log(path).metadata["name"]
        time.sleep(0.1)
    return "nothing"


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


def _harmless(rig: Rig, name: str, status: dict[str, Any], tally: Tally) -> None:
    """Do it, fly on for 200 cycles, land, and see whether anything else came of it."""
    tally.others += 1
    told = HARMLESS[name](rig, status)
    cycle = status["cycle"]
    flown = rig.until(lambda s: s["cycle"] > cycle + 200 or s["fault"] != "NONE")
    heard = rig.until(told) if told is not None else {}
    if flown is None or flown["fault"] != "NONE" or flown["state"] != "LEVITATING":
        tally.wrong[f"{rig.bus}: {name} disturbs: {flown and flown['fault']}"] += 1
    else:
        tally.undisturbed += 1
    tally.to_tell += told is not None
    tally.told += told is not None and heard is not None
    if heard is None:
        tally.wrong[f"{rig.bus}: {name} is not told"] += 1
    with contextlib.suppress(DaemonError):
        rig.ask("land")
    if name == "disk full":
        _make_room(rig)


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


def _make_room(rig: Rig) -> None:
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


def unreadable(folder: Path, cut: set[str]) -> int:
    """Return how many logs do not open; of the flights `cut`, one without a row is none."""
    bad = 0
    for path in sorted(folder.rglob("*.mcap")):
        try:
            read_log(path)
        except LogError as error:
            without_a_row = "found the end of the file" in str(error)
            if not (without_a_row and path.parent.name in cut):
                print(error, file=sys.stderr)
                bad += 1
    return bad


def _small_disk(at: Path) -> Path | None:
    """Return a file system of its own that is soon full, None without the right to mount one."""
    at.mkdir()
    size = f"size={_SMALL_BYTES}"
    command = ["mount", "-t", "tmpfs", "-o", size, "levid-benchmark", str(at)]
    with contextlib.suppress(OSError):
        if subprocess.run(command, check=False, capture_output=True).returncode == 0:
            return at
    print("no right to mount a small file system: no disk is full", file=sys.stderr)
    return None


def _rig(bus: str, folder: Path) -> dict[str, Any]:
    plain: dict[str, Any] = yaml.safe_load(shipped("rigs/loopback.yaml").read_text())
    kind = "serial" if bus == "serial" else "can"
    plain |= {
        "rate_hz": RATE_HZ,
        "sim": str(shipped("sims/nominal.yaml")),
        "socket": str(folder / "levid.sock"),
        "amplifiers": {"backend": kind, "bus": "main", "expire_cycles": CYCLES},
        "sensors": {"backend": kind, "bus": "main"},
        "drives": {"backend": kind, "bus": "main", "skew_m": 0.02},
        "recording": {"faults": str(folder / "faults"), "keep_faults": 10_000},  # all are read
    }
    plain["limits"] |= {"late_cycles": 200, "late_in_window": 10_000, "stall_s": 2.0}
    if kind == "serial":
        plain["serial"] = {
            "main": {"port": str(folder / "port"), "baud": 3_000_000, "stale_cycles": CYCLES}
        }
        return plain
    plain["drives"] |= {"heartbeat_s": 1.0, "expire_s": 1.0}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    plain["can"] = {
        "main": {
            "interface": "udp_multicast",
            "channel": "239.74.163.78",
            "bitrate": 1_000_000,
            "data_bitrate": 5_000_000,
            "options": {"port": port},
            "stale_cycles": CYCLES,
        }
    }
    return plain


if __name__ == "__main__":
    _table.run("Faults", measure)
