"""Run tasks on records in this process, in local worker processes, or on a Dask cluster.

Each worker reads a record from its log once and caches it. Results are added in the order of the
records, so that they are identical for any distribution of the tasks, if all workers have the same
linear algebra library and type of processor.
"""

from __future__ import annotations

import copy
import multiprocessing
import os
import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from threadpoolctl import threadpool_limits

from ...config.model import ModelConfig
from ...log.reader import read_log
from ...model.effects.base import Loads
from ..records.record import IdentificationError
from .record_affinity_pool import RecordAffinityPool
from .records.memory_of_arrays import memory_of_arrays
from .records.record_from_log import TraceRecord, trace_record
from .worker_processes import begin_imports, end_with_parent, without_main_module, worker_count

Answer = TypeVar("Answer")
Task = Callable[[TraceRecord], Answer]
Report = Callable[[str], None]

_POLL_S = 1.0
"""Interval of the check for workers in a cluster."""


@dataclass(frozen=True)
class RecordSource:
    """The source of a record: rows of a log, its file time and size, and its session.

    `name` is the record's unique name; empty for the log's own.
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
        """Return rows start to stop of the log at `path`, with the session's span and loads."""
        file = path.stat()
        # Workers may have another working directory.
        absolute = path.absolute()
        return cls(absolute, start, stop, span_s, loads, file.st_mtime_ns, file.st_size, name)


class Workers(Protocol):
    """Runs a task on many records."""

    def map(
        self, task: Task[Answer] | Sequence[Task[Answer]], sources: Sequence[RecordSource]
    ) -> list[Answer]:
        """Return the answers in the order of the sources, of one task or of one for each."""


@dataclass(frozen=True)
class Alone:
    """Runs all tasks in this process."""

    config: ModelConfig

    def map(
        self, task: Task[Answer] | Sequence[Task[Answer]], sources: Sequence[RecordSource]
    ) -> list[Answer]:
        """Return the answers in the order of the sources."""
        text, tasks = self.config.model_dump_json(), _each(task, sources)
        # BLAS threads would change the order of additions, and with it the last digits.
        with threadpool_limits(1):
            return [one(_record(source, text)) for one, source in zip(tasks, sources, strict=True)]


class Spread:
    """Runs tasks in an executor with the interface of concurrent.futures.

    If a worker is lost, it reports this and continues in this process.
    """

    def __init__(
        self,
        config: ModelConfig,
        executor: Executor,
        name: str,
        report: Report,
        has_workers: Callable[[], bool] = lambda: True,
    ) -> None:
        self.executor, self._alone = executor, Alone(config)
        self._name, self._report, self._has_workers = name, report, has_workers
        self._text, self._lost = config.model_dump_json(), False

    def map(
        self, task: Task[Answer] | Sequence[Task[Answer]], sources: Sequence[RecordSource]
    ) -> list[Answer]:
        """Return the answers in the order of the sources."""
        if self._lost:
            return self._alone.map(task, sources)
        tasks = _each(task, sources)
        # Longest records first, so that no long task starts last.
        order = sorted(range(len(sources)), key=lambda i: sources[i].start - sources[i].stop)
        futures: dict[int, Future[_Answered[Answer]]] = {}
        answers: list[Answer] = []
        try:
            for i in order:
                futures[i] = self.executor.submit(_answered, tasks[i], sources[i], self._text)
            for i in range(len(sources)):
                answers.append(self._awaited(futures[i]).value())
        except _TaskError as failed:
            raise failed.error from None
        except Exception as error:  # noqa: BLE001 - each executor fails in its own way
            self._lost = True
            for future in futures.values():
                future.cancel()
            reason = f"{type(error).__name__}: {error}".rstrip(": ")
            self._report(f"lost {self._name} ({reason}); continuing in this process")
            return self._alone.map(task, sources)
        return answers

    def _awaited(self, future: Future[_Answered[Answer]]) -> _Answered[Answer]:
        since_s = time.monotonic()
        while not future.done():
            try:
                return future.result(_POLL_S)
            except TimeoutError:
                if future.done():
                    break
            now_s = time.monotonic()
            if self._has_workers():
                since_s = now_s
            elif now_s - since_s > _timeout_s():
                raise IdentificationError(f"no workers for {_timeout_s():.0f} s")
        return future.result()


