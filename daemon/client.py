"""Send requests to the daemon over its control socket."""

from __future__ import annotations

import contextlib
import errno
import json
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from .api.socket_paths import require_own_folder, socket_path
from .recording.log_metadata import FlightResult

__all__ = ["Client", "DaemonError", "NoDaemonError", "socket_path"]

_TIMEOUT_S = 30.0
_RETRY_S = 0.01
_CLEAR_S = 150.0  # `clear` reopens buses and homes drives


class DaemonError(Exception):
    """Report that the daemon refused a request, or does not respond."""


class NoDaemonError(DaemonError):
    """Report that no daemon listens at the control socket."""


class Client:
    """Connect to a daemon as a context manager; refused requests raise DaemonError."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(_TIMEOUT_S)

    def __enter__(self) -> Self:
        """Connect; raises NoDaemonError, or DaemonError if this user has no access."""
        try:
            require_own_folder(self._path)
            self._connect()
        except OSError as error:
            self._socket.close()
            if error.errno != errno.EACCES:
                absent = error.errno in (errno.ENOENT, errno.ECONNREFUSED)
                why = "" if absent else f" ({error.strerror or error})"
                raise NoDaemonError(
                    f"no daemon runs at {self._path}{why}: start one with `levid run RIG.yaml`"
                ) from None
            raise DaemonError(
                f"{self._path} ({error.strerror}): this user has no access to the daemon; join its "
                "group (usermod --append --groups levid NAME, then log in again) or add the user "
                "to service.allow_users in RIG.yaml"
            ) from None
        self._stream = self._socket.makefile("rwb")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Disconnect at once, even if other objects still hold the socket or its stream."""
        self.disconnect()
        with contextlib.suppress(OSError):  # unsent bytes are discarded
            self._stream.close()
        self._socket.close()

    def disconnect(self) -> None:
        """Disconnect, from any thread; a request that waits for its answer raises DaemonError."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def _connect(self) -> None:
        deadline_s = time.monotonic() + _TIMEOUT_S
        while True:
            try:
                self._socket.connect(str(self._path))
            except (
                BlockingIOError
            ):  # the queue is full: with a timeout set, the kernel does not wait
                if time.monotonic() > deadline_s:
                    raise
                time.sleep(_RETRY_S)
            else:
                return

    def request(
        self, op: str, on_line: Callable[[Mapping[str, Any]], None] | None = None, **more: Any
    ) -> dict[str, Any]:
        """Send a request with the keys `more`; return its answer. Raises DaemonError.

        Lines before the answer are passed to `on_line`.
        """
        interval_s = float(more.get("every_s") or 0.0)  # of a watch
        self._socket.settimeout(_CLEAR_S if op == "clear" else _TIMEOUT_S + interval_s)
        try:
            # A user without access gets a refusal and is disconnected, perhaps before this is sent.
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
                    raise DaemonError(str(answer.get("error", "the daemon gave no reason")))
                return answer
        except (OSError, ValueError) as error:
            raise DaemonError(f"lost the connection to {self._path}: {error}") from None
        raise DaemonError(f"the daemon at {self._path} closed the connection")

    def excite(
        self,
        session: str,
        out: Path,
        report: Callable[[str, float], None],
        rig: str | None = None,
        client_gone: str | None = None,
        override: Sequence[str] = (),
        note: str = "",
        warn: Callable[[str], None] | None = None,
    ) -> FlightResult:
        """Fly the session given as YAML text, logging into `out` on the daemon's machine.

        `report` gets the step name and the fraction flown. With `rig` (YAML text) the daemon
        refuses if it runs another rig. `client_gone`: go_on or land, if this client disconnects;
        default: service.client_gone of the rig. override: checks before lift-off whose failure is
        accepted. note: of the user, for the logs. warn: gets each warning of the flight, such as a
        log that was deleted. Raises DaemonError.
        """
        warned: list[str] = []

        def on_line(line: Mapping[str, Any]) -> None:
            report(str(line.get("step", "")), float(line.get("share", 0.0)))
            text = str(line.get("warning", ""))
            if warn is not None and text and text not in warned:
                warned.append(text)
                warn(text)

        answer = self.request(
            "excite",
            on_line,
            session=session,
            out=str(out),
            rig=rig,
            client_gone=client_gone,
            override=list(override),
            **({"note": note} if note else {}),
        )
        return FlightResult(
            tuple(map(Path, answer["logs"])),
            tuple(map(Path, answer["records"])),
            int(answer["cycles"]),
            int(answer["late"]),
            int(answer["lost"]),
            bool(answer["stopped"]),
            tuple(answer["unjudged_coils"]),
            str(answer["coil_check"]),
        )
