"""Processes that the supervisor starts, watches, and starts anew."""

from __future__ import annotations

import fcntl
import math
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

_KILLED_S = 5.0
_READ_ONLY = fcntl.F_SEAL_WRITE | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK
_LOOK_S = 0.5
"""A silence from which on it is asked what a child does: each question is a file."""


class Child:
    """One process at a time that runs a module of levid, fed with a rig on standard input.

    `environment` is what it has beside that of this process.
    """

    def __init__(
        self,
        name: str,
        module: str,
        rig_json: bytes,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.name, self._module, self._rig_json = name, module, rig_json
        self._environment = environment or {}
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, arguments: Sequence[object], fds: Sequence[int]) -> None:
        """Start it, in a process group of its own: Ctrl-C is not for it. Raises OSError.

        The kernel ends it with the thread that calls this: call it from the one that stays.
        """
        # A file and not a pipe: nobody waits until it is read.
        rig = os.memfd_create("levid-rig", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            with open(rig, "wb", closefd=False) as file:
                file.write(self._rig_json)
            fcntl.fcntl(rig, fcntl.F_ADD_SEALS, _READ_ONLY)
            os.lseek(rig, 0, os.SEEK_SET)
            self._process = subprocess.Popen(
                # -P: what lies in the working directory is nobody's module.
                [sys.executable, "-P", "-m", self._module, *map(str, arguments)],
                stdin=rig,
                pass_fds=fds,
                process_group=0,
                env={**os.environ, **self._environment},
            )
        finally:
            os.close(rig)

    @property
    def pid(self) -> int | None:
        """The process, None where there is none: a number of before may be another's by now."""
        return self._process.pid if self._process is not None and self.running else None

    @property
    def running(self) -> bool:
        """Whether it is there."""
        return self._process is not None and self._process.poll() is None

    @property
    def end(self) -> str:
        """How it ended, in words."""
        code = self._process.poll() if self._process is not None else None
        if code is None:
            return "it runs"
        if code < 0:
            return f"killed by {_name_of(-code)}"
        return f"exit code {code}"

    @property
    def waited_s(self) -> float:
        """For how long it was ready to run and got no processor, in s; 0 where nothing says so."""
        try:
            told = Path(f"/proc/{self.pid}/schedstat").read_text().split()
            return 1e-9 * int(told[1])  # its main thread's
        except (OSError, IndexError, ValueError):
            return 0.0

    def terminate(self) -> None:
        """Ask it to end, as it is able to at the moment."""
        if self._process is not None and self.running:
            self._process.terminate()

    def kill(self, wait_s: float = _KILLED_S) -> None:
        """End it at once, stopped or hung as it may be; wait so long until it is gone.

        One that waits for a disk or a device in the kernel is not gone before that has answered.
        """
        if self._process is not None and self.running:
            self._process.kill()
            self.wait(wait_s)

    def wait(self, seconds: float) -> bool:
        """Wait for its end; return whether it came."""
        if self._process is None:
            return True
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return False
        return True


def _name_of(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # real-time signals have no names but the first and the last
        return f"signal {number}"


class ChildSilence:
    """How long a child gave no sign of life, not counting the time in which it could not.

    A machine with too much to do keeps it from the processors: that is no reason to end it.
    """

    def __init__(self, child: Child) -> None:
        self._child = child
        self._since_s = self._looked_s = self._waited_s = 0.0

    def begin(self, now_s: float) -> None:
        """Count from a sign of life on."""
        self._since_s = now_s
        self._looked_s = math.inf

    def passed_s(self, now_s: float) -> float:
        """Return how long it has been silent, in s."""
        silent_s = now_s - self._since_s
        if silent_s < _LOOK_S:
            return silent_s
        waited_s = self._child.waited_s
        if self._looked_s > now_s:
            self._looked_s, self._waited_s = now_s, waited_s
        return silent_s - min(max(waited_s - self._waited_s, 0.0), now_s - self._looked_s)


def module_of(name: str) -> str:
    """Return the full name of a module of the daemon, such as `loop.loop_process`."""
    return f"{__package__.rpartition('.')[0]}.{name}"
