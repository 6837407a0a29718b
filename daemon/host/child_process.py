"""Start, monitor and end the child processes of the supervisor."""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

_FOR_SUPERVISOR = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_KILL_S = 5.0
_READ_ONLY = fcntl.F_SEAL_WRITE | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK
_CHECK_AFTER_S = 0.5
"""Silence after which the child's waiting time is read from /proc: each reading opens a file."""


class Child:
    """Run one process at a time with a module of levid; it reads the rig from standard input.

    `environment` is added to the environment of this process.
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
        """Start the process in its own process group, so that Ctrl-C skips it. Raises OSError.

        The kernel ends it when the calling thread ends: call this from a thread that stays. SIGINT,
        SIGTERM and SIGHUP wait until the process calls `receive_signals`: systemd sends SIGTERM to
        all processes, and would end one that has not yet said that it ignores the signal.
        """
        # A memory file, not a pipe: writing never waits for the reader.
        rig = os.memfd_create("levid-rig", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            with open(rig, "wb", closefd=False) as file:
                file.write(self._rig_json)
            fcntl.fcntl(rig, fcntl.F_ADD_SEALS, _READ_ONLY)
            os.lseek(rig, 0, os.SEEK_SET)
            with _signals_wait():
                self._process = subprocess.Popen(
                    # -P: do not import modules from the working directory.
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
        """Process id; None if the process has ended, since the system may reuse its id."""
        return self._process.pid if self._process is not None and self.running else None

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def end(self) -> str:
        """How the process ended, as text."""
        code = self._process.poll() if self._process is not None else None
        if code is None:
            return "still running"
        if code < 0:
            return f"killed by {_name_of(-code)}"
        return f"exit code {code}"

    @property
    def waited_s(self) -> float:
        """Time that the main thread waited for a processor, in s; 0 if the kernel does not say."""
        try:
            fields = Path(f"/proc/{self.pid}/schedstat").read_text().split()
            return 1e-9 * int(fields[1])
        except (OSError, IndexError, ValueError):
            return 0.0

    def terminate(self) -> None:
        """Send SIGTERM."""
        if self._process is not None and self.running:
            self._process.terminate()

    def kill(self, wait_s: float = _KILL_S) -> None:
        """Send SIGKILL, which also ends a stopped or hung process; wait at most `wait_s` for it.

        A process that waits for a disk or device in the kernel ends only when that responds.
        """
        if self._process is not None and self.running:
            self._process.kill()
            self.wait(wait_s)

    def wait(self, seconds: float) -> bool:
        """Wait at most `seconds` for the end of the process; return whether it ended."""
        if self._process is None:
            return True
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return False
        return True


def receive_signals() -> None:
    """Receive the signals that have waited since `Child.start`: call it once they are handled."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _FOR_SUPERVISOR)


@contextlib.contextmanager
def _signals_wait() -> Iterator[None]:
    """Block signals of this thread; a process that it starts inherits that."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _FOR_SUPERVISOR)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _name_of(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # only the first and the last real-time signal have names
        return f"signal {number}"


class ChildSilence:
    """Measure the time since a child's last heartbeat, without the time it waited for a processor.

    A child that gets no processor on a busy machine must not be killed for that.
    """

    def __init__(self, child: Child) -> None:
        self._child = child
        self._since_s = self._checked_s = self._waited_s = 0.0

    def begin(self, now_s: float) -> None:
        """Restart at a heartbeat."""
        self._since_s = now_s
        self._checked_s = math.inf

    def passed_s(self, now_s: float) -> float:
        """Return the time since the last heartbeat, in s."""
        silent_s = now_s - self._since_s
        if silent_s < _CHECK_AFTER_S:
            return silent_s
        waited_s = self._child.waited_s
        if self._checked_s > now_s:
            self._checked_s, self._waited_s = now_s, waited_s
        return silent_s - min(max(waited_s - self._waited_s, 0.0), now_s - self._checked_s)


def module_of(name: str) -> str:
    """Return the full name of a daemon module such as `loop.loop_process`."""
    return f"{__package__.rpartition('.')[0]}.{name}"
