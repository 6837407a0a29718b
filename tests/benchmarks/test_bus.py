"""The benchmark of the buses: what it counts as late, failed or agreeing is what it says."""

from __future__ import annotations

import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from levid.benchmarks.bus import (
    bus_rigs,
    codecs,
    cycle_cost,
    device_faults,
    fault_messages,
    lateness,
    plant_agreement,
    serial_transaction,
)
from levid.benchmarks.bus import flights as bus_flights
from levid.benchmarks.harness import empty_loop, kept_results
from levid.drivers.base import DriverError, LinkError, SensorError, StaleError
from levid.wire.bus_budget import check_budget

MS = 1e-3


def by_key(figures) -> dict[str, float]:
    return {figure.key: figure.value for figure in figures}


@pytest.fixture
def flights(monkeypatch) -> ModuleType:
    """The flights without a daemon: `ends` is what comes of each."""
    flights = bus_flights

    @contextmanager
    def nobody(*_: object):
        yield SimpleNamespace(pid=1)

    class Client:
        def __init__(self, _: Path) -> None: ...
        def __enter__(self) -> Client:
            return self

        def __exit__(self, *_: object) -> None: ...
        def excite(self, *_: object) -> SimpleNamespace:
            end = next(flights.ends)
            if isinstance(end, BaseException):
                raise end
            return end

    monkeypatch.setattr(flights, "Client", Client)
    monkeypatch.setattr(flights, "running", nobody)
    monkeypatch.setattr(flights, "electronics_on", nobody)
    monkeypatch.setattr(flights.real_time, "hurry", lambda *_: True)
    complete = SimpleNamespace(complete=True)
    torn = SimpleNamespace(complete=False, problem="cut off")
    monkeypatch.setattr(flights, "read_log", lambda p: torn if p.name == "torn" else complete)
    return flights


def test_flights_that_ended_otherwise_are_counted_by_what_ended_them(
    flights, tmp_path: Path
) -> None:
    flights.ends = iter(
        [
            flights.DaemonError("the flight ended: fault GAP: 0.9 mm"),
            SystemExit("the daemon did not become idle"),
            SimpleNamespace(records=(tmp_path / "a",)),
        ]
    )
    assert flights.flown("serial", tmp_path, "") == ((tmp_path / "a",), ["GAP", "NOT_IDLE"])
    flights.ends = iter([SimpleNamespace(records=(tmp_path / "torn",))] * 3)
    assert flights.flown("serial", tmp_path, "") == ((), ["torn_cut_off"] * 3)
    # Who ends the benchmark ends it.
    flights.ends = iter([SystemExit(143)])
    with pytest.raises(SystemExit):
        flights.flown("serial", tmp_path, "")


def test_what_ended_flights_is_among_the_figures(flights, monkeypatch) -> None:
    monkeypatch.setattr(flights, "flown", lambda *_: ((), ["GAP", "LATE", "GAP"]))
    found = by_key(flights._of_one("serial", "", None, 10.0))
    assert found == {
        "serial_attempts": 3, "serial_ended_by_GAP": 2, "serial_ended_by_LATE": 1,
        "serial_identified": 0,
    }  # fmt: skip


def test_short_session_is_the_papers_at_one_position() -> None:
    steps = bus_flights.yaml.safe_load(bus_flights._short())["steps"]
    names = [step["record"]["name"] for step in steps if "record" in step]
    assert names == ["middle-psi", "middle-theta", "middle-z"]
    assert steps[0] == {"levitate": {}}


def plants(agreement: ModuleType, rng: np.random.Generator, gain: float = 1.0, delay_s: float = 0):
    """P of a mass with a relative noise of 1 %, the phase of a delay, and a gain."""
    freq_hz, shape = np.geomspace(1.0, 64.0, 50), (3, 50, 3, 3)
    true = np.broadcast_to(1.0 / freq_hz[None, :, None, None] ** 2, shape)
    deviation = 0.01 * true
    noise = rng.normal(size=(*shape, 2)) @ [1, 1j] * deviation / np.sqrt(2)
    late = gain * np.exp(-2j * np.pi * freq_hz * delay_s)[None, :, None, None]
    P = true * late + noise
    return agreement.Plants(freq_hz, true * late, P, deviation, 1)


def test_plants_that_are_the_same_agree_in_as_many_entries_as_they_should() -> None:
    agreement, rng = plant_agreement, np.random.default_rng(1)
    found = [
        agreement.difference(plants(agreement, rng), plants(agreement, rng)) for _ in range(50)
    ]
    # 450 entries of 50 flights, a part of a parameter fitted to them: 0.15 % is the standard error.
    assert np.mean([one.agree for one in found]) == pytest.approx(0.95, abs=0.006)
    assert np.mean([one.entry_se for one in found]) == pytest.approx(0.01 * np.sqrt(2), rel=0.01)
    for of, se in (("gain", "gain_se"), ("delay_s", "delay_se_s")):
        off = [getattr(one, of) / getattr(one, se) for one in found]
        assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.35)


