"""Records spread over workers: this process, processes of this machine, or a cluster's executor.

A worker reads a record once, from its log, and keeps it. What comes back is added up in the order
of the records, so that the result does not depend on who did what, to the last digit, where all
have one linear algebra and one kind of processor.
"""

from __future__ import annotations

import copy
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from threadpoolctl import threadpool_limits

from ...config.model import ModelConfig
from ...log.reader import read_log
from ...model.effects.base import Loads
from ..records.record import IdentificationError
from .records.trace_record import TraceRecord, trace_record

Answer = TypeVar("Answer")
Task = Callable[[TraceRecord], Answer]
Say = Callable[[str], None]

_ANSWERS_S = 10.0
_ASKED_S, _NOBODY_S = 5.0, 60.0
"""How often it is asked whether a cluster has workers, and for how long it may have none."""


@dataclass(frozen=True)
class RecordSource:
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
    ) -> RecordSource:
        """Return rows of the log that is at `path` now, in a session of this span and loads."""
        now = path.stat()
        # Workers may stand in another folder.
        there = path.absolute()
        return cls(there, start, stop, span_s, loads, now.st_mtime_ns, now.st_size, name)


class Workers(Protocol):
    """Who does what to records."""

    def map(self, task: Task[Answer], sources: Sequence[RecordSource]) -> list[Answer]:
        """Return the answers in the order of the sources."""


@dataclass(frozen=True)
class Alone:
    """All in this process."""

    config: ModelConfig

    def map(self, task: Task[Answer], sources: Sequence[RecordSource]) -> list[Answer]:
        """Return the answers in the order of the sources."""
        text = self.config.model_dump_json()
        # Threads of the linear algebra would only add up in another order.
        with threadpool_limits(1):
            return [task(_record(source, text)) for source in sources]


class Spread:
    """Through an executor of concurrent.futures, or one that behaves like it.

    Who loses its workers goes on in this process, and says so.
    """

    def __init__(
        self,
        config: ModelConfig,
        executor: Executor,
        who: str,
        say: Say,
        anybody: Callable[[], bool] = lambda: True,
    ) -> None:
        self.executor, self._alone = executor, Alone(config)
        self._who, self._say, self._anybody = who, say, anybody
        self._text, self._lost = config.model_dump_json(), False

    def map(self, task: Task[Answer], sources: Sequence[RecordSource]) -> list[Answer]:
        """Return the answers in the order of the sources."""
        if self._lost:
            return self._alone.map(task, sources)
        # The longest first: nobody waits for a long one that began last.
        order = sorted(range(len(sources)), key=lambda i: sources[i].start - sources[i].stop)
        futures: dict[int, Future[_Answered[Answer]]] = {}
        answers: list[Answer] = []
        try:
            for i in order:
                futures[i] = self.executor.submit(_answered, task, sources[i], self._text)
            for i in range(len(sources)):
                answers.append(self._awaited(futures[i]).value())
        except _TaskError as failed:
            raise failed.error from None
        except Exception as error:  # noqa: BLE001 - each executor has its own ways of ending
            self._lost = True
            for future in futures.values():
                future.cancel()
            told = f"{type(error).__name__}: {error}".rstrip(": ")
            self._say(f"lost {self._who} ({told}); going on in this process")
            return self._alone.map(task, sources)
        return answers

    def _awaited(self, future: Future[_Answered[Answer]]) -> _Answered[Answer]:
        since_s = time.monotonic()
        while not future.done():
            try:
                return future.result(_ASKED_S)
            except TimeoutError:
                if future.done():
                    break
            now_s = time.monotonic()
            if self._anybody():
                since_s = now_s
            elif now_s - since_s > _NOBODY_S:
                raise IdentificationError(f"no workers for {_NOBODY_S:.0f} s")
        return future.result()


