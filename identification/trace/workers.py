"""Records spread over workers: this process, processes of this machine, or a cluster's executor.

A worker reads a record once, from its log, and keeps it. What comes back is added up in the order
of the records, so that the result does not depend on who did what, to the last digit.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Protocol, TypeVar

from threadpoolctl import threadpool_limits

from ...config.model import ModelConfig
from ...log.reader import read_log
from ...model.effects.base import Loads
from ..data import IdentificationError
from .record import TraceRecord, trace_record

Answer = TypeVar("Answer")
Task = Callable[[TraceRecord], Answer]

_KEPT = 256


@dataclass(frozen=True)
class Source:
    """Where a record comes from: rows of a log as it was written then, and its session.

    `name` is what it is called among the others; empty for the name that its log has.
    """

    path: Path
    start: int
    stop: int
    span_s: tuple[float, float]
    loads: Loads | None
    written_ns: int
    size: int
    name: str = ""

    @classmethod
    def of(
        cls,
        path: Path,
        start: int,
        stop: int,
        span_s: tuple[float, float],
        loads: Loads | None = None,
        name: str = "",
    ) -> Source:
        """Return rows of the log that is at `path` now, in a session of this span and loads."""
        now = path.stat()
        return cls(path, start, stop, span_s, loads, now.st_mtime_ns, now.st_size, name)


class Workers(Protocol):
    """Who does what to records."""

    def map(self, task: Task[Answer], sources: Sequence[Source]) -> list[Answer]:
        """Return the answers in the order of the sources."""


@dataclass(frozen=True)
class Alone:
    """All in this process."""

    config: ModelConfig

    def map(self, task: Task[Answer], sources: Sequence[Source]) -> list[Answer]:
        """Return the answers in the order of the sources."""
        return [_answer(task, source, self.config.model_dump_json()) for source in sources]


@dataclass(frozen=True)
class Spread:
    """Through an executor of concurrent.futures, or one that behaves like it."""

    config: ModelConfig
    executor: Executor

    def map(self, task: Task[Answer], sources: Sequence[Source]) -> list[Answer]:
        """Return the answers in the order of the sources."""
        text = self.config.model_dump_json()
        # The longest first: nobody waits for a long one that began last.
        order = sorted(range(len(sources)), key=lambda i: sources[i].start - sources[i].stop)
        futures = {i: self.executor.submit(_answer, task, sources[i], text) for i in order}
        return [futures[i].result() for i in range(len(sources))]


@contextmanager
def local_workers(config: ModelConfig, processes: int | None = None) -> Iterator[Workers]:
    """Give workers on this machine: a process a core, or none beside this one for one core."""
    count = processes or len(os.sched_getaffinity(0))
    if count == 1:
        yield Alone(config)
        return
    context = multiprocessing.get_context("forkserver")
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(count, mp_context=context, initializer=_begin) as pool:
        try:
            yield Spread(config, pool)
        except BaseException:
            # What was submitted would be worked through first, for nobody.
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()
            raise


def _begin() -> None:
    """Leave an interrupt to the process that has this worker, and end when that one does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    multiprocessing.connection.wait([sentinel])
    os._exit(1)


@contextmanager
def cluster_workers(config: ModelConfig, address: str) -> Iterator[Workers]:
    """Give the workers of a dask.distributed scheduler; they must see the logs where we do.

    Raises OSError where nobody answers at the address, IdentificationError where it is none.
    """
    from distributed import Client

    try:
        client = Client(address, timeout="10s")
    except ValueError as error:  # of whoever reads addresses there
        raise IdentificationError(
            f"--dask {address}: expected tcp://HOST:PORT, found no address ({error})"
        ) from None
    with client, client.get_executor(pure=False) as executor:
        yield Spread(config, executor)


def _answer(task: Task[Answer], source: Source, model_json: str) -> Answer:
    # Each worker is one core: threads of the linear algebra would only add up in another order.
    with threadpool_limits(1):
        return task(_record(source, model_json))


@lru_cache(maxsize=_KEPT)
def _record(source: Source, model_json: str) -> TraceRecord:
    config = ModelConfig.model_validate_json(model_json)
    record = trace_record(read_log(source.path), config)
    if source.name:
        record = replace(record, experiment=replace(record.experiment, name=source.name))
    places = replace(record.places, span_s=source.span_s, loads=source.loads)
    return replace(record.cut(source.start, source.stop), places=places)
