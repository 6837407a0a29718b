"""Start, monitor and restart the live process from the supervisor, which never waits for it."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import secrets
import socket
import time
from collections.abc import Callable
from pathlib import Path

from ...config.base import ConfigError
from ...config.files.atomic_write import write_file
from ...config.rig import RigConfig
from ..api.control_server import Server
from ..host.child_process import Child, ChildSilence, module_of
from ..host.clock_excluding_suspension import ProcessClock
from ..host.peer_credentials import Role
from ..host.rate_limited_log import RateLimitedLog
from ..ipc.shared_memory import SharedMemory

HUNG_S = 10.0
"""Time without a request after which the process is killed, without its waits for a processor."""
_STARTING_S = 60.0
_STABLE_S = 30.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 60.0
"""Pause between two starts; it begins anew after the process ran for `_STABLE_S`."""
TOKEN_FILE = "live-token"


class LiveLink:
    """Keep the live process of a rig running; does nothing for a rig without `live`.

    The process gets a descriptor of the shared memory that is open for reading only, and connected
    sockets of clients of the control server: one with the role STOP, and with `live.control` one
    that may fly.

    Raises:
        ConfigError: the package that serves the stream is not installed.
    """

    def __init__(
        self,
        rig: RigConfig,
        shared: SharedMemory,
        server: Server,
        folder: Path,
        log: Callable[[str], None],
    ) -> None:
        self._live, self._shared, self._server, self._log = rig.live, shared, server, log
        self._rarely = RateLimitedLog(log)
        self._token_file = folder / TOKEN_FILE
        control = rig.live is not None and rig.live.control
        token = secrets.token_urlsafe(32) if control else ""
        self._token = token
        settings = json.dumps({"rig": rig.model_dump(mode="json"), "token": token}).encode()
        one_thread = {"OPENBLAS_NUM_THREADS": "1"}
        self._child = Child("live", module_of("live.live_process"), settings, one_thread)
        self._roles = (Role.STOP, Role.FLY) if control else (Role.STOP,)
        self._silence, self._clock = ChildSilence(self._child), ProcessClock()
        self._used: Callable[[], float | None] = lambda: None
        self._heard_s: float | None = None
        self._running = False  # it has sent a request since its start
        self._started_s, self._pause_s, self._restart_s = 0.0, _FIRST_PAUSE_S, 0.0
        self._started = False
        if self._live is not None and importlib.util.find_spec("foxglove") is None:
            raise ConfigError(
                "live: expected the package foxglove-sdk, which serves the live stream; it is not "
                "installed: pip install 'levid[live]', or remove the section live of RIG.yaml"
            )

    @property
    def pid(self) -> int | None:
        """Process id of the live process, None if it does not run."""
        return self._child.pid

    def watch(self) -> None:
        """Start or restart the process if it does not run; kill it if it hangs."""
        if self._live is None:
            return
        now_s = self._clock.update(time.monotonic())
        self._rarely.flush(now_s)
        if not self._child.running:
            if now_s >= self._restart_s:
                self._start(now_s)
            return
        used_s = self._used()
        if used_s is not None and used_s != self._heard_s:
            self._heard_s, self._running = used_s, True
            self._silence.begin(now_s)
            if now_s - self._started_s > _STABLE_S:
                self._pause_s = _FIRST_PAUSE_S
            return
        limit_s = HUNG_S if self._running else _STARTING_S
        if used_s is None or self._silence.passed_s(now_s) > limit_s:
            self._rarely.line("live", now_s, "killed the live view: it does not respond")
            self._child.kill(0.0)

    def announce(self) -> None:
        """Log the addresses, and write the token to its file. An error is logged as well."""
        if self._live is None:
            return
        line = (
            f"live view: http://127.0.0.1:{self._live.page_port} in a browser, "
            f"ws://127.0.0.1:{self._live.port} in Foxglove and PlotJuggler"
        )
        if self._token:
            try:
                write_file(self._token_file, f"{self._token}\n", mode=0o600)
            except OSError as error:
                line += f"; no control: {self._token_file}: {error.strerror}"
            else:
                line += f"; the token for control is in {self._token_file}"
        self._log(line)

    def end(self) -> None:
        """Kill the process for good, and remove the token."""
        self._child.kill()
        if self._token:
            with contextlib.suppress(OSError):
                self._token_file.unlink()

    def _start(self, now_s: float) -> None:
        if self._started:
            self._rarely.line(
                "live", now_s, f"the live view ended ({self._child.end}) and is restarted"
            )
        self._started = True
        self._started_s = now_s
        self._restart_s = now_s + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
        self._silence.begin(now_s)
        with contextlib.ExitStack() as stack:
            try:
                memory = self._shared.read_only_fd()
                stack.callback(os.close, memory)
                theirs, used = [], []
                for role in self._roles:
                    our, their = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
                    theirs.append(stack.enter_context(their).fileno())
                    used.append(self._server.adopt(our, role))
                self._child.start((memory, os.getpid(), *theirs), (memory, *theirs))
            except OSError as error:
                self._rarely.line("live", now_s, f"cannot start the live view: {error}")
                return
        self._used = used[0]
        self._heard_s, self._running = self._used(), False
