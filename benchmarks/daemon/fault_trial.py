"""One trial: fly, bring a fault about, watch what follows, and be at rest again."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from levid.benchmarks.daemon.fault_actions import DEEDS, HARMLESS, Done, Seen, cannot
from levid.benchmarks.daemon.fault_flight import Flight, NotInjectedError, come_to_rest, lift_off
from levid.benchmarks.daemon.fault_list import FLYING, HOLDING, LAST, Case, Kind, kinds
from levid.benchmarks.daemon.fault_logs import Expected, LogLook, look_at_logs, recording_of
from levid.benchmarks.daemon.fault_rig import BEFORE_FAULT_S, GIVE_UP_S, Rig
from levid.daemon.client import DaemonError

OBSERVED_CYCLES = 100
_WATCHED_S = 1.0
"""For how long force must not act again, at least; it is looked at once more at rest."""
_TOLD_S = 10.0


@dataclass
class Trial:
    """What came of a fault.

    skipped: why it is left out on this machine. flew: whether it lifted off. injected: whether the
    fault came about; `why_not` says why not. cycles: periods with force from it on, or from where
    the loop could act on it; None where force did not end. came_back: periods with force after
    that. found: what the daemon calls it, and recorded: the flight recording as well. told: None
    where the daemon has no word for it. clears: how often `clear` was asked for, and clear_s how
    long it took; rested: whether that was enough. answers, asked_s: of a flood. stalled_us: what
    processes waited for memory. closed: whether the recorder was done with the flight's logs in
    time, and look: at them. failed: what kept the trial from its end. wrong: in words.
    """

    bus: str
    number: int
    fault: str
    line: str = ""
    state: str = ""
    skipped: str = ""
    flew: bool = False
    injected: bool = False
    why_not: str = ""
    cycles: int | None = None
    came_back: int = 0
    found: str = ""
    named: bool = False
    recorded: bool = False
    undisturbed: bool = False
    told: bool | None = None
    answers: int = 0
    asked_s: float = 0.0
    stalled_us: int = 0
    clears: int = 0
    clear_s: float = 0.0
    rested: bool = False
    closed: bool = True
    look: LogLook = field(default_factory=LogLook)
    failed: str = ""
    wrong: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Trial:
        """Return the trial that `plain` was, as asdict gave it."""
        return cls(**{**plain, "look": LogLook(**plain["look"])})

    @property
    def kind(self) -> Kind:
        """What was to happen; of the last trial nothing."""
        return kinds(self.bus).get(self.fault, Kind())

    @property
    def must_stop(self) -> bool:
        """Whether force had to end."""
        return self.kind.must_stop

    @property
    def must_not_disturb(self) -> bool:
        """Whether the flight had to go on."""
        return self.fault in HARMLESS


def attempt(rig: Rig, case: Case, trial: Trial) -> None:
    """Fly the trial, and bring the rig to rest whatever came of it; raises what goes wrong."""
    trial.skipped = cannot(rig, case.kind)
    if trial.skipped:
        return
    home = rig.small if case.kind == "disk full" and rig.small is not None else rig.folder
    flight: Flight | None = None
    ended: int | None = None
    try:
        flight = lift_off(rig, case, home)
        trial.flew = True
        if trial.must_stop:
            ended = _must_stop(rig, case, trial, flight)
        else:
            _must_not_disturb(rig, trial, flight)
    except NotInjectedError as error:
        trial.why_not = str(error)
    finally:
        if flight is not None:
            flight.hang_up()
    rest = come_to_rest(rig)
    trial.rested, trial.clears, trial.clear_s = True, rest.clears, rest.seconds
    if rest.clears > 1:
        trial.wrong.append(f"takes {rest.clears} clears: {rest.refused}")
    if ended is not None:
        trial.came_back = rig.forced_periods() - ended
        if trial.came_back:
            trial.wrong.append("force acts again")


def keep_what_is_wrong(rig: Rig, trial: Trial, folder: Path) -> None:
    """Take the trial's files away; where something was wrong, keep them in `folder`."""
    files = [path for path in (rig.flight, rig.folder / "faults") if path != rig.folder]
    if trial.wrong:
        for path in files:
            with contextlib.suppress(OSError, shutil.Error):
                to = folder / f"{trial.bus}-{trial.number}" / path.name
                shutil.copytree(path, to, dirs_exist_ok=True)
    for path in files:
        shutil.rmtree(path, ignore_errors=True)


