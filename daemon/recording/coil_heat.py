"""How hot the coils are, kept on disk: a daemon that follows another finds them as hot."""

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

from ...config.rig import RigConfig

EVERY_S = 5.0
_COLD = 0.01
"""Share of what a coil stands, as heat, that is not worth a file."""
_MOST_BYTES = 1 << 20
_BOOT = Path("/proc/sys/kernel/random/boot_id")


class HeatFile:
    """Keeps `heat` (C,), in N^2, of cycle `heated` (1,); of a rig that does not limit it, nothing.

    A file whose heat is not known stands for the most that the rig allows; without any coils are
    cold. Writing has a thread of its own: a disk that hangs is not to hold up who watches over the
    loop.
    """

    def __init__(
        self,
        rig: RigConfig,
        folder: Path,
        heat: NDArray[np.float64],
        heated: NDArray[np.float64],
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._path = folder / f"heat-{urllib.parse.quote(rig.name, safe='')}.json"
        self._limits, self._heat, self._heated, self._say = rig.limits, heat, heated, say
        self._limit_n2 = (rig.limits.coil_rms_n or math.inf) ** 2
        self._told = False
        self._kept: tuple[float, dict[str, Any], NDArray[np.float64]] | None = None
        """What the file says: its cycle, when, and the heat."""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="levid-heat", daemon=True)

    def start(self) -> None:
        """Take over what a daemon before this one left, cooled down since; keep it from now on."""
        if math.isinf(self._limit_n2):
            return
        try:
            with contextlib.suppress(FileNotFoundError):
                self._heat[:] = self._left()
            self._kept = math.nan, _now(), self._heat.copy()
        except (OSError, ValueError, TypeError, KeyError) as error:
            self._heat[:] = self._limit_n2
            self._say(
                f"{self._path}: not a file of coils' heat, they are taken to be as hot as they "
                f"may be, and cool down from now on: {error}"
            )
        self._thread.start()

    def close(self, wait_s: float) -> None:
        """Write it a last time; wait so long for that."""
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join(wait_s)

    def _left(self) -> NDArray[np.float64]:
        with self._path.open("rb") as file:
            found: dict[str, Any] = json.loads(file.read(_MOST_BYTES))
        heat = np.array(found["heat_n2"], dtype=np.float64)
        most_n2 = (2.0 * self._limits.coil_n) ** 2
        if heat.shape != self._heat.shape or not np.all((heat >= 0.0) & (heat <= most_n2)):
            raise ValueError(f"expected {self._heat.size} numbers from 0 to {most_n2:g}")
        return self._cooled(heat, found, _now())

    def _cooled(
        self, heat: NDArray[np.float64], then: dict[str, Any], now: dict[str, Any]
    ) -> NDArray[np.float64]:
        # Since the last boot by the clock that nobody sets, else by the time of day. A boot without
        # a number may be any.
        clock = "uptime_s" if now["boot"] and then["boot"] == now["boot"] else "time_s"
        passed_s = max(float(now[clock]) - float(then[clock]), 0.0)
        return np.asarray(heat * math.exp(-passed_s / self._limits.coil_time_constant_s))

    def _run(self) -> None:
        kept = True  # a file of before is made anew once, hot or cold
        while True:
            over = self._over.wait(EVERY_S)
            hot = bool(self._heat.max(initial=0.0) > _COLD * self._limit_n2)
            if hot or kept:
                kept = not self._write() or hot
            if over:
                return

    def _write(self) -> bool:
        """Return whether the file says how hot the coils are."""
        cycle, now, heat = float(self._heated[0]), _now(), self._heat.copy()
        if self._kept is not None and self._kept[0] == cycle:
            return True  # no cycle counted what they cooled down since: the file's time does
        new = self._path.with_suffix(".new")
        try:
            new.parent.mkdir(parents=True, exist_ok=True)
            with new.open("w") as file:
                file.write(json.dumps({**now, "heat_n2": heat.tolist()}))
                file.flush()
                os.fsync(file.fileno())
            new.replace(self._path)
        except OSError as error:
            with contextlib.suppress(OSError):
                new.unlink(missing_ok=True)
            follows = ""
            if self._colder_than(heat, now):
                try:
                    self._path.write_bytes(b"")  # takes no room, and says that nobody knows
                    self._kept = None
                except OSError:
                    follows = "; the next daemon takes them for colder than they are"
            if not self._told:
                self._say(f"the coils' heat is not kept: {error}{follows}")
            self._told = True
            return False
        self._told = False
        self._kept = cycle, now, heat
        return True

    def _colder_than(self, heat: NDArray[np.float64], now: dict[str, Any]) -> bool:
        """Return whether the file that is there would have coils taken for colder than `heat`."""
        if self._kept is None:
            return True
        _, then, before = self._kept
        return bool(np.any(heat > self._cooled(before, then, now) + _COLD * self._limit_n2))


def state_folder() -> Path:
    """Return where a daemon keeps what outlasts it: of its service, else of its user."""
    state = os.environ.get("STATE_DIRECTORY")
    if state:
        return Path(state.split(":", maxsplit=1)[0])
    home = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(home) / "levid"


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
