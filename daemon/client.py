"""A client of the control socket."""

from __future__ import annotations

import contextlib
import errno
import json
import socket
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from .api.socket_paths import require_own_folder, socket_path
from .recording.session_logs import FlightResult

__all__ = ["Client", "DaemonError", "NoDaemonError", "socket_path"]

_TIMEOUT_S = 30.0
_AGAIN_S = 0.01
_CLEARING_S = 150.0  # opening buses anew and homing drives takes its time


class DaemonError(Exception):
    """The daemon refused a request, or there is none."""


class NoDaemonError(DaemonError):
    """Nobody answers at the control socket."""


class Client:
    """One connection; a context manager. Requests raise DaemonError when they are refused."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(_TIMEOUT_S)

    def __enter__(self) -> Self:
        """Connect; raises NoDaemonError."""
        try:
            require_own_folder(self._path)
            self._connect()
        except OSError as error:
            self._socket.close()
            if error.errno != errno.EACCES:
                raise NoDaemonError(
                    f"no daemon answers at {self._path} ({error.strerror or error}); start one "
                    "with 'levid run RIG.yaml'"
                ) from None
            raise DaemonError(
                f"{self._path} ({error.strerror}): a daemon may be there, but this user may not "
                "ask it; expected a member of its group (usermod --append --groups levid NAME, "
                "then log in anew) or one of service.allow_users"
            ) from None
        self._stream = self._socket.makefile("rwb")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Disconnect, whoever still holds a part of this: the daemon is to see it at once."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        with contextlib.suppress(OSError):  # what was not sent is not wanted any more
            self._stream.close()
        self._socket.close()

    def _connect(self) -> None:
        give_up_s = time.monotonic() + _TIMEOUT_S
        while True:
            try:
                self._socket.connect(str(self._path))
            except BlockingIOError:  # others are in front: with a timeout the kernel does not wait
                if time.monotonic() > give_up_s:
                    raise
                time.sleep(_AGAIN_S)
            else:
                return

    def request(
        self, op: str, on_line: Callable[[Mapping[str, Any]], None] | None = None, **more: Any
    ) -> dict[str, Any]:
        """Send one request; lines before the answer go to `on_line`."""
        between_s = float(more.get("every_s") or 0.0)  # of a watch
        self._socket.settimeout(_CLEARING_S if op == "clear" else _TIMEOUT_S + between_s)
        try:
            # Whoever may not ask is told so and hung up on, perhaps before this is sent.
            with contextlib.suppress(BrokenPipeError):
                self._stream.write(json.dumps({"op": op, **more}).encode() + b"\n")
                self._stream.flush()
            while line := self._stream.readline():
                answer: dict[str, Any] = json.loads(line)
                if "ok" not in answer:
                    if on_line is not None:
                        on_line(answer)
                    continue
                if not answer["ok"]:
                    raise DaemonError(str(answer.get("error", "refused without a reason")))
                return answer
        except (OSError, ValueError) as error:
            raise DaemonError(f"lost the daemon at {self._path}: {error}") from None
        raise DaemonError(f"the daemon at {self._path} hung up")

    def excite(
        self,
        session: str,
        out: Path,
        report: Callable[[str, float], None],
        rig: str | None = None,
        client_gone: str | None = None,
    ) -> FlightResult:
        """Fly the session of this YAML text, logging into `out` on the daemon's machine.

        With `rig` (YAML text) the daemon refuses unless it runs that very rig. `client_gone` says
        what the flight does if this client dies: go_on or land; as the rig says unless given.
        """
        answer = self.request(
            "excite",
            lambda line: report(str(line.get("step", "")), float(line.get("share", 0.0))),
            session=session,
            out=str(out),
            rig=rig,
            client_gone=client_gone,
        )
        return FlightResult(
            tuple(map(Path, answer["logs"])),
            tuple(map(Path, answer["records"])),
            int(answer["cycles"]),
            int(answer["late"]),
            int(answer["lost"]),
            bool(answer["stopped"]),
            tuple(answer["unjudged_coils"]),
        )
