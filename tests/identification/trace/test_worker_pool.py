"""Test the workers of a trace: none stays behind, and a lost worker does not end the trace."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from mass_on_spring_logs import MASS as CONFIG
from mass_on_spring_logs import imported
from threadpoolctl import threadpool_info
from waiting import wait_until

from levid.identification.records.record import IdentificationError
from levid.identification.trace import worker_pool
from levid.identification.trace.records.memory_of_arrays import memory_of_arrays
from levid.identification.trace.records.record_from_log import TraceRecord
from levid.identification.trace.worker_pool import (
    Alone,
    RecordSource,
    Spread,
    cluster_workers,
    local_workers,
)

TIMEOUT_S = 60.0
SCRIPT = """
import multiprocessing, os, signal, sys, time
from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.trace.worker_pool import local_workers

TASK = "import os, pathlib, time; pathlib.Path('FOLDER', str(os.getpid())).touch(); time.sleep(600)"

if __name__ == "__main__":
    # A shell lets background jobs and their children ignore SIGINT.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with local_workers(load_model(shipped("models/rig.yaml")), 2) as workers:
        futures = [workers.executor.submit(exec, TASK) for _ in range(6)]
        print(*[child.pid for child in multiprocessing.active_children()], flush=True)
        futures[0].result()
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_workers_end_with_the_process_that_started_them(tmp_path: Path, number: int) -> None:
    script = tmp_path / "tracing.py"
    script.write_text(SCRIPT.replace("FOLDER", str(tmp_path)))
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    pids = [int(word) for word in process.stdout.readline().split()]
    assert len(pids) == 2
    wait_until(lambda: all((tmp_path / str(pid)).exists() for pid in pids), TIMEOUT_S)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=TIMEOUT_S)  # the workers share its pipes
    wait_until(lambda: not any(map(_exists, pids)), TIMEOUT_S)
    if number == signal.SIGINT:
        assert stderr.count("Traceback") == 1  # the traceback of the script
    else:
        assert "Traceback" not in stderr


def _exists(pid: int) -> bool:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, 0)
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        return state != "Z"
    return False


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> list[RecordSource]:
    """Return sources of records with 1000, 900 and 800 rows."""
    folder, rng = tmp_path_factory.mktemp("logs"), np.random.default_rng(0)
    paths = [imported(folder, f"r{k}", rng.normal(size=(1000, 2))) for k in range(3)]
    return [RecordSource.of(path, 0, 1000 - 100 * k, (0.0, 1.0)) for k, path in enumerate(paths)]


def rows_unless_in_a_worker(record: TraceRecord) -> int:
    """Kill this process if it is a worker, like the kernel does when memory runs out."""
    if multiprocessing.parent_process() is not None:
        os.kill(os.getpid(), signal.SIGKILL)
    return record.rows


def reject(record: TraceRecord) -> int:
    raise IdentificationError(f"not {record.name}")


def threads_here(_: TraceRecord) -> list[int]:
    return [int(pool["num_threads"]) for pool in threadpool_info()]


def test_trace_continues_in_one_process_when_a_worker_dies(sources: list[RecordSource]) -> None:
    messages: list[str] = []
    with local_workers(CONFIG, 2, messages.append) as spread:
        assert spread.map(rows_unless_in_a_worker, sources) == [1000, 900, 800]
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
    (line,) = messages
    assert line.startswith("lost a worker (BrokenProcessPool")
    assert line.endswith("; continuing in this process")


def test_each_source_may_have_a_task_of_its_own(sources: list[RecordSource]) -> None:
    tasks = [attrgetter("rows"), attrgetter("name"), attrgetter("rows")]
    expected = [1000, "r1", 800]
    with local_workers(CONFIG, 2) as spread:
        assert spread.map(tasks, sources) == expected
    assert Alone(CONFIG).map(tasks, sources) == expected


def test_error_in_a_task_is_raised_and_no_worker_is_lost(sources: list[RecordSource]) -> None:
    messages: list[str] = []
    with (
        pytest.raises(IdentificationError, match="not r0") as rejected,
        local_workers(CONFIG, 2, messages.append) as spread,
    ):
        spread.map(reject, sources)
    assert messages == []
    # The notes of the error contain the worker's traceback.
    assert any("in reject" in note for note in rejected.value.__notes__)


