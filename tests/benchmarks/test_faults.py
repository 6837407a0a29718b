"""The fault benchmark counts what was asked of it: what fails, is tried again, or is left out."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from levid.benchmarks.daemon import (
    fault_actions,
    fault_figures,
    fault_list,
    fault_logs,
    fault_rig,
    fault_trial,
)
from levid.benchmarks.daemon import faults as fault_trials


@pytest.fixture(scope="module")
def faults() -> ModuleType:
    return fault_trials


def trial(fault: str, **came: object) -> object:
    return fault_trial.Trial("serial", 0, fault, flew=True, injected=True, **came)


def by_key(trials: list[object]) -> dict[str, float]:
    found = fault_figures.figures(trials, len(trials), 0)
    return {figure.key: figure.value for figure in found}


def test_the_device_s_own_timeout_counts_only_where_the_loop_cannot_end_it() -> None:
    timeout = fault_rig.EXPIRE_CYCLES
    assert timeout > 2 * fault_list.SOON  # in time is the loop's doing
    trials = [
        trial("trip", cycles=3),
        trial("drop", cycles=4),
        trial("drop", cycles=timeout),
        trial("drop", cycles=None),
        trial("loop killed", cycles=timeout),
        trial("bus-off", cycles=timeout + 2),
    ]
    found = by_key(trials)
    assert (found["within_3"], found["within_3_trip"], found["within_3_drop"]) == (1 / 4, 1, 0)
    assert (found["within_all"], found["within_promise"]) == (1 / 6, 2 / 6)
    assert "within_3_loop_killed" not in found
    assert (found["shows_late"], found["slowest_stop"], found["stopped"]) == (
        0, timeout + 2, 5 / 6,
    )  # fmt: skip


def test_what_shows_after_a_while_is_bounded_from_there() -> None:
    lists = fault_list
    late = {name: k.shows for name, k in lists.kinds("serial").items() if k.shows}
    assert set(late) == {"frozen", "push", "tilt", "heat", "supervisor stopped"}
    for name, shows in late.items():
        most = shows + lists.SOON
        found = by_key([trial(name, cycles=most), trial(name, cycles=most + 1)])
        assert found["within_3"] == found["within_promise"] == 1 / 2
        assert found["shows_late"] == 2


def test_bounds_are_those_of_the_rig_that_is_flown(tmp_path: Path) -> None:
    lists, rigs = fault_list, fault_rig
    limits = rigs.rig_of("serial", tmp_path)["limits"]
    cycle_s = 1.0 / rigs.RATE_HZ
    # 40 N on 7 kg and rods of 2600 N/m; 0.55 N m on 195 N m/rad and 0.058 kg m2.
    fallen_m = 40.0 / 2600.0 * (1.0 - np.cos((2600.0 / 7.0) ** 0.5 * lists._PUSH_SHOWS * cycle_s))
    assert fallen_m > limits["gap_m"]
    swing_rad = 0.55 / 195.0 * (1.0 - np.cos((195.0 / 0.058) ** 0.5 * np.arange(10) * cycle_s))
    assert swing_rad[: lists._TILT_SHOWS + 1].max() > limits["tilt_rad"]
    carried = 7.8**2 + 7.0**2
    passes_s = limits["coil_time_constant_s"] * np.log(
        carried / (carried - limits["coil_rms_n"] ** 2)
    )
    assert passes_s + 0.1 <= lists._HEAT_SHOWS * cycle_s < passes_s + 0.15


def test_a_loop_that_was_held_up_has_its_three_cycles_from_where_it_runs_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    deeds = fault_actions
    sent: list[object] = []
    monkeypatch.setattr(deeds.os, "kill", lambda _, number: sent.append(number))
    monkeypatch.setattr(deeds.time, "sleep", lambda _: sent.append("held"))

    class Held:
        def forced_periods(self) -> int:
            sent.append("looked")
            return 107

    done = deeds._hold_loop_up(Held(), {"pids": {"loop": 1}})
    assert done == deeds.Done(since=107)
    assert sent == [deeds.signal.SIGSTOP, "held", "looked", deeds.signal.SIGCONT]
    assert fault_list.kinds("serial")["loop held up"].most_cycles == 3


def test_names_of_both_lists_count_together() -> None:
    found = by_key([
        trial("trip", cycles=1, named=True),
        trial("drop", cycles=1),
        trial("recorder killed", told=True),
        trial("disk full", told=False),
        trial("socket flooded"),  # without a word for it
    ])  # fmt: skip
    assert (found["named"], found["told"], found["right_name"]) == (1 / 2, 1 / 2, 2 / 5)


def test_only_what_the_loop_cannot_end_is_left_to_the_device() -> None:
    lists = fault_list
    for bus in lists.BUSES:
        own = {name for name, kind in lists.kinds(bus).items() if kind.own_timeout}
        unheard = {"bus-off", "disconnect", "drop-setpoints", "host's end lost"}
        assert own == unheard | {"loop killed", "loop stopped"}


def test_trial_that_failed_counts_against_what_was_asked() -> None:
    trials = [
        trial("trip", cycles=1, named=True, recorded=True, rested=True, clears=1),
        trial("trip", failed="DaemonError", named=True),
        trial("disk full", undisturbed=True, told=True, rested=True),
        trial("disk full", failed="RuntimeError", told=False),
        fault_trial.Trial("serial", 0, "stop", why_not="it is not at rest"),
        fault_trial.Trial("serial", 0, "disk full", skipped="no right"),
        fault_trial.Trial("serial", 9, "", flew=True),
    ]
    found = by_key(trials)
    assert (found["faults"], found["not_injected"], found["skipped"]) == (4, 1, 1)
    assert (found["failed"], found["flew"]) == (2, 5 / 6)
    assert found["stopped"] == found["recorded"] == found["within_3"] == found["usable"] == 0.5
    assert found["undisturbed"] == found["told"] == 0.5
    assert found["named"] == 1.0


def test_events_without_a_word_and_floods_are_told() -> None:
    look = fault_logs.LogLook
    found = by_key([
        trial("socket flooded", answers=400, asked_s=2.0, look=look(rows=100, late=2)),
        trial("client gone, land", look=look(rows=200, late=1)),
        trial("memory pressure", stalled_us=3000),
        trial("recorder killed", told=True),
    ])  # fmt: skip
    assert (found["not_named"], found["told"], found["flood"]) == (3, 1.0, 200.0)
    assert (found["late_flooded"], found["late_calm"], found["stalled"]) == (0.02, 0.005, 3.0)


def test_what_is_left_out_changes_no_other_trial() -> None:
    lists = fault_list
    for bus in lists.BUSES:
        count = len(lists.kinds(bus))
        cases = [lists.case_of(bus, number) for number in range(3 * count)]
        for begin in range(0, 3 * count, count):  # every kind once a pack
            assert {c.kind for c in cases[begin : begin + count]} == set(lists.kinds(bus))
        assert cases == [lists.case_of(bus, number) for number in range(3 * count)]
        assert [c.kind for c in cases[:count]] != [c.kind for c in cases[count : 2 * count]]
        for case in cases:
            kind = lists.kinds(bus)[case.kind]
            assert case.state in kind.states
            assert bool(case.line) == (kind.line is not None)
        states = {c.state for c in cases if c.kind == "drop"} | {c.state for c in cases}
        assert states == set(lists.FLYING)


def test_every_kind_is_done_by_somebody_and_every_untested_name_is_told() -> None:
    lists, deeds = fault_list, fault_actions
    for bus in lists.BUSES:
        for name, kind in lists.kinds(bus).items():
            done = (kind.line is not None, name in deeds.DEEDS, name in deeds.HARMLESS)
            assert sum(done) == 1, name
            assert kind.must_stop == (name not in deeds.HARMLESS)
    assert set(lists.untested()) == {
        "COMPUTATION", "DRIVER", "SIMULATION", "SELF_TEST", "SEQUENCE", "COIL_CHECK",
    }  # fmt: skip


class Rig:
    """Stands for a rig."""

    started = 0

    def __init__(self, bus: str, folder: Path) -> None:
        self.bus, self.folder, self.flight = bus, folder, folder
        type(self).started += 1

    def close(self) -> None: ...


def test_run_goes_on_behind_what_fails_and_where_it_stopped(
    faults: ModuleType, tmp_path: Path, monkeypatch
) -> None:
    tried: list[int] = []

    def attempt(_: Rig, case, one) -> None:
        tried.append(case.number)
        if case.number == 3 and tried.count(3) == 1:
            raise OSError("expected an answer")
        if case.number == 5:
            one.why_not = "it is not at rest"
            return
        if case.number == 7 and tried.count(7) == 1:
            raise KeyboardInterrupt
        if case.number == 9 and tried.count(9) == 1:
            raise KeyError("whatever it is")
        if case.number == 4 and case.bus == "serial" and tried.count(4) == 2:
            raise KeyboardInterrupt  # the other bus is whole by now
        one.flew, one.injected = True, bool(case.kind)

    monkeypatch.setattr(faults, "KEPT", tmp_path)
    monkeypatch.setattr(faults, "Rig", Rig)
    monkeypatch.setattr(faults, "attempt", attempt)
    Rig.started = 0
    with pytest.raises(KeyboardInterrupt):
        faults.measure(True)
    (file,) = tmp_path.glob("*.jsonl")
    whole = file.read_text()
    assert json.loads(whole.splitlines()[-1]) == {"begun": 7}
    file.write_text(whole + '{"bus": "canfd", "num')  # a write that was cut short
    with pytest.raises(KeyboardInterrupt):
        faults.measure(True)
    found = {figure.key: figure.value for figure in faults.measure(True)}
    first = [0, 1, 2, 3, 3, 4, 5, 5, 5, 6, 7, 7, 8, 9, 9, *range(10, 21)]
    second = [0, 1, 2, 3, 4, 4, 5, 5, 5, *range(6, 21)]
    assert tried == [*first, *second]
    # One a bus, one behind each trial that failed and each that never lifted off, one wherever it
    # carries on.
    assert Rig.started == 2 + 2 + 2 + 2
    assert (found["asked"], found["faults"], found["failed"]) == (40, 38, 2)
    assert (found["not_injected"], found["interrupted"]) == (8, 2)
    for number in (1, 2):  # a whole run is not carried on, and none is written over
        before = len(tried)
        faults.measure(True)
        assert len(tried) == before + 46
        assert len(list(tmp_path.glob(f"*.before-{number}.jsonl"))) == 2


def test_faults_of_some_kinds_are_flown_apart_from_all(
    faults: ModuleType, tmp_path: Path, monkeypatch
) -> None:
    tried: list[str] = []

    def attempt(_: Rig, case, one) -> None:
        tried.append(case.kind)
        one.flew, one.injected = True, True

    monkeypatch.setattr(faults, "KEPT", tmp_path)
    monkeypatch.setattr(faults, "Rig", Rig)
    monkeypatch.setattr(faults, "attempt", attempt)
    for times in (1, 2):  # the second time anew
        found = {figure.key: figure.value for figure in faults.measure(False, ["nan-axis"])}
        assert set(tried) == {"nan-axis"}  # which serial alone has
        assert len(tried) == times * found["asked"] == times * found["faults"] > 10
    (first,) = tmp_path.glob("*.before-1.jsonl")
    assert first.name.startswith("serial-500-nan-axis-")
    with pytest.raises(SystemExit, match="among the first 20"):
        faults.measure(True, ["no such thing"])


def test_rig_that_never_lifts_off_is_given_up(
    faults: ModuleType, tmp_path: Path, monkeypatch
) -> None:
    tried: list[int] = []

    def attempt(_: Rig, case, one) -> None:
        tried.append(case.number)
        one.why_not = "it is not at rest"

    monkeypatch.setattr(faults, "KEPT", tmp_path)
    monkeypatch.setattr(faults, "Rig", Rig)
    monkeypatch.setattr(faults, "attempt", attempt)
    found = {figure.key: figure.value for figure in faults.measure(True)}
    assert tried == [0, 0, 0, 1, 1, 1, 2, 2, 2] * 2
    assert (found["faults"], found["flew"]) == (0, 0.0)


def test_rig_that_does_not_start_ends_the_run_and_no_figure(
    faults: ModuleType, tmp_path: Path, monkeypatch
) -> None:
    class Dead(Rig):
        def __init__(self, *_: object) -> None:
            raise RuntimeError("the electronics did not start")

    monkeypatch.setattr(faults, "KEPT", tmp_path)
    monkeypatch.setattr(faults, "Rig", Dead)
    found = {figure.key: figure.value for figure in faults.measure(True)}
    assert (found["asked"], found["faults"], found["stopped"]) == (40, 0, 0.0)


def test_version_is_of_all_that_decides_a_trial(faults: ModuleType, monkeypatch) -> None:
    as_it_is = faults.version()
    monkeypatch.setattr(faults.os, "geteuid", lambda: 1000)
    assert faults.version() != as_it_is or as_it_is.endswith("user")
