"""Save the coil heat to disk, so that a restarted daemon continues with it."""

from __future__ import annotations

import contextlib
import json
import math
import os
import threading
import time
import urllib.parse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config.files.atomic_write import empty_file, write_file
from ...config.files.folders import make_folder
from ...config.files.reading import read_json
from ...config.rig import RigConfig
from ...config.runtime.user_folders import temporary_folder, xdg_folder

INTERVAL_S = 5.0
_COLD = 0.01
"""Fraction of the heat limit below which no file is written."""
_MAX_BYTES = 1 << 20
_BOOT = Path("/proc/sys/kernel/random/boot_id")


class HeatFile:
    """Save `heat` (C,), in N^2, of cycle `heated` (1,); does nothing if the rig has no heat limit.

    An unreadable file means that the coils are at the limit; without a file they are cold. A thread
    writes the file: a disk that hangs must not delay the supervisor.
    """

    def __init__(
        self,
        rig: RigConfig,
        folder: Path,
        heat: NDArray[np.float64],
        heated: NDArray[np.float64],
        log: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._path = folder / f"heat-{urllib.parse.quote(rig.name, safe='')}.json"
        self._limits, self._heat, self._heated, self._log = rig.limits, heat, heated, log
        self._limit_n2 = (rig.limits.coil_rms_n or math.inf) ** 2
        self._failure_logged = False
        self._saved: tuple[float, dict[str, Any], NDArray[np.float64]] | None = None
        """Contents of the file: cycle, time, heat."""
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="levid-heat", daemon=True)

    def start(self) -> None:
        """Load the heat that the last daemon saved, cooled down since; save it from now on."""
        if math.isinf(self._limit_n2):
            return
        try:
            with contextlib.suppress(FileNotFoundError):
                self._heat[:] = self._load()
            self._saved = math.nan, _now(), self._heat.copy()
        except (OSError, ValueError, TypeError, KeyError) as error:
            self._heat[:] = self._limit_n2
            self._log(
                f"{self._path}: cannot read the coil heat, assuming that all coils are at their "
                f"heat limit: {error}"
            )
        self._thread.start()

    def close(self, wait_s: float) -> None:
        """Write the file a last time; wait at most `wait_s`."""
        self._end.set()
        if self._thread.ident is not None:
            self._thread.join(wait_s)

    def save(self) -> bool:
        """Write the file; return whether it holds the present heat."""
        cycle, now, heat = float(self._heated[0]), _now(), self._heat.copy()
        if self._saved is not None and self._saved[0] == cycle:
            return True  # no cycles since: cooling follows from the time in the file
        try:
            make_folder(self._path.parent)
            write_file(self._path, json.dumps({**now, "heat_n2": heat.tolist()}))
        except OSError as error:
            consequence = ""
            if self._saved_is_colder(heat, now):
                try:
                    empty_file(self._path)  # needs no disk space; unreadable means unknown
                    self._saved = None
                except OSError:
                    consequence = "; after a restart the daemon underestimates it"
            if not self._failure_logged:
                self._log(f"cannot save the coil heat: {error}{consequence}")
            self._failure_logged = True
            return False
        self._failure_logged = False
        self._saved = cycle, now, heat
        return True

    def _load(self) -> NDArray[np.float64]:
        found: dict[str, Any] = read_json(self._path, _MAX_BYTES)
        heat = np.array(found["heat_n2"], dtype=np.float64)
        max_n2 = (2.0 * self._limits.coil_n) ** 2
        if heat.shape != self._heat.shape or not np.all((heat >= 0.0) & (heat <= max_n2)):
            raise ValueError(f"heat_n2: expected {self._heat.size} numbers from 0 to {max_n2:g}")
        return self._cooled(heat, found, _now())

    def _cooled(
        self, heat: NDArray[np.float64], then: dict[str, Any], now: dict[str, Any]
    ) -> NDArray[np.float64]:
        # Within one boot use the uptime, which cannot be set; otherwise the time of day.
        clock = "uptime_s" if now["boot"] and then["boot"] == now["boot"] else "time_s"
        passed_s = max(float(now[clock]) - float(then[clock]), 0.0)
        return np.asarray(heat * math.exp(-passed_s / self._limits.coil_time_constant_s))

    def _run(self) -> None:
        write = True  # update an old file once, even if the coils are cold
        while True:
            ended = self._end.wait(INTERVAL_S)
            hot = bool(self._heat.max(initial=0.0) > _COLD * self._limit_n2)
            if hot or write:
                write = not self.save() or hot
            if ended:
                return

    def _saved_is_colder(self, heat: NDArray[np.float64], now: dict[str, Any]) -> bool:
        """Return whether the present file, cooled down until `now`, is below `heat`."""
        if self._saved is None:
            return True
        _, then, before = self._saved
        return bool(np.any(heat > self._cooled(before, then, now) + _COLD * self._limit_n2))


def state_folder() -> Path:
    """Return the folder for files that outlast the daemon: of the service, otherwise the user.

    A user without a home folder has one in /tmp.
    """
    state = os.environ.get("STATE_DIRECTORY")
    if state:
        return Path(state.split(":", maxsplit=1)[0])
    folder = xdg_folder("XDG_STATE_HOME", ".local/state")
    return temporary_folder() / "state" if folder is None else folder / "levid"


def _now() -> dict[str, Any]:
    try:
        boot = _BOOT.read_text().strip()
    except OSError:
        boot = ""
    return {
        "boot": boot,
        "uptime_s": time.clock_gettime(time.CLOCK_BOOTTIME),
        "time_s": time.time(),
    }