@contextmanager
def local_workers(
    config: ModelConfig, processes: int | None = None, say: Say = print
) -> Iterator[Workers]:
    """Give workers on this machine: a process a core, or none beside this one for one core.

    `say` is told in a line when they are lost.
    """
    count = processes or len(os.sched_getaffinity(0))
    if count == 1:
        yield Alone(config)
        return
    context = multiprocessing.get_context("forkserver")
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(count, mp_context=context, initializer=_begin) as pool:
        try:
            yield Spread(config, pool, "a worker", say)
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
def cluster_workers(config: ModelConfig, address: str, say: Say = print) -> Iterator[Workers]:
    """Give the workers of a dask.distributed scheduler; they must see the logs where we do.

    `say` is told in a line when they are lost. Raises OSError where nobody answers at the address,
    IdentificationError where it is none or has no workers.
    """
    from distributed import Client

    who = f"--dask {address}"
    try:
        client = Client(address, timeout=f"{_ANSWERS_S:.0f}s")
    except ValueError as error:  # of whoever reads addresses there
        raise IdentificationError(
            f"{who}: expected tcp://HOST:PORT, found no address ({error})"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_ANSWERS_S)
        except TimeoutError:
            raise IdentificationError(
                f"{who}: expected a scheduler with workers, found none within {_ANSWERS_S:.0f} s"
            ) from None
        executor = client.get_executor(pure=False)
        try:
            yield Spread(config, executor, who, say, lambda: bool(client.nthreads()))
        finally:
            # After an error nobody wants what was submitted; otherwise all of it is there. Who has
            # lost its scheduler for long has closed, and raises: what was found is found.
            with suppress(Exception):
                executor.shutdown(wait=False)


@dataclass(frozen=True)
class _Answered(Generic[Answer]):
    """What a task returned, or raised."""

    answers: tuple[Answer, ...]
    error: Exception | None = None

    def value(self) -> Answer:
        """Return the answer; raises _TaskError for what the task raised."""
        if self.error is not None:
            raise _TaskError(self.error)
        return self.answers[0]


class _TaskError(Exception):
    """What a task raised, told from what happens to those who work on it."""

    def __init__(self, error: Exception) -> None:
        super().__init__(str(error))
        self.error = error


def _answered(task: Task[Answer], source: RecordSource, model_json: str) -> _Answered[Answer]:
    # Each worker is one core. For good: a worker of threads would have each undo it for the others.
    threadpool_limits(1)
    try:
        return _Answered((task(_record(source, model_json)),))
    except Exception as error:  # noqa: BLE001 - raised where it was asked for
        error.add_note(traceback.format_exc())  # which no exception takes along
        return _Answered((), error)


def _record(source: RecordSource, model_json: str) -> TraceRecord:
    key = source, model_json
    record = _KEPT.get(key)
    if record is None:
        record = _read(source, model_json)
        _KEPT.put(key, record)
    return record


def _read(source: RecordSource, model_json: str) -> TraceRecord:
    size = source.path.stat().st_size
    if size != source.size:
        raise IdentificationError(
            f"{source.path}: expected the log that the trace began with, {source.size} bytes, "
            f"found {size} bytes: it was written to, or a worker sees another file there"
        )
    config = ModelConfig.model_validate_json(model_json)
    record = trace_record(read_log(source.path), config)
    if source.name:
        record = replace(record, experiment=replace(record.experiment, name=source.name))
    places = replace(record.places, span_s=source.span_s, loads=source.loads)
    part = record.cut(source.start, source.stop)
    if part is not record:
        part = copy.deepcopy(part)  # a view would keep the whole
    return replace(part, places=places)


class _Kept:
    """Records that were read, up to so many bytes: those last asked for."""

    def __init__(self, most_bytes: int) -> None:
        self._most, self._bytes = most_bytes, 0
        self._records: OrderedDict[object, TraceRecord] = OrderedDict()
        self._lock = threading.Lock()  # workers of a cluster may be threads

    def get(self, key: object) -> TraceRecord | None:
        with self._lock:
            if key in self._records:
                self._records.move_to_end(key)
            return self._records.get(key)

    def put(self, key: object, record: TraceRecord) -> None:
        with self._lock:
            if key in self._records:
                return
            self._records[key] = record
            self._bytes += record.nbytes
            while self._bytes > self._most and len(self._records) > 1:
                _, dropped = self._records.popitem(last=False)
                self._bytes -= dropped.nbytes


def _memory_each() -> int:
    """Return a processor's share of half of the machine's memory."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return memory // (2 * (os.cpu_count() or 1))


_KEPT = _Kept(_memory_each())
