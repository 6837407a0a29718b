"""Keep a disk busy: a process that writes and syncs continuously."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from levid.benchmarks.harness.start_and_end_processes import started

LEAST_MIB_S = 20.0
"""About ten times the recorder's rate at 10 kHz; a slower writer does not load the disk."""
_BLOCKS = 16
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
    """The disk had less to write than intended."""


@dataclass(frozen=True)
class Writer:
    """The writing process; `progress` grows by a byte for each `_BLOCKS` MiB on disk."""

    process: subprocess.Popen[bytes]
    progress: Path
    begun_s: float

    def require_busy(self) -> float:
        """Return MiB/s written and synced since the start; raises NotBusyError if too few."""
        mib_s = _BLOCKS * self.progress.stat().st_size / (time.monotonic() - self.begun_s)
        if self.process.poll() is not None or mib_s < LEAST_MIB_S:
            raise NotBusyError(f"expected {LEAST_MIB_S:g} MiB/s or more on disk, found {mib_s:.1f}")
        return mib_s


@contextmanager
def busy_disk(folder: Path) -> Iterator[Writer]:
    """Write to the file system of `folder`; raises NotBusyError if it is in memory."""
    command = ["stat", "--file-system", "--format=%T", str(folder)]
    kind = subprocess.run(command, check=True, capture_output=True, text=True, timeout=10).stdout
    if kind.strip() in ("tmpfs", "ramfs"):
        raise NotBusyError(f"{folder}: expected a folder on a disk, found {kind.strip()}")
    ballast, progress = folder / "busy", folder / "busy-progress"
    try:
        with (
            progress.open("wb") as out,
            started([sys.executable, "-c", _WRITER, str(ballast)], stdout=out) as process,
        ):
            yield Writer(process, progress, time.monotonic())
    finally:
        ballast.unlink(missing_ok=True)
        progress.unlink(missing_ok=True)
