"""Start the processes of workers, with what they import and without what they must not run."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import multiprocessing.forkserver
import multiprocessing.resource_tracker
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext

_IMPORTED = f"{__package__}.run_trace"
"""The module whose functions are tasks of the workers."""


def worker_count(asked: int | None) -> int:
    """Return the number of processes that compute: those asked for, or one for each core."""
    return asked or len(os.sched_getaffinity(0))


def begin_imports() -> ForkServerContext:
    """Return the context that starts workers, whose server imports what all of them need.

    It does so in a process of its own, once: call this before imports of this process that take
    long, and both are done at the same time.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([_IMPORTED])
    # The terminal sends Ctrl-C to all processes; only this one acts on it. The others inherit from
    # the server that they do not receive it. The tracker's start would end the block: first it.
    multiprocessing.resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        multiprocessing.forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


@contextmanager
def without_main_module() -> Iterator[None]:
    """Start processes in the `with` body that do not run the user's script again.

    multiprocessing imports the main module in each of them: a script without the check of
    `__name__` would fly and trace once more in every worker. The tasks need nothing of it.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def end_with_parent() -> None:
    """End this worker when its parent process ends."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    multiprocessing.connection.wait([sentinel])
    os._exit(1)
