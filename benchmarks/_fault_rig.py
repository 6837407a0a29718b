"""A rig for faults: electronics and daemon on one bus, and a disk that is soon full."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import yaml

from levid.config.shipped import shipped
from levid.daemon.client import Client, DaemonError

RATE_HZ = 250
CYCLES = 25
"""Stale readings that are bridged, and cycles until setpoints expire: a busy machine's patience."""
GIVE_UP_S = 40.0
SETTINGS = (shipped("rigs/loopback.yaml"), shipped("sims/nominal.yaml"))
_SMALL_BYTES = 8 << 20


class Rig:
    """Electronics and daemon on one bus, in processes of their own."""

    def __init__(self, bus: str, folder: Path, quick: bool = False) -> None:
        self.bus, self.folder, self.quick, self.flights = bus, folder, quick, 0
        self.cut: set[str] = set()
        self.small = small_disk(folder / "small")
        self.flight = folder
        self.path = folder / "levid.sock"
        self.file = folder / "rig.yaml"
        self.file.write_text(yaml.safe_dump(rig_of(bus, folder)))
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
        while "answer" not in (said := (folder / "electronics.log").read_text()):
            if self.electronics.poll() is not None:
                raise RuntimeError(f"the electronics did not start: {said}")
            time.sleep(0.05)
        self._answers: SimpleQueue[str] = SimpleQueue()
        threading.Thread(target=self._hear, daemon=True).start()
        self.daemon = self.start()

    def start(self) -> subprocess.Popen[bytes]:
        log = (self.folder / "daemon.log").open("ab")
        return subprocess.Popen(
            [sys.executable, "-m", "levid.cli.main", "run", str(self.file)], stderr=log
        )

    def close(self) -> None:
        for process in (self.daemon, self.electronics):
            process.terminate()
            try:
                process.wait(GIVE_UP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if self.small is not None:
            subprocess.run(["umount", "--lazy", str(self.small)], check=True)

    def say(self, *lines: str) -> list[str]:
        """Have the electronics do something, at once; return an answer to each line."""
        assert self.electronics.stdin is not None
        self.electronics.stdin.write("".join(f"{line}\n" for line in lines))
        self.electronics.stdin.flush()
        try:
            return [self._answers.get(timeout=GIVE_UP_S) for _ in lines]
        except Empty:
            said = (self.folder / "electronics.log").read_text()
            raise RuntimeError(f"the electronics do not answer: {said}") from None

    def _hear(self) -> None:
        assert self.electronics.stdout is not None
        for line in self.electronics.stdout:
            if line.strip():  # a fault is answered with its line, and another end of line
                self._answers.put(line)

    def ask(self, op: str, **more: Any) -> dict[str, Any]:
        with Client(self.path) as client:
            return client.request(op, **more)

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any] | None:
        """Return the first status that fulfils the condition, None where none does."""
        give_up_s = time.monotonic() + GIVE_UP_S
        while time.monotonic() < give_up_s:
            with contextlib.suppress(DaemonError):
                if condition(status := self.ask("status")):
                    return status
            time.sleep(0.02)
        return None

    def lift_off(self, on: Path) -> dict[str, Any]:
        """Fly, from whatever state the last trial left, with logs `on`; raises DaemonError."""
        self.say("clear")
        give_up_s = time.monotonic() + GIVE_UP_S
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
        return any(json.loads(self.say("status")[0])["acting_n"])

    def forced_periods(self, *then: str) -> int:
        """Return for how many periods any amplifier drove a force, since the start.

        `then`: a fault that is switched on as soon as that was looked at.
        """
        return int(json.loads(self.say("status", *then)[0])["forced_periods"])


def small_disk(at: Path) -> Path | None:
    """Return a file system of its own that is soon full, None without the right to mount one."""
    at.mkdir()
    size = f"size={_SMALL_BYTES}"
    command = ["mount", "-t", "tmpfs", "-o", size, "levid-benchmark", str(at)]
    with contextlib.suppress(OSError):
        if subprocess.run(command, check=False, capture_output=True).returncode == 0:
            return at
    print("no right to mount a small file system: no disk is full", file=sys.stderr)
    return None


def rig_of(bus: str, folder: Path) -> dict[str, Any]:
    plain: dict[str, Any] = yaml.safe_load(SETTINGS[0].read_text())
    kind = "serial" if bus == "serial" else "can"
    plain |= {
        "rate_hz": RATE_HZ,
        "sim": str(SETTINGS[1]),
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
