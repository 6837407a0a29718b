"""A daemon of three processes for tests: its supervisor in a thread of the test's."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from levid.config.rig import RigConfig
from levid.daemon.client import Client, DaemonError
from levid.daemon.supervision.supervisor import Supervisor

GIVE_UP_S = 60.0
# 250 Hz, and no rights that others on the machine would feel: what tests assert is what happens,
# not when. The heartbeats' bounds stand for machines of any load.
CALM: dict[str, Any] = {
    "rate_hz": 250.0,
    "realtime": {"priority": 0, "lock_memory": False, "cpu_latency_us": None},
    "service": {"supervisor_s": 30.0, "loop_s": 30.0},
}


def calm(rig: RigConfig, folder: Path, **more: Any) -> RigConfig:
    """Return the rig for a test: at ease in time, its flight recordings in `folder`."""
    plain = rig.model_dump()
    for key, value in {**CALM, **more}.items():
        plain[key] = {**(plain[key] or {}), **value} if isinstance(value, dict) else value
    plain["limits"] |= {"late_cycles": 1000, "late_in_window": 100_000, "stall_s": 20.0}
    plain["recording"]["faults"] = str(folder / "faults")
    return RigConfig.model_validate(plain)


@dataclass
class Daemon:
    supervisor: Supervisor
    thread: threading.Thread
    socket: Path
    said: list[str]

    def ask(self, op: str, **more: Any) -> dict[str, Any]:
        with Client(self.socket) as client:
            return client.request(op, **more)

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Return the first status that fulfils the condition."""
        give_up_s = time.monotonic() + GIVE_UP_S
        while not condition(status := self.ask("status")):
            assert time.monotonic() < give_up_s, status
            time.sleep(0.02)
        return status


@contextmanager
def daemon(rig: RigConfig, rig_file: Path, folder: Path) -> Iterator[Daemon]:
    """Run a daemon, ready when the body begins, ended after it."""
    path, ready, said = folder / "levid.sock", threading.Event(), []
    supervisor = Supervisor(rig, rig_file, path, said.append)
    thread = threading.Thread(target=supervisor.run, args=(ready.set,))
    thread.start()
    try:
        give_up_s = time.monotonic() + GIVE_UP_S
        while not ready.wait(0.02):
            assert thread.is_alive()
            assert time.monotonic() < give_up_s, said
        yield Daemon(supervisor, thread, path, said)
    finally:
        supervisor.stop()
        thread.join()
    assert not path.exists()


def refused(daemon: Daemon, op: str, **more: Any) -> str:
    """Return why a request was refused."""
    try:
        answer = daemon.ask(op, **more)
    except DaemonError as error:
        return str(error)
    raise AssertionError(f"{op} was not refused: {answer}")
