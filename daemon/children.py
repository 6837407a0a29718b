"""Processes that the supervisor starts, watches, and starts anew."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Sequence

_KILLED_S = 5.0


class Child:
    """One process at a time that runs a module of levid, fed with a rig on standard input."""

    def __init__(self, name: str, module: str, rig_json: bytes) -> None:
        self.name, self._module, self._rig_json = name, module, rig_json
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, arguments: Sequence[object], fds: Sequence[int]) -> None:
        """Start it, in a process group of its own: Ctrl-C is not for it. Raises OSError.

        The kernel ends it with the thread that calls this: call it from the one that stays.
        """
        self._process = subprocess.Popen(
            # -P: what lies in the working directory is nobody's module.
            [sys.executable, "-P", "-m", self._module, *map(str, arguments)],
            stdin=subprocess.PIPE,
            pass_fds=fds,
            process_group=0,
        )
        assert self._process.stdin is not None
        try:
            with self._process.stdin as pipe:
                pipe.write(self._rig_json)
        except BrokenPipeError:
            return  # it is dead already, which is noticed as any death is

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


def module_of(name: str) -> str:
    """Return the full name of a module of this package."""
    return f"{__package__}.{name}"
