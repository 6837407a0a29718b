"""A daemon in real time, `levid run` in processes of its own, for benchmarks that fly with it."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from levid.benchmarks.harness.start_and_end_processes import started
from levid.config.shipped import shipped
from levid.daemon.client import Client, DaemonError

_READY_S = 60.0
_LANDED_S = 30.0
_AGAIN_S = 0.2


@dataclass(frozen=True)
class Daemon:
    """A daemon at rest. `cleared`: how many faults of its start had to be cleared for that."""

    rig_file: Path
    socket: Path
    pids: dict[str, int]
    cleared: int

    def ask(self, op: str, **more: Any) -> dict[str, Any]:
        """Ask over a connection of its own."""
        with Client(self.socket) as client:
            return client.request(op, **more)

    def land(self) -> dict[str, Any]:
        """Land and return the status at rest; raises DaemonError where that is not reached."""
        self.ask("land")
        give_up_s = time.monotonic() + _LANDED_S
        while (status := self.ask("status"))["state"] != "IDLE":
            require_no_fault(status)
            if time.monotonic() > give_up_s:
                raise DaemonError(f"not landed after {_LANDED_S:g} s, but {status['state']}")
            time.sleep(_AGAIN_S / 2)
        require_no_fault(status)
        return status


@contextmanager
def running(rig_file: Path, socket: Path) -> Iterator[Daemon]:
    """Run a daemon on this rig, whose `socket` is given; give it once it is idle.

    Devices that are just being started may take their time to answer. Raises DaemonError.
    """
    command = [sys.executable, "-m", "levid.cli.main", "run", str(rig_file)]
    with started(command, stderr=subprocess.DEVNULL) as process:
        yield _idle(process, rig_file, socket)


def require_no_fault(status: dict[str, Any]) -> None:
    """Raise DaemonError where the daemon is in a fault: it never gets out of that by itself."""
    if status["fault"] != "NONE":
        raise DaemonError(f"in fault {status['fault']}: {status['detail']}")


def _idle(process: subprocess.Popen[bytes], rig_file: Path, socket: Path) -> Daemon:
    give_up_s = time.monotonic() + _READY_S
    said, cleared = "nothing", 0
    while time.monotonic() < give_up_s and process.poll() is None:
        try:
            with Client(socket) as client:
                status = client.request("status")
                if status["state"] == "IDLE":
                    if cleared:
                        print(f"{cleared} faults at the start, the last {said}", file=sys.stderr)
                    return Daemon(rig_file, socket, status["pids"], cleared)
                if status["fault"] != "NONE":
                    said = f"{status['fault']}: {status['detail']}"
                    cleared += 1
                    client.request("clear")
                else:
                    said = status["state"]
        except DaemonError as error:
            said = str(error)
        time.sleep(_AGAIN_S)
    raise DaemonError(f"the daemon did not become idle, the last was: {said}")


def loopback_rig(folder: Path, **limits: float) -> Path:
    """Write the shipped loopback rig, with a socket and recordings in `folder`; return its file."""
    plain: dict[str, Any] = yaml.safe_load(shipped("rigs/loopback.yaml").read_text())
    plain |= {
        "model": str(shipped("models/rig.yaml")),
        "sim": str(shipped("sims/nominal.yaml")),
        "socket": str(folder / "levid.sock"),
        "recording": {"faults": str(folder / "faults")},
    }
    plain["limits"] |= limits
    file = folder / "rig.yaml"
    file.write_text(yaml.safe_dump(plain))
    return file
