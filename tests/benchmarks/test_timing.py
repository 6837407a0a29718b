"""What the benchmarks of the daemon in real time count, and what they do where a round fails."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from levid.benchmarks.daemon import timing as loop_timing
from levid.benchmarks.daemon import timing_figures, timing_rounds
from levid.benchmarks.harness import (
    busy_disk,
    flown_rows,
    histogram,
    kept_results,
    ratio_of_shares,
    real_time,
    running_daemon,
    trend,
)
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.client import DaemonError
from levid.daemon.ipc.row_ring import NO_LOG
from levid.daemon.ipc.shared_memory import Shared
from levid.log.writer import LogWriter


def by_key(figures) -> dict[str, float]:
    return {figure.key: figure.value for figure in figures}


def met(figures) -> dict[str, str]:
    return {figure.key: str(figure.met) for figure in figures if figure.met}


def turns_of(shares: ModuleType, late: np.ndarray) -> list:
    """Return rounds of so many late cycles (n, 2) of 10,000."""
    return [shares.Round(int(a), 10_000, int(b), 10_000) for a, b in late]


def drifting(rng: np.random.Generator, rounds: int, stalls: float, of: int) -> np.ndarray:
    """Return late cycles (rounds, 2): stalls as often as a drifting host has them, `of` in each.

    Its load is correlated by 0.9 from turn to turn; who comes first is swapped every round.
    """
    load = np.empty(2 * rounds)
    load[0] = rng.standard_normal()
    for i in range(1, len(load)):
        load[i] = 0.9 * load[i - 1] + np.sqrt(1 - 0.9**2) * rng.standard_normal()
    late = (of * rng.poisson(stalls * np.exp(load - 0.5))).reshape(rounds, 2)
    late[1::2] = late[1::2, ::-1]
    return late


def test_ratio_of_shares_holds_the_truth_as_often_as_it_says() -> None:
    shares = ratio_of_shares
    rng = np.random.default_rng(1)
    some, others = rng.binomial(10_000, 0.004, 2000), rng.binomial(20_000, 0.002, 2000)
    inside = [
        (found := shares.ratio_95([shares.Round(a, 10_000, b, 20_000)])).low < 2.0 < found.high
        for a, b in zip(some, others, strict=True)
    ]
    # 2000 draws: 0.5 % is the standard error.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)
    nothing = shares.ratio_95([shares.Round(0, 1000, 0, 1000)])
    assert 0.0 < nothing.low < 1.0 < nothing.high
    # One round knows nothing of clusters, whatever it counts.
    assert shares.ratio_95([shares.Round(100, 10_000, 1000, 10_000)]).met == "undecided"


@pytest.mark.parametrize("rounds", [12, 20])
@pytest.mark.parametrize("drifts", [False, True])
def test_ratio_of_shares_knows_that_late_cycles_come_in_clusters(rounds: int, drifts: bool) -> None:
    shares = ratio_of_shares
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(500):
        # Stalls of thirty late cycles, two in a round; or five of ten as often as the load has it.
        late = drifting(rng, rounds, 5.0, 10) if drifts else 30 * rng.poisson(2.0, (rounds, 2))
        found = shares.ratio_95(turns_of(shares, late))
        inside.append(found.low < 1.0 < found.high)
    # 1 % is the standard error; Katz alone holds it in some 28 %.
    assert 0.92 < np.mean(inside) < 0.98


def test_when_rounds_end_has_no_part_in_the_ratio() -> None:
    shares = ratio_of_shares
    rng = np.random.default_rng(2)
    inside, lengths = [], []
    for _ in range(300):
        turns = turns_of(shares, drifting(rng, 40, 0.7, 10))
        n = 0
        while shares.again(turns[:n], 20, 40):
            n += 1
        found = shares.ratio_95(turns[:n])
        inside.append(found.low < 1.0 < found.high)
        lengths.append(n)
    assert 20 < np.mean(lengths) < 40
    assert 0.92 < np.mean(inside) < 0.985


def test_rounds_go_on_until_enough_have_late_ones_and_say_what_is_undecided(capsys) -> None:
    shares = ratio_of_shares
    none, few = shares.Round(0, 1000, 1, 1000), shares.Round(1, 1000, 1, 1000)
    many = shares.Round(5, 1000, 5, 1000)
    assert shares.again([], 1, 1)
    assert shares.again([many] * 4, 5, 20)
    assert shares.again([few] * 11, 5, 20)
    assert not shares.again([few] * 12, 5, 20)
    assert shares.again([none] * 19, 5, 20)
    assert not shares.again([none] * 20, 5, 20)
    decided = shares.ratio_figures([many] * 20, "low", "high", "x")
    assert met(decided) == {"high": "met"}
    twice = [shares.Round(100, 10_000, 20, 10_000)] * 20
    assert met(shares.ratio_figures(twice, "low", "high", "x")) == {"high": "missed"}
    assert "undecided" not in capsys.readouterr().err
    assert met(shares.ratio_figures([few] * 20, "low", "high", "x")) == {"high": "undecided"}
    assert "about 47 such rounds would decide" in capsys.readouterr().err


def test_a_trend_is_as_sure_as_its_samples() -> None:
    trends = trend
    rng, hours = np.random.default_rng(1), np.arange(28) / 60
    found = [trends.trend(hours, 3.0 * hours + 0.1 * rng.standard_normal(28)) for _ in range(1000)]
    inside = [one.most > 3.0 for one in found]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.025)
    assert np.mean([one.slope for one in found]) == pytest.approx(3.0, abs=0.02)
    assert trends.trend([0, 1], [0, 1]) is None


def test_a_histogram_in_a_file_has_the_quantiles_of_its_times() -> None:
    histograms = histogram
    us = np.random.default_rng(1).exponential(20.0, 5000)
    found = histograms.Histogram.of(us[:2000])
    found = histograms.Histogram.together([found, histograms.Histogram.of(us[2000:])])
    found = histograms.Histogram.from_plain(found.plain)
    assert found.total == 5000
    for share in (0.5, 0.99, 0.999):
        assert found.quantile(share) == pytest.approx(np.quantile(us, share), rel=0.02)
    assert histograms.Histogram().quantile(0.5) is None


def test_counts_of_times_are_the_same_histogram() -> None:
    counts = histogram.Histogram
    us = np.array([0.0, 14.0, 14.0, 15.0, 15.0, 15.0, 800.0])
    found = counts.counted([0.0, 14.0, 14.0, 15.0, 700.0, 800.0], [1, 1, 1, 3, 0, 1])
    assert found == counts.of(us)


def test_rows_are_held_against_what_the_loop_wrote(tmp_path: Path) -> None:
    rows = flown_rows
    flown = np.array([3, 4, 5, 9, 10, 400])  # what it skipped is no row
    found = rows.found_in(flown, flown, 0)
    assert (found, found.wrong) == (rows.Found(), 0)
    # The first and the last are gone, one stands twice, one was never flown.
    assert rows.found_in(flown, np.array([4, 5, 5, 7, 9, 10]), 1) == rows.Found(2, 1, 1, 1)
    assert rows.found_in(flown, flown[:0], 0).missing == 6
    log = np.zeros(6, [("cycle", "<u8")])
    log["cycle"] = flown
    path = tmp_path / "flight.mcap"
    with LogWriter(path, log.dtype, rate_hz=1e3, metadata={}, attachments={}) as out:
        out.write(log, log["cycle"] * np.uint64(1_000_000))
    assert rows.compare(flown, [path]) == rows.Found()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-40])
    assert rows.compare(flown, [cut]).cut == 1


def test_the_ring_tells_what_belongs_into_logs(monkeypatch) -> None:
    rows, rig_file = flown_rows, shipped("rigs/loopback.yaml")
    shared = Shared(load_rig(rig_file))
    monkeypatch.setattr(rows, "memory_of", lambda _: shared.fd)
    monkeypatch.setattr(rows.Shared, "close", lambda _: None)
    ring = shared.ring

    def write(n: int, tag: int) -> None:
        for _ in range(n):
            slot = ring.head % ring.capacity
            ring.rows["cycle"][slot], ring.tags[slot] = 2 * ring.head, tag
            ring.head += 1

    write(10, 7)  # a flight of before
    flown = rows.Flown(0, rig_file)
    for tag in (NO_LOG, 1, 1, 2, NO_LOG):
        write(3000, tag)
        ring.tail = ring.head - 5
        flown.look()
    assert [lag.rows for lag in flown.lags] == [5] * 5
    np.testing.assert_array_equal(flown.cycles, 2 * np.arange(3010, 12_010))
    monkeypatch.setattr(rows, "_WRITTEN_S", 0.1)
    with pytest.raises(RuntimeError, match="not in their files"):
        flown.wait_until_written()
    ring.durable = ring.head
    flown.wait_until_written()
    write(ring.capacity + 1, 1)
    with pytest.raises(RuntimeError, match="too late"):
        flown.look()


def test_rights_are_those_that_the_kernel_grants() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        assert real_time.Rights.of(process.pid) == real_time.Rights(0, 0.0)
        if real_time.hurry(7, process.pid):
            assert real_time.Rights.of(process.pid).priority == 7
        process.kill()
    turns = timing_rounds
    with pytest.raises(SystemExit, match="found priority 0 and 0 MB"):
        turns.require_rights(real_time.Rights(0, 0.0))
    with pytest.raises(SystemExit, match="found priority 80 and 0 MB"):
        turns.require_rights(real_time.Rights(80, 0.0))
    turns.require_rights(real_time.Rights(80, 500.0))


def test_a_daemon_that_does_not_land_is_told(monkeypatch, tmp_path: Path) -> None:
    daemons = running_daemon
    monkeypatch.setattr(daemons, "_LANDED_S", 0.3)
    daemon = daemons.Daemon(tmp_path, tmp_path, {}, 0)
    status = {"state": "FAULT", "fault": "LATE", "detail": "too often"}
    monkeypatch.setattr(daemons.Daemon, "ask", lambda *_: status)
    with pytest.raises(DaemonError, match="in fault LATE: too often"):
        daemon.land()
    status |= {"state": "LEVITATING", "fault": "NONE"}
    with pytest.raises(DaemonError, match="not landed after"):
        daemon.land()


def test_faults_of_a_start_are_counted(monkeypatch, tmp_path: Path, capsys) -> None:
    daemons = running_daemon
    states = iter([("OFF", "NONE"), ("FAULT", "LINK"), ("FAULT", "LINK"), ("IDLE", "NONE")])

    class Client:
        def __init__(self, _: Path) -> None: ...
        def __enter__(self) -> Client:
            return self

        def __exit__(self, *_: object) -> None: ...
        def request(self, op: str) -> dict[str, object]:
            if op == "clear":
                return {}
            state, fault = next(states)
            return {"state": state, "fault": fault, "detail": "silent", "pids": {"loop": 1}}

    monkeypatch.setattr(daemons, "Client", Client)
    monkeypatch.setattr(daemons, "_AGAIN_S", 0.0)
    process = SimpleNamespace(poll=lambda: None)
    daemon = daemons._idle(process, tmp_path, tmp_path)
    assert (daemon.pids, daemon.cleared) == ({"loop": 1}, 2)
    assert "2 faults at the start, the last LINK: silent" in capsys.readouterr().err


def test_busy_disk_is_written_to_and_left_as_it_was(tmp_path: Path) -> None:
    disks = busy_disk
    with disks.busy_disk(tmp_path) as writer:
        give_up_s = time.monotonic() + 60.0
        while not writer.mib and time.monotonic() < give_up_s:
            time.sleep(0.05)
        assert writer.mib % 16 == 0 < writer.mib
        writer.require_busy(1e-6)
        with pytest.raises(disks.NotBusyError, match="MiB/s or more"):
            writer.require_busy(1e9)
        writer.process.kill()
        writer.process.wait(60.0)
        with pytest.raises(disks.NotBusyError, match="ended with -9"):
            writer.require_busy(1e-6)
    assert not list(tmp_path.iterdir())


def test_a_disk_in_memory_is_none() -> None:
    disks = busy_disk
    memory = Path("/dev/shm")
    if not memory.is_dir():
        pytest.skip("no file system in memory")
    with pytest.raises(disks.NotBusyError, match="no disk is written to"), disks.busy_disk(memory):
        pass


CYCLICTEST = """# /dev/cpu_dma_latency set to 0us
# Histogram
000009 000002
000150 000003
# Total: 000000005
# Histogram Overflows: 00002
# Thread 0:
"""


def test_cyclictest_says_how_late_it_woke_up() -> None:
    turn = loop_timing.wake_up.__globals__["of_cyclictest"](CYCLICTEST, 100, 5.0)
    assert (turn.cycles, turn.late) == (7, 5)
    assert turn.lateness.quantile(0.5) == 150.0
    assert turn.lateness.quantile(1.0) == 20_000.0


@pytest.fixture
def timing(tmp_path: Path, monkeypatch) -> ModuleType:
    """The benchmark with contenders that take no time: loops that wake up 18 us late and begin 1 us
    late, cyclictest 20."""
    timing, turns = loop_timing, timing_rounds
    order = timing.order = []
    writer = SimpleNamespace(mib=64, require_busy=lambda: None)
    monkeypatch.setattr(timing, "LOGS", tmp_path)
    monkeypatch.setattr(timing, "busy_disk", lambda _: nullcontext(writer))
    monkeypatch.setattr(timing, "_require_priority", lambda: None)
    monkeypatch.setattr(timing, "rest", lambda: None)
    monkeypatch.setattr(timing, "_LEAST", 4)
    monkeypatch.setattr(timing.shutil, "which", lambda _: "cyclictest")

    def turn(us: float, late: int) -> object:
        found = turns.Turn(9, late, timing_histogram(us), timing_histogram(us), 1.0, 0.1)
        found.lags = [turns.Lag(float(i), 100) for i in range(5)]
        found.woken = timing_histogram(18.0)
        return found

    def timing_histogram(us: float) -> object:
        return histogram.Histogram.of(np.full(9, us))

    def fly(*given: object, cpu: int | None = None) -> None:
        order.append("loop" if cpu is None else f"loop on {cpu}")
        if cpu is not None:
            given[3]()  # ready
        if len(given) > 4:
            for i in range(3):
                writer.mib += 64
                given[4](turns.Lag(float(i), 100))

    def wake_up(*_: object) -> object:
        order.append("cyclictest")
        return turn(20.0, 1)

    def waking_up(*_: object, cpu: int) -> object:
        order.append(f"cyclictest on {cpu}")
        return nullcontext(lambda: turn(20.0, 1))

    monkeypatch.setattr(timing, "fly", fly)
    monkeypatch.setattr(timing, "read", lambda _: turn(1.0, 1))
    monkeypatch.setattr(timing, "wake_up", wake_up)
    monkeypatch.setattr(timing, "waking_up", waking_up)
    return timing


def test_timing_without_cyclictest_is_refused_or_of_the_loop_alone(timing, monkeypatch) -> None:
    monkeypatch.setattr(timing.shutil, "which", lambda _: None)
    with pytest.raises(SystemExit, match="no cyclictest to compare with"):
        list(timing.measure(True))
    assert not timing.order
    figures = list(timing.measure(True, alone=True))
    found = by_key(figures)
    assert len(found) == len(figures)
    assert found["lateness_p99_us_10khz"] == 1.0
    assert found["written_mib_s_busy"] == 64.0
    assert found["recorder_cpu_10khz"] == 0.1
    assert found["late_ratio_1khz"] is found["cyclictest_p50_us_1khz"] is None
    assert met(figures)["late_ratio_1khz"] == "not asked"
    assert met(figures)["lateness_p99_us_10khz"] == "not asked"
    assert set(timing.order) == {"loop"}


def test_timing_has_contenders_swap_their_turns_and_asks_of_a_quiet_machine(timing) -> None:
    figures = list(timing.measure(False, only=["10khz"]))
    in_turns = ["cyclictest", "loop", "loop", "cyclictest"] * 6
    assert timing.order == in_turns  # one late in each of twelve rounds: those are enough
    found = met(figures)
    assert found["lateness_p99_us_10khz"] == found["lateness_p999_us_10khz"] == "met"
    assert found["median_ratio_10khz"] == "met"
    # Of wake-ups: what is left of the loop's after its spin would pass whatever the kernel does.
    assert by_key(figures)["median_ratio_10khz"] == 0.9
    assert by_key(figures)["wake_up_p50_us_10khz"] == 18.0
    assert by_key(figures)["lateness_p50_us_10khz"] == 1.0
    assert by_key(figures)["rounds_10khz"] == 12


def test_both_at_once_swap_their_processors(timing, monkeypatch) -> None:
    monkeypatch.setattr(timing.os, "sched_getaffinity", lambda _: {5, 3, 9})
    figures = list(timing.measure(False, only=["together"]))
    turns = [{"loop on 3", "cyclictest on 5"}, {"loop on 5", "cyclictest on 3"}] * 6
    assert [set(timing.order[k : k + 2]) for k in range(0, 24, 2)] == turns
    assert len(timing.order) == 24
    assert by_key(figures)["late_ratio_together"] > 1.0
    assert met(figures)["failed_rounds_together"] == "met"


def test_both_at_once_takes_two_processors(timing, monkeypatch, capsys) -> None:
    monkeypatch.setattr(timing.os, "sched_getaffinity", lambda _: {3})
    assert not list(timing.measure(False, only=["together"]))
    assert "expected 2 processors, found 1" in capsys.readouterr().err


def test_a_round_that_fails_is_counted_and_none_is_repeated(timing, monkeypatch) -> None:
    ends = iter([*[DaemonError("in fault LATE: x")] * 2, None, KeyboardInterrupt()])
    fly = timing.fly

    def failing(*given: object) -> object:
        if (error := next(ends, None)) is not None:
            raise error
        return fly(*given)

    monkeypatch.setattr(timing, "fly", failing)
    stopped = timing.measure(False, only=["1khz"])
    assert next(stopped).value == 3  # rounds that there are, to be told
    with pytest.raises(KeyboardInterrupt):
        list(stopped)
    figures = list(timing.measure(False, only=["1khz"]))  # carries on
    found = by_key(figures)
    assert (found["failed_rounds_1khz"], met(figures)["failed_rounds_1khz"]) == (2, "missed")
    assert found["rounds_1khz"] == 14
    flown = len(timing.order)
    assert by_key(timing.measure(False, only=["1khz"])) == found
    assert len(timing.order) == flown


def test_rounds_that_all_fail_end_the_run(timing, monkeypatch) -> None:
    def failing(*_: object) -> object:
        raise subprocess.TimeoutExpired("cyclictest", 90.0)

    monkeypatch.setattr(timing, "wake_up", failing)
    with pytest.raises(RuntimeError, match=r"3 rounds in a row failed.*cyclictest"):
        list(timing.measure(False))
    figures = list(timing.measure(False, only=["busy"]))
    assert by_key(figures)["failed_busy"] == 1
    assert met(figures)["lost_rows_busy"] == "not asked"


def test_a_flight_beside_a_busy_disk_stands_whatever_comes_after_it(timing, monkeypatch) -> None:
    wake_up, ends = timing.wake_up, iter([None, OSError("no more")])

    def failing(*given: object) -> object:
        if (error := next(ends)) is not None:
            raise error
        return wake_up(*given)

    monkeypatch.setattr(timing, "wake_up", failing)
    figures = list(timing.measure(False, only=["busy"]))
    assert met(figures)["failed_busy"] == "missed"
    assert met(figures)["lost_rows_busy"] == "met"
    assert by_key(figures)["cyclictest_late_share_busy"] == pytest.approx(1 / 9)


def test_the_slowest_seconds_of_a_disk_are_found() -> None:
    slowest = timing_figures.slowest
    written = [(0.0, 0), (1.0, 10), (3.0, 20), (4.0, 20), (5.0, 22), (6.0, 40)]
    assert slowest(written, 2) == 1.0
    assert slowest(written, 5) == pytest.approx(40 / 6)
    assert slowest(written[:2], 10) is None


def test_nothing_late_on_either_side_is_no_ratio_to_ask_for() -> None:
    shares = ratio_of_shares
    quiet = [shares.Round(0, 30_000, 0, 30_000)] * 20
    assert shares.ratio_95(quiet).met is shares.Met.NOT_ASKED
    assert shares.ratio_95([shares.Round(0, 30_000, 40, 30_000)] * 20).met is shares.Met.YES


def test_what_is_cut_off_is_dropped_and_the_rest_stays_on_disk(tmp_path: Path) -> None:
    file = tmp_path / "kept.jsonl"
    kept = kept_results
    kept.Kept(file).add({"section": "1khz"})
    whole = file.read_text()
    file.write_text(whole + '{"section": "1')
    assert len(kept.Kept(file).of("1khz")) == 1
    assert file.read_text() == whole
    before = file.stat().st_ino
    kept.Kept(file)
    assert file.stat().st_ino == before, "what is whole is not written again"


def test_logs_of_a_run_that_was_killed_are_removed(timing, tmp_path: Path) -> None:
    dead = subprocess.Popen(["true"])
    dead.wait()
    for pid in (dead.pid, os.getpid()):
        (tmp_path / f"flight-{pid}-x").mkdir()
    timing._clean(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [f"flight-{os.getpid()}-x"]