@contextmanager
def local_workers(
    config: ModelConfig, processes: int | None = None, report: Report = print
) -> Iterator[Workers]:
    """Start local workers: one process for each core, or only this process on one core.

    They import what they need while the body begins. `report` is called with a line of text if a
    worker is lost.
    """
    count = worker_count(processes)
    if count == 1:
        yield Alone(config)
        return
    others = set(multiprocessing.active_children())
    with RecordAffinityPool(count, begin_imports(), end_with_parent, _length) as pool:
        try:
            with without_main_module():
                for _ in range(count):
                    pool.submit(_start)
            yield Spread(config, pool, "a worker", report)
        except BaseException:
            # Otherwise the pool would first finish all submitted tasks.
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()
            raise


def _start() -> None:
    """Do nothing: the task that starts a worker."""


def _length(argument: object) -> tuple[RecordSource, int] | None:
    """Return a record among the arguments of a task with its rows."""
    if not isinstance(argument, RecordSource):
        return None
    return argument, argument.stop - argument.start


@contextmanager
def cluster_workers(config: ModelConfig, address: str, report: Report = print) -> Iterator[Workers]:
    """Connect to the workers of a dask.distributed scheduler; they need the logs at the same paths.

    `report` is called with a line of text if they are lost. Raises OSError if the scheduler does
    not answer, IdentificationError for an invalid address or a scheduler without workers.
    """
    from distributed import Client

    name = f"--dask {address}"
    try:
        client = Client(address)
    except ValueError as error:  # from distributed's parser of addresses
        raise IdentificationError(
            f"{name}: expected an address tcp://HOST:PORT, found an invalid one ({error})"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_timeout_s())
        except TimeoutError:
            raise IdentificationError(
                f"{name}: expected a scheduler with workers, found none within {_timeout_s():.0f} s"
            ) from None
        executor = client.get_executor(pure=False)
        try:
            yield Spread(config, executor, name, report, lambda: bool(client.nthreads()))
        finally:
            # All results are here, or not needed after an error. A client that lost its scheduler
            # is closed and raises, which does not affect the results.
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
    """An exception of the task itself, as opposed to a failure of the executor."""

    def __init__(self, error: Exception) -> None:
        super().__init__(str(error))
        self.error = error


def _answered(task: Task[Answer], source: RecordSource, model_json: str) -> _Answered[Answer]:
    # One core for each worker. Set permanently: in a worker of threads, each would undo it.
    threadpool_limits(1)
    try:
        return _Answered((task(_record(source, model_json)),))
    except Exception as error:  # noqa: BLE001 - raised again by the caller
        error.add_note(traceback.format_exc())  # the traceback is lost in transport
        return _Answered((), error)


def _each(
    task: Task[Answer] | Sequence[Task[Answer]], sources: Sequence[RecordSource]
) -> Sequence[Task[Answer]]:
    return [task] * len(sources) if callable(task) else task


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
            f"{source.path}: the log changed during the trace: expected {source.size} bytes, found "
            f"{size} bytes; check that nothing writes to it and all workers read one file"
        )
    config = ModelConfig.model_validate_json(model_json)
    record = trace_record(read_log(source.path), config)
    if source.name:
        record = replace(record, experiment=replace(record.experiment, name=source.name))
    places = replace(record.places, span_s=source.span_s, loads=source.loads)
    part = record.cut(source.start, source.stop)
    if part is not record:
        part = copy.deepcopy(part)  # a view would keep the whole record in memory
    return replace(part, places=places)


class _Kept:
    """A cache of records up to a size in bytes, least recently used dropped first.

    The size is that of the records with all that was prepared from them until a record is added.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most = most_bytes
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
            kept = self._records
            while len(kept) > 1 and memory_of_arrays(*kept.values()) > self._most:
                kept.popitem(last=False)


def _memory_each() -> int:
    """Return half of the machine's memory, divided by the number of processors, in bytes."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return memory // (2 * (os.cpu_count() or 1))


_KEPT = _Kept(_memory_each())


def _timeout_s() -> float:
    """Return how long a cluster may have no workers: as it may take to connect to it."""
    import dask
    from dask.utils import parse_timedelta

    return float(parse_timedelta(dask.config.get("distributed.comm.timeouts.connect")))
