"""Fly a rig on a bus, its electronics and daemon in their own processes, and count its force.

Without a bus, on the loopback backend, the simulated rig is in the daemon's loop.

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
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import yaml

from levid.benchmarks.daemon import fault_injecting_electronics
from levid.benchmarks.daemon.fault_injecting_loopback import (
    BACKEND,
    LoopbackClient,
    install_backend,
)
from levid.benchmarks.harness.real_time import ELECTRONICS, hurry
from levid.benchmarks.harness.running_daemon import loopback_rig
from levid.benchmarks.harness.start_and_end_processes import started
from levid.config.backends import ROLES
from levid.daemon.client import Client, DaemonError

BUSES = ("canfd", "serial")
LOOPBACK = "loopback"
"""In place of a bus: no electronics."""
HOLDING = ("LEVITATING", "EXCITING", "MOVING")
FLYING = (*HOLDING, "LANDING")
RATE_HZ = 50
STALE_CYCLES = 2
EXPIRE_CYCLES = 10
"""The device's own timeout: much longer than the loop's deadline of 3 cycles."""
SUPERVISOR_S = 1.0
"""Timeout of the supervisor's heartbeat."""
LANDING_S, RAMP_S = 4.0, 0.3
"""Descent from the state LANDING, and from the others."""
GIVE_UP_S = 120.0
"""A start takes 5 s, and 40 s beside two busy processes a processor."""
WATCHED_S = 1.0
"""Time for which force must stay zero after a fault."""
_BEGINS_S = 20.0
_LIFT = {"unload_s": 0.2, "ramp_s": 0.4, "settle_s": 0.2, "check_coils": False}
_SESSION = {
    "levid": "session",
    "name": "fault",
    "excitations": {"it": {"input": "z", "rms_n": 0.3, "band_hz": [1.0, 20.0]}},
    "steps": [
        {"levitate": _LIFT},
        {"record": {"name": "long", "duration_s": 120.0, "excite": ["it"], "settle_s": 0.0}},
        {"land": {"ramp_s": RAMP_S}},
    ],
}

Status = dict[str, Any]
T = TypeVar("T")
_Case = TypeVar("_Case")

ERRORS = (DaemonError, OSError, RuntimeError)
"""Errors of an attempt after which a rig is not usable."""
_ATTEMPTS = 3
_LAST_LINES = 6


class NotInjectedError(Exception):
    """The fault did not happen: no flight, or the injection failed."""


