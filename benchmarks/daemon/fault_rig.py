"""Run electronics and daemon on one bus, in their own processes, and a small disk for logs.

The rig flies at 50 Hz and bridges two cycles without a reading: 40 ms outlast the stalls of a
desktop kernel (4 to 11 ms, at times 20). Deadlines count in cycles, which are 20 ms here; shipped
rigs fly faster and bridge 20. The gains are a quarter to a half of the shipped ones, which diverge
at this rate.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from levid.benchmarks.daemon import fault_electronics
from levid.benchmarks.harness.child_processes import end
from levid.benchmarks.harness.real_time import ELECTRONICS, hurry
from levid.benchmarks.harness.running_daemon import loopback_rig
from levid.daemon.client import Client, DaemonError
from levid.daemon.host.real_time_scheduling import signal_at_parent_death

RATE_HZ = 50
STALE_CYCLES = 2
EXPIRE_CYCLES = 10
"""The device's own timeout: much longer than the loop's deadline of 3 cycles."""
STALL_S = 0.1
"""Longest stall of the loop; setpoints expire later."""
SUPERVISOR_S = 1.0
"""Timeout of the supervisor's heartbeat."""
BEFORE_FAULT_S = 10.0
"""Time that flight recordings must cover before the fault."""
GIVE_UP_S = 40.0
_SMALL_BYTES = 8 << 20
_STARTS_S = 60.0