def _must_stop(rig: Rig, case: Case, trial: Trial, flight: Flight) -> int:
    """Bring it about and watch the force; return the periods with one up to its end."""
    recorded, cycle = rig.recordings(), flight.status["cycle"]
    before = rig.say(case.line or "status")
    if not any(before.get("acting_n", ())):
        raise NotInjectedError("no force acts")
    if before.get("did") != (case.line or "status"):
        raise NotInjectedError(f"the electronics say: {before.get('error')}")
    done = DEEDS[case.kind](rig, flight.status) if not case.line else Done()
    since = before["forced_periods"] if done.since is None else done.since
    try:
        began_s = time.monotonic()
        while rig.forces() and time.monotonic() - began_s < GIVE_UP_S:
            time.sleep(0.005)
        ended = rig.forced_periods()
        cycles = max(ended - since, 0)
        if case.line and cycles < 1:
            raise NotInjectedError("force had ended before it came")
        trial.injected = True
        if rig.forces():
            trial.wrong.append(f"force after {GIVE_UP_S:g} s")
        else:
            trial.cycles, most = cycles, trial.kind.most_cycles
            if cycles > most:
                trial.wrong.append(f"takes {cycles} cycles")
        time.sleep(_WATCHED_S)
    finally:
        if done.undo is not None:
            done.undo()
    _look_at_names(rig, trial, recorded, cycle)
    _look_at_logs(rig, trial, flight, cycle)
    return ended


def _look_at_names(rig: Rig, trial: Trial, before: set[Path], since: int) -> None:
    """See what the daemon calls it, and its flight recording, which a dead one has left too."""
    found = recording_of(rig.recordings, before, since, _TOLD_S, BEFORE_FAULT_S)
    if rig.daemon_is_there:
        status = rig.until(lambda s: s["fault"] != "NONE", _TOLD_S)
        trial.found = str(status["fault"]) if status else "nothing"
        told = rig.until(lambda s: s["fault_log"] == str(found.path), _TOLD_S)
        if found.path is not None and told is None:
            trial.wrong.append("the status names another flight recording")
        trial.recorded = told is not None
    else:
        trial.found, trial.recorded = found.name, found.path is not None
    trial.named = trial.found in trial.kind.named
    trial.recorded = trial.recorded and not found.wrong and found.name in trial.kind.named
    trial.wrong += found.wrong
    if not trial.named:
        trial.wrong.append(f"is called {trial.found}")
    elif found.name != trial.found:
        trial.wrong.append(f"is recorded as {found.name}")


def _must_not_disturb(rig: Rig, trial: Trial, flight: Flight) -> None:
    """Do it and fly on for a while, land, and see whether anything else came of it."""
    if trial.fault == LAST:
        rig.ask("land")
        return
    with HARMLESS[trial.fault](rig, flight) as seen:
        trial.injected = True
        cycle = until = rig.ask("status")["cycle"]
        give_up = cycle + OBSERVED_CYCLES

        def over(status: dict[str, Any]) -> bool:
            nonlocal until
            until = status["cycle"] if status["state"] in FLYING else until
            return bool(status["cycle"] > give_up or status["fault"] != "NONE")

        flown = rig.until(over)
        if seen.told is not None:
            trial.told = rig.until(seen.told, _TOLD_S) is not None
        if trial.told is False:
            trial.wrong.append("is not told")
        trial.undisturbed = flown is not None and _goes_on(rig, flight, seen, trial)
        try:
            rig.ask("land")
        except DaemonError as error:
            trial.undisturbed = False
            trial.wrong.append(f"does not land: {error}")
        status = rig.until(lambda s: s["state"] in ("IDLE", "FAULT"))
        if status is None or status["fault"] != "NONE":
            trial.undisturbed = False
            trial.wrong.append(f"lands in {status and status['fault']}")
        _look_at_logs(rig, trial, flight, until, seen)
    trial.answers, trial.asked_s, trial.stalled_us = seen.answers, seen.seconds, seen.stalled_us


def _goes_on(rig: Rig, flight: Flight, seen: Seen, trial: Trial) -> bool:
    """Return whether it flies as it did, or lands where it is to."""
    allowed = HOLDING if flight.status["state"] in HOLDING else ("LANDING", "IDLE")
    if seen.lands:
        allowed = ("LANDING", "IDLE")
    status = rig.ask("status")
    if status["fault"] == "NONE" and status["state"] in allowed:
        return True
    trial.wrong.append(f"disturbs: {status['state']}, {status['fault']}: {status['detail']}")
    return False


def _look_at_logs(
    rig: Rig, trial: Trial, flight: Flight, until: int, seen: Seen | None = None
) -> None:
    """Read the logs of the flight at once, when the recorder is done with them.

    One that was just started has rows to catch up with: it has some seconds for that.
    """
    give_up_s = time.monotonic() + _TOLD_S
    trial.closed = rig.logs_are_closed()
    if not trial.closed:
        trial.wrong.append("the recorder does not close the log")
    cut_at = seen.cut_at if seen is not None else None
    expected = Expected(
        began=flight.began,
        until=until if cut_at is None else cut_at,
        rate_hz=flight.status["rate_hz"],
        cut=cut_at is not None,
        parted=trial.fault == "recorder killed",
    )
    while (look := look_at_logs(rig.logs(), expected)).wrong and time.monotonic() < give_up_s:
        time.sleep(0.2)
    trial.look = look
    trial.wrong += look.wrong