class Rig:
    """Electronics and daemon on one bus, or a daemon with the loopback backend.

    `close` ends all processes. `more`: see rig_of.
    """

    def __init__(self, bus: str, folder: Path, **more: dict[str, Any]) -> None:
        self.bus, self.folder, self.flight = bus, folder, folder
        self.socket, self.file = folder / "levid.sock", folder / "rig.yaml"
        self.pids: dict[str, int] = {}
        self.signalled_s = 0.0
        """Monotonic time at which the last signal took effect; a killed supervisor has ended."""
        self._force_ends_s: list[float] = []
        self._client: socket.socket | None = None
        self._processes = contextlib.ExitStack()
        self.file.write_text(yaml.safe_dump(rig_of(bus, folder, **more)))
        self._electronics: subprocess.Popen[bytes] | None = None
        self._loopback: LoopbackClient | None = None
        try:
            if bus == LOOPBACK:
                self._environment: dict[str, str] | None = install_backend(folder)
                self._loopback = LoopbackClient(folder)
                self._processes.callback(self._loopback.close)
            else:
                self._environment = None
                program = [fault_injecting_electronics.__file__]
                self._electronics = self._start(program, subprocess.PIPE)
                self.say("status")
                hurry(ELECTRONICS, self._electronics.pid)  # real ones do not wait for a processor
            self.daemon = self._start_daemon()
        except BaseException:
            self.close()
            raise

    def _start(self, program: list[str], pipe: int | None = None) -> subprocess.Popen[bytes]:
        command = [sys.executable, *program, str(self.file)]
        with (self.folder / "errors.log").open("ab") as log:
            process = started(
                command, stdin=pipe, stdout=pipe or log, stderr=log, env=self._environment
            )
            return self._processes.enter_context(process)

    def _start_daemon(self) -> subprocess.Popen[bytes]:
        self._locks = _locks()
        return self._start(["-m", "levid.cli.main", "run"])

    def close(self) -> None:
        """End every process, also stopped ones."""
        self._signal_all(signal.SIGCONT)
        self._processes.close()
        if not wait_for(self._all_gone):
            self._signal_all(signal.SIGKILL)

    def _signal_all(self, number: signal.Signals) -> None:
        for pid in self.pids.values():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)

    def say(self, line: str) -> Status:
        """Send a command to the electronics; return their state before it.

        Raises:
            NotInjectedError: the electronics refuse it.
        """
        answer = self._say(line)
        self._force_ends_s = answer.get("force_ends_s", self._force_ends_s)
        return answer

    def _say(self, line: str) -> Status:
        if self._loopback is not None:
            return self._say_to_loop(self._loopback, line)
        assert self._electronics is not None
        assert self._electronics.stdin is not None
        assert self._electronics.stdout is not None
        self._electronics.stdin.write(f"{line}\n".encode())
        self._electronics.stdin.flush()
        there, _, _ = select.select([self._electronics.stdout], [], [], GIVE_UP_S)
        if not there or not (text := self._electronics.stdout.readline()):
            errors = (self.folder / "errors.log").read_text()
            raise RuntimeError(f"the electronics do not answer: {errors}")
        answer: Status = json.loads(text)
        if "error" in answer:
            raise NotInjectedError(answer["error"])
        return answer

    def _say_to_loop(self, loop: LoopbackClient, line: str) -> Status:
        if (answer := loop.say(line)) is not None:
            return answer
        if line not in ("status", "clear"):
            raise NotInjectedError("no cycle began")
        # Amplifiers of a loop that is dead or stopped: nothing acts.
        return {"acting_n": [0.0], "forced_periods": loop.forced_periods}

    def ask(self, op: str, **more: Any) -> Status:
        """Return the daemon's answer; raises DaemonError."""
        with Client(self.socket) as client:
            answer = client.request(op, **more)
        if op == "status":
            self.pids = {name: pid for name, pid in answer["pids"].items() if pid is not None}
        return answer

    def until(
        self, condition: Callable[[Status], bool], seconds: float = GIVE_UP_S
    ) -> Status | None:
        """Return the first status that fulfils the condition, None on a timeout."""

        def found() -> Status | None:
            with contextlib.suppress(DaemonError):
                if condition(status := self.ask("status")):
                    return status
            return None

        return wait_for(found, seconds)

    def lift_off(self, state: str, delay_s: float) -> Status:
        """Fly until `delay_s` after the request for a state, with logs; return the status.

        Raises:
            NotInjectedError: the rig is not in this state by then.
        """
        if self.until(_rests) is None:
            raise NotInjectedError("the rig is not at rest")
        self._new_flight()
        try:
            self._take_off(state)
            due_s = time.monotonic() + delay_s
            self.until(lambda s: s["state"] == state or s["fault"] != "NONE", _BEGINS_S)
            time.sleep(max(due_s - time.monotonic(), 0.0))
            status = self.ask("status")
        except DaemonError as refused:
            raise NotInjectedError(str(refused)) from None
        if status["state"] != state or status["fault"] != "NONE":
            found = f"{status['state']}, {status['fault']}: {status['detail']}"
            raise NotInjectedError(f"expected {state}, found {found}")
        return status

    def begin_levitating(self) -> None:
        """Lift off, with a log, without waiting for it."""
        self._new_flight()
        self.begin("levitate", levitate=_LIFT, land={"ramp_s": RAMP_S}, out=str(self.flight))

    def _new_flight(self) -> None:
        self.flight = Path(tempfile.mkdtemp(dir=self.folder)) / "logs"

    def _take_off(self, state: str) -> None:
        out = str(self.flight)
        if state == "EXCITING":
            self.begin("excite", session=yaml.safe_dump(_SESSION), out=out)
            return
        land = {"ramp_s": LANDING_S if state == "LANDING" else RAMP_S}
        self.ask("levitate", levitate=_LIFT, land=land, out=out)
        if state == "MOVING":
            to_m = 0.01 if self.ask("status")["beam_m"] < 0.0 else -0.01
            self.begin("move", move={"beam_m": to_m, "velocity_m_s": 0.001})
        elif state == "LANDING":
            self.ask("land")

    def begin(self, op: str, **more: Any) -> None:
        """Send a request that takes long, and do not wait for its end."""
        self._client = socket.socket(socket.AF_UNIX)
        self._client.settimeout(GIVE_UP_S)
        request = {"op": op, "client_gone": "go_on", **more}
        try:
            self._client.connect(str(self.socket))
            self._client.sendall(json.dumps(request).encode() + b"\n")
        except OSError as error:
            raise DaemonError(f"{op}: {error}") from None

    def forced_periods(self) -> int:
        """Count the periods since the start in which any amplifier drove a force."""
        return int(self.say("status")["forced_periods"])

    def until_zero(self, since: int) -> tuple[int, str]:
        """Return the periods with force after `since`, and what is wrong: force that stays."""
        if not wait_for(lambda: not any(self.say("status")["acting_n"])):
            return 0, f"force after {GIVE_UP_S:g} s"
        ended = self.forced_periods()
        time.sleep(WATCHED_S)
        again = self.forced_periods() - ended
        return ended - since, f"force acts again, for {again} cycles" if again else ""

    def forced_since_signal(self) -> int:
        """Return the periods with force that ended after the last signal took effect."""
        return sum(end_s > self.signalled_s for end_s in self._force_ends_s)

    @contextlib.contextmanager
    def signalled(self, process: str, how: str) -> Iterator[int]:
        """Kill or stop a process, and let it continue afterwards; yields its number."""
        pid = self.pids[process]
        os.kill(pid, signal.SIGKILL if how == "killed" else signal.SIGSTOP)
        if (process, how) == ("supervisor", "killed"):
            # The loop sees its parent's end when the kernel has ended its last thread: 30 to 80 ms.
            wait_for(lambda: _parent(self.pids["loop"]) != pid, every_s=1e-3)
        self.signalled_s = time.monotonic()
        try:
            yield pid
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
            if (process, how) == ("supervisor", "killed"):
                self.daemon.wait(GIVE_UP_S)

    def come_to_rest(self) -> int:
        """End the cause, clear the fault and wait until the daemon is idle; return the clears.

        A daemon that has ended is started again, as systemd would do.

        Raises:
            RuntimeError: a timeout.
        """
        if self._client is not None:
            self._client.close()
        self.say("clear")
        if self.daemon.poll() is not None or not self.socket.exists():
            self.daemon.wait(GIVE_UP_S)
            if not wait_for(self._all_gone):
                raise RuntimeError(f"the daemon's processes outlive it: {self.pids}")
            if left := self.left():
                raise RuntimeError(f"the daemon has left {', '.join(left)}")
            self.daemon = self._start_daemon()
        if not wait_for(lambda: self.bus != "serial" or (self.folder / "port").exists()):
            raise RuntimeError("the electronics' port did not come back")
        clears = 0

        def usable(status: Status) -> bool:
            nonlocal clears
            if status["fault"] != "NONE":
                clears += 1
                self.ask("clear")
                self.until(lambda s: s["fault"] == "NONE", 1.0)
            elif status["state"] in HOLDING:
                self.ask("land")
            return _rests(status)

        if self.until(usable) is None:
            raise RuntimeError(f"not usable after {clears} clears in {GIVE_UP_S:g} s")
        return clears

    def last_words(self) -> str:
        """Return the end of what daemon and electronics have printed."""
        return " | ".join((self.folder / "errors.log").read_text().splitlines()[-_LAST_LINES:])

    def left(self) -> list[str]:
        """Return processes, locks and shared memory of a daemon that has ended.

        Shared memory of the daemon has no name in a file system: it ends with its processes.
        """
        processes = [f"process {pid}" for pid in _pids_with(str(self.file), self._electronics)]
        return [*processes, *sorted(_locks() - self._locks)]

    def _all_gone(self) -> bool:
        return not any(map(_runs, self.pids.values()))