def test_trace_continues_in_one_process_if_no_worker_is_free(
    sources: list[RecordSource], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_pool, "_POLL_S", 0.05)
    monkeypatch.setattr(worker_pool, "_timeout_s", lambda: 0.2)
    messages: list[str] = []
    with ThreadPoolExecutor(1) as pool:
        busy = pool.submit(time.sleep, 1.0)  # the only worker is busy
        spread = Spread(CONFIG, pool, "the others", messages.append, lambda: False)
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
        assert not busy.done()
    assert messages == [
        "lost the others (IdentificationError: no workers for 0 s); continuing in this process"
    ]


def test_source_is_independent_of_the_working_directory(
    sources: list[RecordSource], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = sources[0].path.parent
    monkeypatch.chdir(folder)
    relative = RecordSource.of(Path("r0.mcap"), 0, 1000, (0.0, 1.0))
    monkeypatch.chdir(tmp_path)
    assert relative == sources[0]


def test_log_that_changed_is_rejected(tmp_path: Path) -> None:
    path = imported(tmp_path, "log", np.random.default_rng(1).normal(size=(500, 2)))
    source = RecordSource.of(path, 0, 500, (0.0, 1.0))
    path.write_bytes(path.read_bytes() + b"more")
    with pytest.raises(IdentificationError, match=r"log.mcap: the log changed"):
        Alone(CONFIG).map(attrgetter("rows"), [source])


def test_record_cache_keeps_recently_used_records_within_its_size(
    sources: list[RecordSource],
) -> None:
    record = worker_pool._read(sources[0], CONFIG.model_dump_json())
    each = memory_of_arrays(record)
    assert each > 1000 * 8 * 4
    kept = worker_pool._Kept(3 * each)
    for key in range(5):
        kept.put(key, record if key == 0 else deepcopy(record))
        assert kept.get(0) is record
    # The first was read after each: it stays, with the last two.
    assert [kept.get(key) is not None for key in range(5)] == [True, False, False, True, True]
    # What is prepared from a record counts too, once, although the record is in it.
    record.prepared[b"point"] = record, np.zeros(each // 8), record.gap[5:]
    assert memory_of_arrays(record) == each + each // 8 * 8
    kept.put(5, deepcopy(record))
    assert [kept.get(key) is not None for key in range(6)] == [False] * 5 + [True]


def test_part_of_a_record_does_not_keep_the_whole_in_memory(sources: list[RecordSource]) -> None:
    part = worker_pool._read(sources[1], CONFIG.model_dump_json())
    assert part.rows == 900
    assert part.gap.base is None or part.gap.base.nbytes <= part.gap.nbytes


@pytest.fixture(scope="module")
def cluster():
    """Start a scheduler of dask.distributed with one worker process."""
    distributed = pytest.importorskip("distributed", reason="levid[cluster] is not installed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, host="127.0.0.1", dashboard_address=":0"
    ) as cluster:
        yield cluster


def test_worker_threads_use_one_linear_algebra_thread_each(
    cluster, sources: list[RecordSource]
) -> None:
    with cluster_workers(CONFIG, cluster.scheduler_address) as spread:
        pools = spread.map(threads_here, sources * 4)
    assert all(threads == 1 for pool in pools for threads in pool)


def test_scheduler_without_workers_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(worker_pool, "_timeout_s", lambda: 2.0)
    with (
        distributed.LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address=":0") as empty,
        pytest.raises(IdentificationError, match="a scheduler with workers, found none within"),
        cluster_workers(CONFIG, empty.scheduler_address),
    ):
        pass


def test_trace_continues_in_one_process_when_the_cluster_closes(
    sources: list[RecordSource],
) -> None:
    distributed = pytest.importorskip("distributed")
    messages: list[str] = []
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=":0"
        ) as closed_cluster,
        cluster_workers(CONFIG, closed_cluster.scheduler_address, messages.append) as spread,
    ):
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
        closed_cluster.close()
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
    (line,) = messages
    assert line.startswith("lost --dask tcp://127.0.0.1")


def test_results_are_kept_when_the_cluster_client_closed_itself(
    sources: list[RecordSource],
) -> None:
    """A client without a scheduler closes itself after ten seconds; closing it again must work."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=":0"
        ) as closed_cluster,
        cluster_workers(CONFIG, closed_cluster.scheduler_address, pytest.fail) as spread,
    ):
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
        assert isinstance(spread, Spread)
        spread.executor.submit(time.sleep, 30.0)
        spread.executor._client.close()
