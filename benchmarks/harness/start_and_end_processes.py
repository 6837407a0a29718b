"""Start processes that end with the benchmark, however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from levid.daemon.host.real_time_scheduling import signal_at_parent_death

_PATIENCE_S = 60.0
"""A daemon may be landing, and its recorder has 30 s to write rows to disk."""


@contextmanager
def started(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command while the body runs; `options` are those of Popen.

    The kernel sends it SIGTERM if this thread, which must be the only one, is killed.
    """
    tied = partial(signal_at_parent_death, os.getpid(), signal.SIGTERM)
    process = subprocess.Popen(command, preexec_fn=tied, **options)  # noqa: PLW1509 - as above
    try:
        yield process
    finally:
        end(process)


def end(process: subprocess.Popen[Any], patience_s: float = _PATIENCE_S) -> None:
    """Terminate a process, and kill it if it does not end."""
    process.terminate()
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(patience_s)  # a timeout here is an error


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Run `count` processes that compute all the time."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()