class Rig:
    """Electronics and daemon on one bus; `close` ends all processes. `more`: see rig_of."""

    def __init__(self, bus: str, folder: Path, **more: dict[str, Any]) -> None:
        self.bus, self.folder, self.flights = bus, folder, 0
        self.small: Path | None = None
        self.flight = folder
        self.path = folder / "levid.sock"
        self.file = folder / "rig.yaml"
        self.pids: dict[str, int] = {}
        self.daemon: subprocess.Popen[bytes] | None = None
        self._electronics: subprocess.Popen[str] | None = None
        try:
            self.small = small_disk(folder / "small")
            self.file.write_text(yaml.safe_dump(rig_of(bus, folder, **more)))
            self._start_electronics()
            self.start()
        except BaseException:
            self.close()
            raise

    def _start_electronics(self) -> None:
        log = self.folder / "electronics.log"
        with log.open("w") as errors:
            self._electronics = subprocess.Popen(
                [sys.executable, fault_electronics.__file__, str(self.file)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        give_up_s = time.monotonic() + _STARTS_S
        while fault_electronics.READY not in (said := log.read_text()):
            if self._electronics.poll() is not None or time.monotonic() > give_up_s:
                raise RuntimeError(f"the electronics did not start: {said}")
            time.sleep(0.05)
        hurry(ELECTRONICS, self._electronics.pid)  # real electronics do not wait for a processor

    def start(self) -> None:
        """Start the daemon."""
        with (self.folder / "daemon.log").open("ab") as log:
            self.daemon = subprocess.Popen(
                [sys.executable, "-m", "levid.cli.main", "run", str(self.file)],
                stderr=log,
                # The daemon ends with the benchmark, however that ends.
                preexec_fn=partial(signal_at_parent_death, os.getpid(), signal.SIGTERM),  # noqa: PLW1509
            )

    def close(self) -> None:
        """End every process, also stopped ones, and unmount the small disk."""
        for process in (self.daemon, self._electronics):
            if process is None or process.poll() is not None:
                continue
            process.send_signal(signal.SIGCONT)
            end(process, GIVE_UP_S)
        if not gone(self.pids.values(), GIVE_UP_S):
            for pid in self.pids.values():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        if (self.folder / "small").is_mount():  # also if an interrupt came before it was stored
            subprocess.run(["umount", "--lazy", str(self.folder / "small")], check=False)
        self.small = None

    def say(self, line: str) -> dict[str, Any]:
        """Send a command to the electronics; return their answer and state before it."""
        assert self._electronics is not None
        assert self._electronics.stdin is not None
        assert self._electronics.stdout is not None
        try:
            self._electronics.stdin.write(f"{line}\n")
            self._electronics.stdin.flush()
            if select.select([self._electronics.stdout], [], [], GIVE_UP_S)[0]:
                answer: dict[str, Any] = json.loads(self._electronics.stdout.readline())
                return answer
        except (OSError, ValueError):
            pass  # it has ended
        errors = (self.folder / "electronics.log").read_text()
        raise RuntimeError(f"the electronics do not answer: {errors}")

    def ask(self, op: str, **more: Any) -> dict[str, Any]:
        """Return the daemon's answer; raises DaemonError."""
        with Client(self.path) as client:
            answer = client.request(op, **more)
        if op == "status":
            self.pids = {name: pid for name, pid in answer["pids"].items() if pid is not None}
        return answer

    def until(
        self, condition: Callable[[dict[str, Any]], bool], seconds: float = GIVE_UP_S
    ) -> dict[str, Any] | None:
        """Return the first status that fulfils the condition, None on a timeout."""
        give_up_s = time.monotonic() + seconds
        while time.monotonic() < give_up_s:
            with contextlib.suppress(DaemonError):
                if condition(status := self.ask("status")):
                    return status
            time.sleep(0.02)
        return None

    def forces(self) -> bool:
        """Return whether any amplifier drives a force."""
        return any(self.say("status")["acting_n"])

    def forced_periods(self) -> int:
        """Count the periods since the start in which any amplifier drove a force."""
        return int(self.say("status")["forced_periods"])

    def recordings(self) -> set[Path]:
        """Return the flight recordings on disk."""
        return set((self.folder / "faults").glob("*.mcap"))

    def logs(self) -> list[Path]:
        """Return the logs of the last flight."""
        return sorted(self.flight.glob("*.mcap"))

    def logs_are_closed(self) -> bool:
        """Wait until the recorder has closed the last flight's files; return False on a timeout."""
        give_up_s = time.monotonic() + GIVE_UP_S
        while (pid := self.pids.get("recorder")) and str(self.flight) in _open_files(pid):
            if time.monotonic() > give_up_s:
                return False
            with contextlib.suppress(DaemonError):
                self.ask("status")  # the recorder may be restarted
            time.sleep(0.02)
        return True

    def start_anew(self) -> None:
        """Start the daemon again after it has ended, as systemd would do."""
        assert self.daemon is not None
        self.daemon.wait(GIVE_UP_S)
        if not gone(self.pids.values(), GIVE_UP_S):
            raise RuntimeError(f"the daemon's processes outlive it: {self.pids}")
        self.start()

    @property
    def daemon_is_there(self) -> bool:
        """Whether the daemon runs and its socket exists."""
        assert self.daemon is not None
        return self.daemon.poll() is None and self.path.exists()

    def port_is_there(self) -> bool:
        """Wait for the electronics' port; return False on a timeout."""
        give_up_s = time.monotonic() + GIVE_UP_S
        port = self.folder / "port"
        while not (there := self.bus != "serial" or port.exists()):
            if time.monotonic() > give_up_s:
                break
            time.sleep(0.05)
        return there


def gone(pids: Iterable[int], seconds: float) -> bool:
    """Wait until these processes have ended; return False on a timeout."""
    give_up_s = time.monotonic() + seconds
    left = list(pids)
    while left := [pid for pid in left if _runs(pid)]:
        if time.monotonic() > give_up_s:
            return False
        time.sleep(0.02)
    return True


def _runs(pid: int) -> bool:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return not stat[stat.rfind(")") + 2 :].startswith(("Z", "X"))  # a zombie


def _open_files(pid: int) -> str:
    """Return the paths of all files that a process has open."""
    found = []
    with contextlib.suppress(OSError):  # it has ended
        for link in Path(f"/proc/{pid}/fd").iterdir():
            found.append(os.path.realpath(link))
    return "\n".join(found)


def small_disk(at: Path) -> Path | None:
    """Mount a small file system; return None without the right to do so."""
    at.mkdir()
    size = f"size={_SMALL_BYTES}"
    command = ["mount", "-t", "tmpfs", "-o", size, "levid-benchmark", str(at)]
    with contextlib.suppress(OSError):
        if subprocess.run(command, check=False, capture_output=True).returncode == 0:
            return at
    return None


def rig_of(bus: str, folder: Path, **more: dict[str, Any]) -> dict[str, Any]:
    """Return the rig as plain data; `more` adds or replaces keys of its sections."""
    plain: dict[str, Any] = yaml.safe_load(loopback_rig(folder).read_text())
    kind = "serial" if bus == "serial" else "can"
    tilt = {"kp_n_m_rad": 5, "ki_n_m_rad_s": 50}
    plain |= {
        "rate_hz": RATE_HZ,
        "control": {"psi": tilt, "theta": dict(tilt), "z": {"kp_n_m": 300, "ki_n_m_s": 1500}},
        "amplifiers": {"backend": kind, "bus": "main", "expire_cycles": EXPIRE_CYCLES},
        "sensors": {"backend": kind, "bus": "main"},
        "drives": {"backend": kind, "bus": "main", "skew_m": 0.02},
    }
    plain["recording"] |= {"keep_faults": 10_000, "before_fault_s": BEFORE_FAULT_S}
    plain["limits"] |= {
        "late_cycles": 200,
        "late_in_window": 10_000,
        "stall_s": STALL_S,
        "tilt_rad": 0.004,
        "coil_rms_n": 8.8,  # the platform at rest takes 7.8 N per coil
        "coil_time_constant_s": 1.0,
    }
    plain["service"] = {"supervisor_gone": "zero", "supervisor_s": SUPERVISOR_S}
    for section, keys in more.items():
        plain[section] |= keys
    if kind == "serial":
        plain["serial"] = {
            "main": {"port": str(folder / "port"), "baud": 3_000_000, "stale_cycles": STALE_CYCLES}
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
            "stale_cycles": STALE_CYCLES,
        }
    }
    return plain
