"""Reads RIG.yaml again while the daemon runs, and looks up whom it lets in."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from ...config.rig import RigConfig, load_rig
from ..host.access_control import Access

Ready = Callable[[RigConfig, Access], None]


class RigReader:
    """Has a thread of its own: names may be asked of another machine, and a mount may hang.

    `ready` or `failed` is called from there, once for each reading. What is asked for during one
    is one more, after it.
    """

    def __init__(self, rig_file: Path, ready: Ready, failed: Callable[[str], None]) -> None:
        self._rig_file, self._ready, self._failed = rig_file, ready, failed
        self._asked = threading.Event()

    def start(self) -> None:
        """Read when asked from now on."""
        threading.Thread(target=self._run, name="levid-reload", daemon=True).start()

    def ask(self) -> None:
        """Have the file read; returns at once. Not for signal handlers: it takes a lock."""
        self._asked.set()

    def _run(self) -> None:
        while True:
            self._asked.wait()
            self._asked.clear()
            try:
                rig = load_rig(self._rig_file)
                access = Access(rig.service)
            except Exception as error:  # noqa: BLE001 - whatever it is, the daemon goes on
                self._failed(str(error) or type(error).__name__)
            else:
                self._ready(rig, access)
