"""Run one fault trial: fly, inject the fault, watch the force, and bring the rig to rest."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

from levid.benchmarks.daemon.fault_actions import ENDING, HARMLESS, Expected, reason_to_skip
from levid.benchmarks.daemon.fault_flight import Flight, NotInjectedError, come_to_rest, lift_off
from levid.benchmarks.daemon.fault_list import FLYING, HOLDING, Case, Kind, kinds
from levid.benchmarks.daemon.fault_logs import LogCheck, check_logs, find_recording
from levid.benchmarks.daemon.fault_rig import BEFORE_FAULT_S, GIVE_UP_S, Rig
from levid.daemon.client import DaemonError

_OBSERVED_CYCLES = 100
_WATCHED_S = 1.0
"""Time after a fault in which force must stay zero; it is checked again at rest."""
_REPORTED_S = 10.0


@dataclass
class Trial:
    """Result of one trial.

    skipped: why this machine cannot run it. not_injected: why the fault did not happen. cycles:
    periods with force after the fault, None if the force did not end. found: the daemon's name of
    the fault. reported: whether the status shows a harmless fault, None if it has no field for it.
    clears: requests to clear until rest; None if it did not come to rest.
    """

    case: Case
    skipped: str = ""
    not_injected: str = ""
    injected: bool = False
    cycles: int | None = None
    force_again: bool = False
    found: str = ""
    recorded: bool = False
    undisturbed: bool = False
    reported: bool | None = None
    clears: int | None = None
    logs: LogCheck = field(default_factory=LogCheck)
    failed: str = ""
    wrong: list[str] = field(default_factory=list)

    @property
    def kind(self) -> Kind:
        """The kind of fault."""
        return kinds(self.case.bus)[self.case.kind]

    @property
    def named(self) -> bool:
        """Whether the daemon gave the fault an expected name."""
        return self.found in self.kind.named


def attempt(rig: Rig, case: Case) -> Trial:
    """Fly the trial and bring the rig to rest; an error is stored in the trial."""
    trial = Trial(case, skipped=reason_to_skip(rig, case.kind))
    if trial.skipped:
        return trial
    home = rig.small if case.kind == "disk full" and rig.small is not None else rig.folder
    flight: Flight | None = None
    ended: int | None = None
    try:
        try:
            flight = lift_off(rig, case, home)
            if trial.kind.must_stop:
                ended = _must_stop(rig, trial, flight)
            else:
                _must_not_disturb(rig, trial, flight)
        except NotInjectedError as error:
            trial.not_injected = str(error)
        finally:
            if flight is not None:
                flight.hang_up()
        trial.clears = come_to_rest(rig)
        if trial.clears > 1:
            trial.wrong.append(f"{trial.clears} requests to clear")
        trial.force_again = ended is not None and rig.forced_periods() > ended
        if trial.force_again:
            trial.wrong.append("force acts again")
    except (DaemonError, RuntimeError, OSError) as error:
        trial.failed = f"{type(error).__name__}: {error}"
        trial.wrong.append(trial.failed)
    return trial


def _must_stop(rig: Rig, trial: Trial, flight: Flight) -> int:
    """Inject a fault and watch the force; return the periods with force until its end."""
    case, recorded, cycle = trial.case, rig.recordings(), flight.status["cycle"]
    line = case.line or "status"
    before = rig.say(line)
    if before.get("did") != line or not any(before["acting_n"]):
        raise NotInjectedError(before.get("error", "no force acts"))
    action = ENDING[case.kind](rig, flight.status) if not case.line else None
    since = action.since if action and action.since is not None else before["forced_periods"]
    try:
        give_up_s = time.monotonic() + GIVE_UP_S
        while (forces := rig.forces()) and time.monotonic() < give_up_s:
            time.sleep(0.005)
        ended = rig.forced_periods()
        cycles = max(ended - since, 0)
        if case.line and cycles < 1:
            raise NotInjectedError("force had ended before the fault")
        trial.injected, trial.cycles = True, None if forces else cycles
        if forces or cycles > trial.kind.most_cycles:
            trial.wrong.append(f"force for {cycles} cycles, expected {trial.kind.most_cycles}")
        time.sleep(_WATCHED_S)
    finally:
        if action and action.undo is not None:
            action.undo()
    _check_names(rig, trial, recorded)
    _check_logs(rig, trial, flight, cycle)
    return ended


def _check_names(rig: Rig, trial: Trial, before: set[Any]) -> None:
    """Read the daemon's name of the fault from its status and its flight recording."""
    recording = find_recording(rig.recordings, before, _REPORTED_S, BEFORE_FAULT_S)
    trial.found = recording.name
    trial.recorded = recording.name in trial.kind.named and not recording.wrong
    trial.wrong += recording.wrong
    if rig.daemon_is_there:
        status = rig.until(lambda s: s["fault_log"] == str(recording.path), _REPORTED_S)
        trial.recorded = trial.recorded and status is not None
        trial.found = str((status or rig.ask("status"))["fault"])
    if not trial.named or not trial.recorded:
        trial.wrong.append(f"status reports {trial.found}, recording {recording.name}")


def _must_not_disturb(rig: Rig, trial: Trial, flight: Flight) -> None:
    """Cause a harmless fault, fly on for a while and land."""
    with HARMLESS[trial.case.kind](rig, flight) as expected:
        trial.injected = True
        cycle = until = rig.ask("status")["cycle"]

        def over(status: dict[str, Any]) -> bool:
            nonlocal until
            until = status["cycle"] if status["state"] in FLYING else until
            return bool(status["cycle"] > cycle + _OBSERVED_CYCLES or status["fault"] != "NONE")

        flown = rig.until(over)
        trial.reported = rig.until(expected.reported, _REPORTED_S) is not None
        status = rig.ask("status")
        may_fly_on = flight.status["state"] in HOLDING and not expected.lands
        allowed = HOLDING if may_fly_on else ("LANDING", "IDLE")
        trial.undisturbed = flown is not None and status["state"] in allowed
        rig.ask("land")
        landed = rig.until(lambda s: s["state"] in ("IDLE", "FAULT"))
        trial.undisturbed = bool(trial.undisturbed and landed and landed["fault"] == "NONE")
        if not (trial.undisturbed and trial.reported):
            wrong = f"{status['state']}, {status['fault']}: {status['detail']}"
            trial.wrong.append(wrong if not trial.undisturbed else "not in the status")
        _check_logs(rig, trial, flight, until, expected)


def _check_logs(
    rig: Rig, trial: Trial, flight: Flight, until: int, expected: Expected | None = None
) -> None:
    """Check the logs; a recorder that was just started has some seconds to catch up."""
    if not rig.logs_are_closed():
        trial.wrong.append("the recorder does not close the log")
    cut = trial.case.kind in ("disk full", "recorder killed")
    if expected is not None and expected.cut_at is not None:
        until = expected.cut_at
    give_up_s = time.monotonic() + _REPORTED_S
    while True:
        check = check_logs(rig.logs(), flight.began, until, flight.status["rate_hz"], cut)
        if not check.wrong or time.monotonic() > give_up_s:
            break
        time.sleep(0.2)
    trial.logs = check
    trial.wrong += check.wrong
