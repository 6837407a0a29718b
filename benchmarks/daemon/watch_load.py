"""Measure the processor time of `levid watch` and what it adds to that of the supervisor.

The screen updates five times a second in a pseudo-terminal, while the platform flies. Periods with
and without the screen alternate; the supervisor's time with the screen is compared with that
without.
"""

from __future__ import annotations

import fcntl
import os
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.benchmarks.harness.processor_time import processor_time_s
from levid.benchmarks.harness.running_daemon import Daemon, loopback_rig, running

SIZES = ((80, 24), (160, 50))
_MOST = 5.0
"""Limit of the screen in percent of a processor."""
_STARTING_S, _SETTLED_S = 60.0, 2.0
_LIMITS = {"late_cycles": 10_000, "late_in_window": 1_000_000, "stall_s": 20}


def measure(quick: bool) -> Iterator[Figure]:
    """Fly, watch, and yield the figures."""
    period_s, pairs = (6.0, 2) if quick else (20.0, 5)
    with tempfile.TemporaryDirectory() as name:
        file = loopback_rig(Path(name), **_LIMITS)
        with running(file, Path(name) / "levid.sock") as daemon:
            daemon.ask("levitate", levitate={"check_coils": False})
            for size in SIZES:
                yield from _of_size(daemon, size, period_s, pairs)
            daemon.land()


def _of_size(
    daemon: Daemon, size: tuple[int, int], period_s: float, pairs: int
) -> Iterator[Figure]:
    supervisor = daemon.pids["supervisor"]
    screen, added = list[float](), list[float]()
    for _ in range(pairs):
        alone = _percent((supervisor,), period_s)[0]
        with _watch(daemon.rig_file, size) as watch:
            shown, watched = _percent((watch.pid, supervisor), period_s)
        screen.append(shown)
        added.append(watched - alone)
    key, label = f"{size[0]}x{size[1]}", f"{size[0]} x {size[1]}"
    target = Target(most=_MOST)
    yield Figure(f"watch_{key}", median(screen), "%", f"levid watch, {label}", target=target)
    yield Figure(f"added_{key}", median(added), "%", f"added to the supervisor, {label}")


def _percent(pids: tuple[int, ...], period_s: float) -> list[float]:
    """Return the processor time of processes in percent of one processor."""
    begun_s, before = time.monotonic(), [processor_time_s(pid) for pid in pids]
    time.sleep(period_s)
    passed_s = time.monotonic() - begun_s
    return [
        100.0 * (processor_time_s(pid) - b) / passed_s for pid, b in zip(pids, before, strict=True)
    ]


@contextmanager
def _watch(rig_file: Path, size: tuple[int, int]) -> Iterator[subprocess.Popen[bytes]]:
    """Run `levid watch` in a pseudo-terminal of this size, once it shows coils; drop its output."""
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", size[1], size[0], 0, 0))
    command = [sys.executable, "-m", "levid.cli.main", "watch", "--rig", str(rig_file)]
    env = {**os.environ, "TERM": "xterm-256color", "LANG": "C.UTF-8"}
    process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=env)
    os.close(theirs)
    painted = threading.Event()
    threading.Thread(target=_drop, args=(ours, painted), daemon=True).start()
    try:
        if not painted.wait(_STARTING_S):
            raise TimeoutError(f"levid watch painted nothing in {_STARTING_S:g} s")
        time.sleep(_SETTLED_S)
        yield process
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()


def _drop(terminal: int, painted: threading.Event) -> None:
    """Read the output; set `painted` when coils are on the screen."""
    try:
        while data := os.read(terminal, 65_536):
            if b"coils" in data:
                painted.set()
    except OSError:  # the last process closed it
        os.close(terminal)


if __name__ == "__main__":
    benchmark_runner.run("Watching", measure)
