"""Workers of a trace end with whoever has them, however that ends; whoever loses them goes on."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from mass_on_spring_logs import MASS as CONFIG
from mass_on_spring_logs import imported
from threadpoolctl import threadpool_info

from levid.identification.records.record import IdentificationError
from levid.identification.trace import worker_pool
from levid.identification.trace.records.trace_record import TraceRecord
from levid.identification.trace.worker_pool import (
    Alone,
    RecordSource,
    Spread,
    cluster_workers,
    local_workers,
)

GIVE_UP_S = 60.0
SCRIPT = """
import multiprocessing, os, signal, sys, time
from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.trace.worker_pool import local_workers

if __name__ == "__main__":
    # A shell has its background jobs ignore it, and their children too.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with local_workers(load_model(shipped("models/rig.yaml")), 2) as workers:
        futures = [workers.executor.submit(time.sleep, 600.0) for _ in range(6)]
        print(*[child.pid for child in multiprocessing.active_children()], flush=True)
        futures[0].result()
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_no_worker_is_left_behind(tmp_path: Path, number: int) -> None:
    script = tmp_path / "tracing.py"
    script.write_text(SCRIPT)
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    pids = [int(word) for word in process.stdout.readline().split()]
    assert len(pids) == 2
    time.sleep(1.0)  # they begin, and wait for what they are to do
    process.send_signal(number)
    _, said = process.communicate(timeout=GIVE_UP_S)  # its pipes are theirs as well
    give_up_s = time.monotonic() + GIVE_UP_S
    while any(_there(pid) for pid in pids):
        assert time.monotonic() < give_up_s
        time.sleep(0.05)
    if number == signal.SIGINT:
        assert said.count("Traceback") == 1  # that of the script itself
    else:
        assert "Traceback" not in said


def _there(pid: int) -> bool:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, 0)
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        return state != "Z"
    return False


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> list[RecordSource]:
    """Records of 1000, 900, ... rows."""
    folder, rng = tmp_path_factory.mktemp("logs"), np.random.default_rng(0)
    paths = [imported(folder, f"r{k}", rng.normal(size=(1000, 2))) for k in range(3)]
    return [RecordSource.of(path, 0, 1000 - 100 * k, (0.0, 1.0)) for k, path in enumerate(paths)]


def rows_unless_in_a_worker(record: TraceRecord) -> int:
    """Die where somebody else works, as a process that takes too much memory does."""
    if multiprocessing.parent_process() is not None:
        os.kill(os.getpid(), signal.SIGKILL)
    return record.rows


def refuse(record: TraceRecord) -> int:
    raise IdentificationError(f"not {record.name}")


def threads_here(_: TraceRecord) -> list[int]:
    return [int(pool["num_threads"]) for pool in threadpool_info()]


def test_who_loses_a_worker_goes_on_alone_and_says_so(sources: list[RecordSource]) -> None:
    said: list[str] = []
    with local_workers(CONFIG, 2, said.append) as spread:
        assert spread.map(rows_unless_in_a_worker, sources) == [1000, 900, 800]
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
    (line,) = said
    assert line.startswith("lost a worker (BrokenProcessPool")
    assert line.endswith("; continuing in this process")


def test_what_a_record_is_refused_for_is_no_loss(sources: list[RecordSource]) -> None:
    said: list[str] = []
    with (
        pytest.raises(IdentificationError, match="not r0") as refused,
        local_workers(CONFIG, 2, said.append) as spread,
    ):
        spread.map(refuse, sources)
    assert said == []
    # Where it happened is told to who looks for it.
    assert any("in refuse" in note for note in refused.value.__notes__)


