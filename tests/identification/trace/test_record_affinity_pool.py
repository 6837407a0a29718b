"""Test the pool whose processes keep their records: homes, balance, lost processes."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import NamedTuple

import pytest

from levid.identification.trace.record_affinity_pool import RecordAffinityPool

TIMEOUT_S = 60.0


class Named(NamedTuple):
    name: str
    rows: int


def size(argument: object) -> tuple[str, int] | None:
    return (argument.name, argument.rows) if isinstance(argument, Named) else None


def nothing() -> None:
    """Begin a worker."""


def process(_: object, gate: Path | None = None) -> int:
    """Return this process once a file exists."""
    end_s = time.monotonic() + TIMEOUT_S
    while gate is not None and not gate.exists() and time.monotonic() < end_s:
        time.sleep(0.01)
    return os.getpid()


def end(_: object) -> None:
    os._exit(1)


@pytest.fixture
def pool() -> Iterator[RecordAffinityPool]:
    with RecordAffinityPool(2, multiprocessing.get_context("forkserver"), nothing, size) as made:
        yield made


def test_record_stays_with_its_process_and_each_has_half(pool: RecordAffinityPool) -> None:
    records = [Named(f"r{i}", 100) for i in range(4)]
    rounds = []
    for _ in range(5):
        futures = {r.name: pool.submit(process, r) for r in records}
        rounds.append({name: f.result(TIMEOUT_S) for name, f in futures.items()})
        # One of them asked by itself goes to its home too.
        alone = pool.submit(process, records[-1]).result(TIMEOUT_S)
        assert alone == rounds[0][records[-1].name]
    assert all(one == rounds[0] for one in rounds)
    assert sorted(Counter(rounds[0].values()).values()) == [2, 2]


def test_another_process_helps_a_home_that_has_too_much_to_do(
    pool: RecordAffinityPool, tmp_path: Path
) -> None:
    record, gate = Named("long", 100), tmp_path / "open"
    futures = [pool.submit(process, record, gate) for _ in range(6)]
    gate.touch()  # none was done before the last was placed
    used = Counter(f.result(TIMEOUT_S) for f in futures)
    assert sorted(used.values()) == [2, 4]  # one reads the record again only if that is faster


def test_tasks_without_a_record_go_where_there_is_least_to_do(
    pool: RecordAffinityPool, tmp_path: Path
) -> None:
    gate = tmp_path / "open"
    futures = [pool.submit(process, None, gate) for _ in range(4)]
    gate.touch()
    assert sorted(Counter(f.result(TIMEOUT_S) for f in futures).values()) == [2, 2]


def test_lost_process_is_an_error_of_its_tasks(pool: RecordAffinityPool) -> None:
    with pytest.raises(BrokenProcessPool):
        pool.submit(end, Named("one", 1)).result(TIMEOUT_S)
