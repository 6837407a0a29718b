"""Memory pressure: processes in a memory group with one that reads more than the group may hold.

All that they allocate or read then waits for pages to be given up, which the kernel counts. A group
needs the right to make one.

On its own: `python memory_pressure.py FILE GROUP` joins the group, says so on a line, and reads
the file over and over, until whoever began it is gone.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

_GROUPS = (
    (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", ":memory:"),
    (Path("/sys/fs/cgroup"), "memory.high", "0::"),
)
_GROUP_BYTES, _FILE_BYTES = 64 << 20, 128 << 20
_BEGINS_S = 60.0
_PAGE = mmap.PAGESIZE


class NoPressureError(Exception):
    """Nothing was held, or read."""


@contextlib.contextmanager
def pressed(pids: Sequence[int], folder: Path) -> Iterator[None]:
    """Have these processes short of memory.

    Raises:
        NoPressureError: there is none.
    """
    with contextlib.ExitStack() as stack:
        group = stack.enter_context(_group())
        if group is None:
            raise NoPressureError("no right to a memory group")
        ballast = stack.enter_context(_on_disk(folder / "ballast"))
        try:
            for pid in pids:
                (group / "cgroup.procs").write_text(str(pid))
        except OSError as error:
            raise NoPressureError(f"{group}: {error.strerror}") from None
        stack.enter_context(_running(__file__, str(ballast), str(group)))
        yield


def can_press() -> bool:
    """Return whether this process may make a memory group."""
    with _group() as group:
        return group is not None


def stalled_us() -> int:
    """Return for how long some process has waited for memory, in us; 0 where nobody counts."""
    with contextlib.suppress(OSError):
        line = Path("/proc/pressure/memory").read_text().splitlines()[0]
        return int(line.rpartition("total=")[2])
    return 0


@contextlib.contextmanager
def _group() -> Iterator[Path | None]:
    """Make a memory group, None without the right to; take it away, its processes sent home."""
    for root, limit, line in _GROUPS:
        group = root / f"levid-benchmark-{os.getpid()}"
        with contextlib.suppress(OSError):
            group.mkdir()
            if (group / limit).exists():
                (group / limit).write_text(str(_GROUP_BYTES))
                home = root / _home(line)
                break
            group.rmdir()
    else:
        yield None
        return
    try:
        yield group
    finally:
        for pid in (group / "cgroup.procs").read_text().split():
            with contextlib.suppress(OSError):  # it has ended meanwhile
                (home / "cgroup.procs").write_text(pid)
        for _ in range(50):  # who was just killed is in it for a moment more
            with contextlib.suppress(OSError):
                group.rmdir()
                break
            time.sleep(0.05)


def _home(line: str) -> str:
    """Return the group that this process is in, and so what it has started."""
    found = [one for one in Path("/proc/self/cgroup").read_text().splitlines() if line in one]
    return found[0].rpartition(":")[2].lstrip("/") if found else ""


@contextlib.contextmanager
def _on_disk(path: Path) -> Iterator[Path]:
    """Write a file that is in nobody's memory."""
    try:
        with path.open("wb") as file:
            for _ in range(_FILE_BYTES >> 20):
                file.write(os.urandom(1 << 20))
            file.flush()
            os.fsync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        yield path
    finally:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def _running(*command: str) -> Iterator[str]:
    """Run a Python file until it is left, once it has said something; give that line."""
    process = subprocess.Popen(
        [sys.executable, *command], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        assert process.stdout is not None
        ready = select.select([process.stdout], [], [], _BEGINS_S)[0]
        said = process.stdout.readline().decode().strip() if ready else ""
        if not said:
            raise NoPressureError(f"{Path(command[0]).name} says nothing")
        yield said
    finally:
        process.kill()
        process.communicate()


def _read_for_ever(path: Path, group: Path) -> None:
    parent = os.getppid()
    Path("/proc/self/oom_score_adj").write_text("1000")  # where memory is short it goes first
    (group / "cgroup.procs").write_text(str(os.getpid()))
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as pages:
        print("reading", flush=True)
        while os.getppid() == parent:
            for at in range(0, len(pages), _PAGE):
                pages[at]


if __name__ == "__main__":
    _read_for_ever(Path(sys.argv[1]), Path(sys.argv[2]))
