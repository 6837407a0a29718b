"""Receive the status over one lasting connection, reconnect if it breaks, and send requests."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ...api.output_folder import nearest_existing
from ...daemon.client import Client, DaemonError

_AGAIN_S = 1.0
_DISK_S = 5.0


class DaemonConnection:
    """Watch the daemon in a thread of its own; all callbacks are called in such threads.

    on_status: gets each status. on_lost: gets the reason why none arrives, at each failed attempt.
    on_free: gets the free bytes of the disk of the logs, None if unknown.
    """

    def __init__(
        self,
        find_socket: Callable[[], Path],
        every_s: float,
        on_status: Callable[[Mapping[str, Any]], None],
        on_lost: Callable[[str], None],
        on_free: Callable[[int | None], None],
    ) -> None:
        self._find_socket, self._every_s = find_socket, every_s
        self._on_status, self._on_lost, self._on_free = on_status, on_lost, on_free
        self._closing = threading.Event()
        self._client: Client | None = None
        self._disk: threading.Thread | None = None
        self._disk_s = 0.0
        self._thread = threading.Thread(target=self._run, name="levid-watch", daemon=True)

    def start(self) -> None:
        """Connect, and keep trying while no daemon answers."""
        self._thread.start()

    def close(self) -> None:
        """Disconnect; no callback is called any more."""
        self._closing.set()
        client = self._client
        if client is not None:
            client.disconnect()
        self._thread.join(_AGAIN_S)

    def send(self, op: str, on_answer: Callable[[Mapping[str, Any] | str], None]) -> None:
        """Send a request over a connection of its own, which the stream of statuses cannot delay.

        `on_answer` gets the answer, or as a text why the request failed.
        """

        def run() -> None:
            try:
                with Client(self._find_socket()) as client:
                    answer = client.request(op)
            except (DaemonError, OSError) as error:
                on_answer(str(error))
            else:
                on_answer(answer)

        threading.Thread(target=run, name=f"levid-{op}", daemon=True).start()

    def _run(self) -> None:
        while not self._closing.is_set():
            reason = "the daemon ended the connection"
            try:
                with Client(self._find_socket()) as client:
                    self._client = client
                    client.request("watch", self._receive, every_s=self._every_s)
            except (DaemonError, OSError) as error:
                reason = str(error)
            finally:
                self._client = None
            if not self._closing.is_set():
                self._on_lost(reason)
            self._closing.wait(_AGAIN_S)

    def _receive(self, status: Mapping[str, Any]) -> None:
        if self._closing.is_set():
            raise DaemonError("closing")
        if "pose" not in status:
            raise DaemonError(
                "the daemon runs an older version of levid, without the keys that this screen "
                "shows: restart the daemon, or use 'levid watch --lines'"
            )
        self._on_status(status)
        now_s = time.monotonic()
        # In a thread: a dead mount never answers.
        if now_s - self._disk_s > _DISK_S and (self._disk is None or not self._disk.is_alive()):
            self._disk_s = now_s
            self._disk = threading.Thread(
                target=self._find_free, args=(Path(status["log_folder"]),), daemon=True
            )
            self._disk.start()

    def _find_free(self, folder: Path) -> None:
        try:
            found = os.statvfs(nearest_existing(folder))
        except OSError:
            self._on_free(None)
        else:
            self._on_free(found.f_bavail * found.f_frsize)
