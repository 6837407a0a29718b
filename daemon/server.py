"""The control socket: one JSON object a line, answered by threads that the loop never waits for."""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_LONGEST_LINE = 1 << 20
_MOST_CLIENTS = 16
_WAITING_CLIENTS = 128
_TIMEOUT_S = 10.0
_BACK_OFF_S = 0.1

# A request's handler: takes the request and a function that sends a line before the answer.
Send = Callable[[Mapping[str, Any]], None]
Handler = Callable[[Mapping[str, Any], Send], Mapping[str, Any]]


class _GoneError(Exception):
    """The client does not take its answer."""


class ServerError(Exception):
    """A control socket that cannot be opened."""


class Server:
    """Answers `{"op": NAME, ...}` with `{"ok": true, ...}` or `{"ok": false, "error": ...}`.

    The socket belongs to the user (and group) that runs the daemon; nobody else may connect. A
    client that sends nonsense, nothing, or vanishes costs its own connection only.
    """

    def __init__(self, path: Path, handlers: Mapping[str, Handler]) -> None:
        self._path, self._handlers = path, dict(handlers)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._clients = threading.BoundedSemaphore(_MOST_CLIENTS)
        self._closed = threading.Event()

    def start(self) -> None:
        """Open the socket and answer from now on; raises ServerError."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True, mode=0o750)
            if self._path.exists():
                if not self._path.is_socket():
                    raise ServerError(f"{self._path}: expected a socket or nothing, found a file")
                if _answers(self._path):
                    raise ServerError(f"{self._path}: another daemon answers here already")
                self._path.unlink()
            self._socket.bind(str(self._path))
            self._path.chmod(0o660)
            self._socket.listen(_WAITING_CLIENTS)
        except OSError as error:
            raise ServerError(f"{self._path}: cannot open the control socket: {error}") from None
        threading.Thread(target=self._accept, name="levid-server", daemon=True).start()

    def close(self) -> None:
        """Stop answering and remove the socket."""
        self._closed.set()
        self._socket.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                if self._closed.wait(_BACK_OFF_S):
                    return
                continue  # out of file descriptors, say: it passes
            if not self._clients.acquire(blocking=False):
                connection.close()
                continue
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            connection.settimeout(_TIMEOUT_S)
            with connection, connection.makefile("rwb") as stream:

                def send(answer: Mapping[str, Any]) -> None:
                    try:
                        stream.write(json.dumps(answer).encode() + b"\n")
                        stream.flush()
                    except (OSError, ValueError) as error:
                        raise _GoneError(str(error)) from None

                while line := stream.readline(_LONGEST_LINE + 1):
                    if len(line) > _LONGEST_LINE:
                        send(_refusal(f"expected at most {_LONGEST_LINE} bytes a request"))
                        return
                    send(self._answer(line, send))
        except (OSError, ValueError, _GoneError):
            return  # the client is gone, or too slow to be worth waiting for
        finally:
            self._clients.release()

    def _answer(self, line: bytes, send: Send) -> Mapping[str, Any]:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            return _refusal("expected one JSON object a line")
        op = request.get("op") if isinstance(request, dict) else None
        handler = self._handlers.get(op) if isinstance(op, str) else None
        if handler is None:
            return _refusal(
                f"op: expected one of {', '.join(sorted(self._handlers))}, found {op!r}"
            )
        try:
            return {"ok": True, **handler(request, send)}
        except _GoneError:
            raise
        except Exception as error:  # noqa: BLE001 - whatever a request does, the daemon flies on
            return _refusal(str(error) or type(error).__name__)


def default_socket() -> Path:
    """Return where the control socket lies unless the rig says otherwise."""
    runtime = os.environ.get("RUNTIME_DIRECTORY") or os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        return Path(runtime) / "levid.sock"
    return Path("/tmp") / f"levid-{os.getuid()}" / "levid.sock"


def _refusal(error: str) -> dict[str, Any]:
    return {"ok": False, "error": error}


def _answers(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except OSError:
            return False
        return True
