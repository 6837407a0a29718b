"""Processes that a benchmark starts: they end with it, however it ends, and within bounds."""

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
"""A daemon may be landing, and its recorder may have 30 s to bring rows to disk."""


@contextmanager
def started(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command for as long as the body takes; `options` are those of Popen.

    The kernel sends it SIGTERM should this thread, which has to be the only one, die without a
    word.
    """
    tied = partial(signal_at_parent_death, os.getpid(), signal.SIGTERM)
    process = subprocess.Popen(command, preexec_fn=tied, **options)  # noqa: PLW1509 - as above
    try:
        yield process
    finally:
        end(process)


def end(process: subprocess.Popen[Any], patience_s: float = _PATIENCE_S) -> None:
    """Ask a process to end, and kill it where it does not."""
    process.terminate()
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(patience_s)  # in the kernel it may hang for longer: then that is said


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Have so many processes compute all the time."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()