def test_an_executor_without_anybody_is_left_after_a_while(
    sources: list[RecordSource], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_pool, "_POLL_S", 0.05)
    monkeypatch.setattr(worker_pool, "_NO_WORKERS_TIMEOUT_S", 0.2)
    said: list[str] = []
    with ThreadPoolExecutor(1) as pool:
        busy = pool.submit(time.sleep, 1.0)  # nobody has time
        spread = Spread(CONFIG, pool, "the others", said.append, lambda: False)
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
        assert not busy.done()
    assert said == [
        "lost the others (IdentificationError: no workers for 0 s); continuing in this process"
    ]


def test_a_source_is_the_same_wherever_its_worker_stands(
    sources: list[RecordSource], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = sources[0].path.parent
    monkeypatch.chdir(folder)
    relative = RecordSource.of(Path("r0.mcap"), 0, 1000, (0.0, 1.0))
    monkeypatch.chdir(tmp_path)
    assert relative == sources[0]


def test_another_file_at_the_path_of_a_log_is_refused(tmp_path: Path) -> None:
    path = imported(tmp_path, "log", np.random.default_rng(1).normal(size=(500, 2)))
    source = RecordSource.of(path, 0, 500, (0.0, 1.0))
    path.write_bytes(path.read_bytes() + b"more")
    with pytest.raises(IdentificationError, match=r"log.mcap: the log changed"):
        Alone(CONFIG).map(attrgetter("rows"), [source])


def test_records_are_kept_up_to_so_many_bytes(sources: list[RecordSource]) -> None:
    record = worker_pool._read(sources[0], CONFIG.model_dump_json())
    assert record.nbytes > 1000 * 8 * 4
    kept = worker_pool._Kept(3 * record.nbytes)
    for key in range(5):
        kept.put(key, record)
        assert kept.get(0) is record
    # The first was asked for after each: it stays, with the last two that came.
    assert [kept.get(key) is not None for key in range(5)] == [True, False, False, True, True]


def test_a_part_keeps_no_whole(sources: list[RecordSource]) -> None:
    part = worker_pool._read(sources[1], CONFIG.model_dump_json())
    assert part.rows == 900
    assert part.gap.base is None or part.gap.base.nbytes <= part.gap.nbytes


@pytest.fixture(scope="module")
def cluster():
    """A real scheduler of dask.distributed, with a worker in a process of its own."""
    distributed = pytest.importorskip("distributed", reason="levid[cluster] is not installed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, host="127.0.0.1", dashboard_address=":0"
    ) as cluster:
        yield cluster


def test_workers_of_several_threads_have_one_for_the_algebra(
    cluster, sources: list[RecordSource]
) -> None:
    with cluster_workers(CONFIG, cluster.scheduler_address) as spread:
        pools = spread.map(threads_here, sources * 4)
    assert all(threads == 1 for pool in pools for threads in pool)


def test_a_scheduler_without_workers_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(worker_pool, "_CONNECT_TIMEOUT_S", 2.0)
    with (
        distributed.LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address=":0") as empty,
        pytest.raises(IdentificationError, match="a scheduler with workers, found none within"),
        cluster_workers(CONFIG, empty.scheduler_address),
    ):
        pass


def test_who_loses_a_cluster_goes_on_alone(sources: list[RecordSource]) -> None:
    distributed = pytest.importorskip("distributed")
    said: list[str] = []
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=":0"
        ) as doomed,
        cluster_workers(CONFIG, doomed.scheduler_address, said.append) as spread,
    ):
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
        doomed.close()
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
    (line,) = said
    assert line.startswith("lost --dask tcp://127.0.0.1")


def test_a_cluster_that_is_long_gone_takes_nothing_back(sources: list[RecordSource]) -> None:
    """A client that finds nobody for ten seconds closes by itself: it cannot be told to end."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=":0"
        ) as doomed,
        cluster_workers(CONFIG, doomed.scheduler_address, pytest.fail) as spread,
    ):
        assert spread.map(attrgetter("rows"), sources) == [1000, 900, 800]
        assert isinstance(spread, Spread)
        spread.executor.submit(time.sleep, 30.0)
        spread.executor._client.close()