def test_delay_of_a_bus_is_taken_out_and_a_gain_is_not() -> None:
    agreement, rng = plant_agreement, np.random.default_rng(2)
    reference = plants(agreement, rng)
    late = agreement.difference(plants(agreement, rng, delay_s=50e-6), reference)
    assert late.delay_s == pytest.approx(50e-6, abs=4 * late.delay_se_s)
    assert late.agree > 0.92
    assert late.ho_kalman < 0.005  # but for what the delay is not known by
    assert abs(late.gain) < 4 * late.gain_se
    strong = agreement.difference(plants(agreement, rng, gain=1.005), reference)
    assert strong.gain == pytest.approx(0.005, abs=4 * strong.gain_se)
    assert strong.gain > 4 * strong.gain_se
    assert strong.agree > 0.9  # which no single frequency shows


class Clock:
    """A clock whose time is what waits and loops say that has passed."""

    now_s = 0.0

    def __init__(self, _: float) -> None:
        self.cycle, self.skipped = -1, 0

    def start(self) -> None: ...

    def wait(self) -> float:
        due_s = (self.cycle + 1) * MS
        late_s = max(Clock.now_s - due_s, 0.0)
        self.skipped = int(late_s // MS)
        self.cycle += 1 + self.skipped
        Clock.now_s = max(Clock.now_s, due_s)
        return late_s


def test_cycle_that_ends_late_counts_though_the_next_begins_in_time(monkeypatch) -> None:
    stretch = empty_loop
    monkeypatch.setattr(stretch, "RealClock", Clock)
    monkeypatch.setattr(stretch, "monotonic", lambda: Clock.now_s)
    monkeypatch.setattr(stretch, "apply_realtime", lambda _: [])
    monkeypatch.setattr(stretch, "_WARM_UP", 1)
    Clock.now_s = 0.0
    took_s = {12: 1.2 * MS, 15: 3.5 * MS}

    def loop(cycle: int) -> bool:
        Clock.now_s += took_s.get(cycle, 0.1 * MS)
        return cycle != 13

    found = stretch.timed(loop, 1 / MS, 20, 10)
    # Of 12 the end, of 15 the end and, two periods skipped, the begin of the next: 18.
    assert (found.begun_late, found.ended_late, found.stale) == (1, 3, 1)
    assert found.cycles == 20
    assert found.last == 10 + 21 + 2


def test_stretch_that_breaks_off_is_counted_and_begun_anew(tmp_path: Path, monkeypatch) -> None:
    late, empty = lateness.Stretch(9, 1, 1, 1, 0), lateness.Stretch(9, 1, 1, 0, 0)
    turn = {"bus": late, "beside": empty, "empty": empty}
    ends = iter([turn, LinkError("gone"), turn, *[LinkError("gone")] * 3])

    def one_round(*_: object) -> object:
        end = next(ends)
        if isinstance(end, LinkError):
            raise end
        return end

    monkeypatch.setattr(lateness, "one_round", one_round)
    kept = kept_results.Parts(tmp_path / "run.jsonl")
    found = by_key(lateness.lateness_figures(1.0, {"serial": 3}, kept))
    assert (found["serial_broken_off"], found["serial_cycles"]) == (4, 18)
    ends = iter([LinkError("gone")] * 3)
    kept = kept_results.Parts(tmp_path / "other.jsonl")
    figures = lateness.lateness_figures(1.0, {"serial": 1}, kept)
    assert by_key(figures)["serial_broken_off"] == 3
    # What lasted for no round is not punctual.
    assert [str(f.met) for f in figures if f.met] == ["missed"] * 4


def test_round_counts_each_loop_with_its_own_cycles() -> None:
    turn = {
        "bus": lateness.Stretch(1000, 4, 8, 5, 0),
        "beside": lateness.Stretch(1000, 4, 4, 0, 0),
        "empty": lateness.Stretch(1000, 2, 2, 0, 0),
    }
    found = by_key(lateness.figures_of("serial", [turn] * 4))
    assert found["serial_begun_late_share"] == 0.004
    assert found["serial_ended_late_share"] == 0.008
    assert found["serial_ended_late_empty_share"] == 0.004
    assert found["serial_ended_late_alone_empty_share"] == 0.002
    assert found["serial_stale_share"] == 0.005
    assert found["serial_ended_late_ratio_low"] < 2.0 < found["serial_ended_late_ratio_95"]
    assert found["serial_ended_late_alone_ratio_low"] < 4.0
    assert found["serial_ended_late_alone_ratio_95"] > 4.0


def test_empty_loop_runs_beside_for_as_long_as_the_one_it_watches() -> None:
    stretch = empty_loop
    with stretch.beside(1000.0, 50) as counts:
        found = stretch.timed(lambda _: True, 1000.0, 50, 0)
        witness = counts()
    assert witness.cycles == found.cycles == 50
    assert witness.last >= 250


def test_run_that_was_stopped_carries_on_with_what_it_has(tmp_path: Path, capsys) -> None:
    kept, file = kept_results, tmp_path / "run.jsonl"
    first = kept.Parts(file)
    assert first.part("a", lambda: (1, 2)) == [1, 2]
    with file.open("a") as torn:
        torn.write('{"key": "b", "val')
    second = kept.Parts(file)
    assert "carries on behind 1 parts" in capsys.readouterr().err
    assert second.part("a", lambda: pytest.fail("measured twice")) == [1, 2]
    assert second.part("b", lambda: {"x": 3}) == {"x": 3}
    assert kept.Parts(file).part("b", lambda: pytest.fail("lost")) == {"x": 3}
    second.finish()
    assert kept.Parts(file).part("a", lambda: 4) == 4


def test_process_that_does_not_listen_is_ended_all_the_same(monkeypatch) -> None:
    rigs = bus_rigs
    monkeypatch.setattr(rigs, "_ENDS_S", 0.2)
    deaf = "import signal; signal.signal(15, signal.SIG_IGN); print('on', flush=True); input()"
    process = subprocess.Popen(
        [sys.executable, "-c", deaf], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"on\n"
    rigs.end(process)
    assert process.returncode == -9
    for pipe in (process.stdin, process.stdout):
        assert pipe is not None
        pipe.close()


def test_codecs_are_timed_only_where_both_find_the_same(monkeypatch) -> None:
    found = by_key(codecs.codec_figures(100))
    assert found["canfd_codec_us"] == found["canfd_encode_us"] + found["canfd_decode_us"]
    # A decoder that refuses is quick.
    monkeypatch.setattr(codecs.ValueFrames, "finish", lambda *_: "no")
    with pytest.raises(AssertionError):
        codecs.codec_figures(100)


def test_cycles_without_an_answer_are_no_cycles_that_are_timed() -> None:
    cycles = cycle_cost
    times, stale = cycles._fresh_cycles(lambda k: k % 4 > 0, 20)
    assert len(times) + stale == 20
    assert stale >= 1


def test_serial_transaction_that_is_not_answered_rightly_ends_the_run() -> None:
    transaction = serial_transaction
    with transaction.device() as path:
        driver = transaction.Driver(path)
        try:
            driver()
            driver.readings.require()
            driver.readings.gap_m[3] += transaction.GAP_M
            with pytest.raises(AssertionError):
                driver.readings.require()
        finally:
            driver.close()


def test_fault_is_named_by_the_kind_of_error_and_by_its_words() -> None:
    words = fault_messages
    assert words.names(SensorError("sensors on x: sensor 4: no reading"), "stuck 4")
    assert not words.names(SensorError("sensors on x: sensor 5: no reading"), "stuck 4")
    assert not words.names(StaleError("sensors on x: sensor 4: no reading"), "stuck 4")
    assert not words.names(None, "stuck 4")


def test_electronics_that_do_not_come_to_a_cycle_end_the_trial(monkeypatch) -> None:
    bus_faults = device_faults
    now_s = iter(range(100))
    monkeypatch.setattr(bus_faults.time, "monotonic", lambda: next(now_s))
    with pytest.raises(TimeoutError, match="at cycle 3, the host at 4"):
        bus_faults._wait_for(SimpleNamespace(cycle=3), 4)


def test_trial_that_failed_is_a_fault_that_was_not_named(monkeypatch, capsys) -> None:
    bus_faults = device_faults
    core, on_bus = bus_faults.core, bus_faults.bus_backend
    for owner, name in (
        (core, "_SILENT_PERIODS"), (on_bus, "_ANSWER_SHARE"), (on_bus, "_SETPOINTS_SHARE"),
    ):  # fmt: skip
        monkeypatch.setattr(owner, name, getattr(owner, name))

    def until_zero(bus: str, line: str) -> object:
        if line == "drop":
            raise TimeoutError("the electronics are at cycle 3")
        if line == "trip 3":
            return bus_faults.Played(2, 1, SensorError("sensor 4: no reading"))
        return bus_faults.Played(1, 0, _error(line))

    monkeypatch.setattr(bus_faults, "until_zero", until_zero)
    found = by_key(bus_faults.measure(True))
    n = 2 * len(bus_faults.EXPECTED)
    assert found["named"] == (n - 4) / n
    assert found["came_back"] == 2
    assert found["most_cycles"] == found["serial_drop_cycles"] == bus_faults.MOST_CYCLES
    assert "trip 3: not named: SensorError" in capsys.readouterr().err


def _error(line: str) -> DriverError:
    """Return an error with all the words that are expected of this fault."""
    (kind, *_), words = fault_messages.EXPECTED[line]
    return kind(words.partition("|")[0])


@pytest.mark.parametrize("name", ["can", "canfd", "canfd_udp", "canfd_virtual", "serial"])
def test_wire_carries_the_rigs_that_are_timed(name: str, tmp_path: Path) -> None:
    rig = bus_rigs.rig_on(name, tmp_path)
    assert check_budget(rig, tmp_path).cycle_s * rig.rate_hz <= 1.0
