"""Reload RIG.yaml and its access rights while the daemon runs."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from ...config.rig import RigConfig, load_rig
from ..host.peer_credentials import Access

Ready = Callable[[RigConfig, Access], None]


class RigReader:
    """Load the file in a thread: looking up users may use the network, and a mount may hang.

    The thread calls `ready` or `failed` after each load. A request during a load starts another one
    after it.
    """

    def __init__(self, rig_file: Path, ready: Ready, failed: Callable[[str], None]) -> None:
        self._rig_file, self._ready, self._failed = rig_file, ready, failed
        self._requested = threading.Event()

    def start(self) -> None:
        """Start the thread."""
        threading.Thread(target=self._run, name="levid-reload", daemon=True).start()

    def request(self) -> None:
        """Request a load; returns at once. Not for signal handlers: it takes a lock."""
        self._requested.set()

    def _run(self) -> None:
        while True:
            self._requested.wait()
            self._requested.clear()
            try:
                rig = load_rig(self._rig_file)
                access = Access(rig.service)
            except Exception as error:  # noqa: BLE001 - an invalid file must not end the daemon
                self._failed(str(error) or type(error).__name__)
            else:
                self._ready(rig, access)
