"""A disk that has something else to do: a process that writes and waits until it is down."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from levid.benchmarks.harness.child_processes import started

LEAST_MIB_S = 20.0
"""Some ten times of what the recorder writes at 10 kHz: below that the disk is hardly busy."""
_BLOCKS = 16
_IN_MEMORY = ("tmpfs", "ramfs")
_WRITER = f"""
import os, sys
block = os.urandom(1 << 20)
with open(sys.argv[1], "wb", buffering=0) as file:
    while True:
        file.seek(0)
        for _ in range({_BLOCKS}):
            file.write(block)
        os.fsync(file.fileno())
        os.write(1, b"x")
"""


class NotBusyError(Exception):
    """The disk had less to do than was meant."""


@dataclass(frozen=True)
class Writer:
    """What writes; `told` holds a byte for each `_BLOCKS` MiB that are down."""

    process: subprocess.Popen[bytes]
    told: Path
    begun_s: float

    @property
    def mib(self) -> int:
        """MiB written and synced so far."""
        return _BLOCKS * self.told.stat().st_size

    def require_busy(self, least_mib_s: float = LEAST_MIB_S) -> None:
        """Raise NotBusyError where it has died, or wrote less than that since it was started."""
        if self.process.poll() is not None:
            raise NotBusyError(f"what kept the disk busy ended with {self.process.returncode}")
        seconds = time.monotonic() - self.begun_s
        if self.mib < least_mib_s * seconds:
            raise NotBusyError(
                f"expected {least_mib_s:g} MiB/s or more on disk beside the flight, found "
                f"{self.mib / seconds:.1f}"
            )


@contextmanager
def busy_disk(folder: Path) -> Iterator[Writer]:
    """Write to the file system of `folder` all the while; raises NotBusyError where it is none."""
    kind = subprocess.run(
        ["stat", "--file-system", "--format=%T", str(folder)],
        check=True, capture_output=True, text=True, timeout=10,
    ).stdout.strip()  # fmt: skip
    if kind in _IN_MEMORY:
        raise NotBusyError(f"{folder} lies in memory ({kind}): no disk is written to there")
    ballast, told = folder / "busy", folder / "busy-told"
    try:
        with (
            told.open("wb") as out,
            started([sys.executable, "-c", _WRITER, str(ballast)], stdout=out) as process,
        ):
            yield Writer(process, told, time.monotonic())
    finally:
        ballast.unlink(missing_ok=True)
        told.unlink(missing_ok=True)