def wait_for(found: Callable[[], T], seconds: float = GIVE_UP_S, every_s: float = 0.02) -> T | None:
    """Return the first true value of a function, None on a timeout."""
    give_up_s = time.monotonic() + seconds
    while not (value := found()):
        if time.monotonic() > give_up_s:
            return None
        time.sleep(every_s)
    return value


def fly_cases(
    bus: str,
    cases: Iterable[_Case],
    attempt: Callable[[Rig, _Case], None],
    **more: dict[str, Any],
) -> None:
    """Attempt each case on one rig; after an error that `attempt` raises, on a new one.

    A case whose fault was not injected is attempted up to three times.
    """
    due = list(cases)
    while due:
        with (
            tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name,
            contextlib.closing(Rig(bus, Path(name), **more)) as rig,
            contextlib.suppress(*ERRORS),
        ):
            while due:
                case = due.pop(0)
                for _ in range(_ATTEMPTS):
                    try:
                        attempt(rig, case)
                        break
                    except NotInjectedError as error:
                        print(f"{bus}, {case}: not injected: {error}", file=sys.stderr)
                        rig.come_to_rest()


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
        "service": {"supervisor_gone": "zero", "supervisor_s": SUPERVISOR_S},
    }
    late = {"late_cycles": 200, "late_in_window": 10_000, "stall_s": 0.1}
    plain["limits"] |= {**late, "tilt_rad": 0.004}
    for section, keys in more.items():
        plain[section] |= keys
    if bus == LOOPBACK:
        return {**plain, **{role: {"backend": BACKEND} for role in ROLES}}
    if kind == "serial":
        port = {"port": str(folder / "port"), "baud": 3_000_000, "stale_cycles": STALE_CYCLES}
        return {**plain, "serial": {"main": port}}
    plain["drives"] |= {"heartbeat_s": 1.0, "expire_s": 1.0}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        options = {"port": probe.getsockname()[1]}
    channel = {"interface": "udp_multicast", "channel": "239.74.163.78", "options": options}
    rates = {"bitrate": 1_000_000, "data_bitrate": 5_000_000, "stale_cycles": STALE_CYCLES}
    return {**plain, "can": {"main": {**channel, **rates}}}


def _rests(status: Status) -> bool:
    """Return whether the next flight may begin: a session ends when its last row is on disk."""
    return status["state"] == "IDLE" and status["fault"] == "NONE" and status["session"] is None


def _locks() -> set[str]:
    """Return the locks of buses and named shared memory on this machine."""
    sockets = Path("/proc/net/unix").read_text().split()
    locks = {f"lock {name}" for name in sockets if name.startswith("@levid-")}
    return locks | {f"shared memory {path}" for path in Path("/dev/shm").glob("*levid*")}


def _pids_with(argument: str, but: subprocess.Popen[bytes] | None) -> list[int]:
    """Return the processes that have this argument, and no zombies."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if argument in path.read_text(errors="replace").split("\0"):
                found.append(int(path.parent.name))
    return [pid for pid in found if but is None or pid != but.pid]


def _parent(pid: int) -> int | None:
    """Return the parent of a process, None if the process has ended."""
    stat = _stat(pid)
    return int(stat[1]) if stat else None


def _runs(pid: int) -> bool:
    stat = _stat(pid)
    return bool(stat) and stat[0] not in ("Z", "X")  # a zombie


def _stat(pid: int) -> list[str]:
    """Return state, parent and further fields of a process; none if the process has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []
