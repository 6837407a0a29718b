"""Threads that work on several records, or on several points, at the same time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def record_threads() -> Iterator[Executor]:
    """Yield one thread for each processor; each needs the memory of what it works on.

    BLAS threads inside would compete for the same processors, and the matrices are small.
    """
    processors = len(os.sched_getaffinity(0))
    with threadpool_limits(1), ThreadPoolExecutor(processors) as pool:
        yield pool
