"""A disk that has something else to do: a process that writes and waits until it is down."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_BLOCKS = 64
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


@contextmanager
def busy_disk(folder: Path) -> Iterator[Callable[[], int]]:
    """Write to the file system of `folder` all the while; give what tells how many MiB are down."""
    ballast, told = folder / "busy", folder / "busy-told"
    with told.open("wb") as out:
        writer = subprocess.Popen([sys.executable, "-c", _WRITER, str(ballast)], stdout=out)
    try:
        yield lambda: _BLOCKS * told.stat().st_size
    finally:
        writer.kill()
        writer.wait()
        ballast.unlink(missing_ok=True)
        told.unlink()
