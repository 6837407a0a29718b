"""Random faults while flying, against electronics in a process of their own, on CAN FD and serial.

From one list zero force and the right name must follow, from the other nothing but a word of it;
after either the daemon has to be usable, and every log has to open. --quick: 40 faults; else 1,000,
which takes over an hour. Trials are kept as they come, so that a run that was stopped carries on;
one that fails counts as failed in all that was asked of it. The clock is not stepped here, for the
machine has others on it: that is in tests/rig_vm, on a machine of its own.
"""

from __future__ import annotations

import contextlib
import json
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import _fault_list
import _fault_rig
import _table
from _code_version import ROOT, code_version
from _fault_list import (
    ELECTRONICS,
    HARMLESS,
    OWN_TIMEOUT,
    PROCESSES,
    SHOWS_LATE,
    SOON,
    make_room,
)
from _fault_rig import GIVE_UP_S, SETTINGS, Rig
from _table import Figure

from levid.daemon.client import DaemonError
from levid.log.errors import LogError
from levid.log.reader import read_log

KEPT = Path(__file__).resolve().parent.parent / "build" / "faults"
_LAST = ""
"""The fault of the trial after the last one, which only has to fly."""
_FAILURES = (DaemonError, RuntimeError, OSError, ValueError, subprocess.SubprocessError)


@dataclass
class Trial:
    """What came of a fault.

    cycles: periods with force from it on, None where force did not end. came_back: periods with
    force after that. found: what the daemon calls it. told: None where there is nothing to tell.
    failed: what kept the trial from its end. wrong: in words.
    """

    bus: str
    number: int
    fault: str
    usable: bool = False
    cycles: int | None = None
    came_back: int = 0
    found: str = ""
    named: bool = False
    undisturbed: bool = False
    told: bool | None = None
    failed: str = ""
    wrong: list[str] = field(default_factory=list)

    @property
    def must_stop(self) -> bool:
        return self.fault in ELECTRONICS or self.fault in PROCESSES

    @property
    def must_not_disturb(self) -> bool:
        return self.fault in HARMLESS


@dataclass(frozen=True)
class Logs:
    """How many logs a run left, and how many of them do not open."""

    logs: int
    unreadable: int


def measure(quick: bool) -> list[Figure]:
    each = 20 if quick else 500
    trials: list[Trial] = []
    logs: list[Logs] = []
    for bus in ("canfd", "serial"):
        file = KEPT / f"{bus}-{each}-{version()}.jsonl"
        found = kept(file)
        if len(found[0]) > each:  # a whole run, which is not to be carried on
            file.replace(file.with_suffix(".before.jsonl"))
            found = [], []
        trials += found[0]
        logs += found[1]
        missing = sorted(set(range(each + 1)) - {trial.number for trial in found[0]})
        while missing:  # the rig is made anew where a trial failed
            new, of_logs = run(bus, missing, each, quick, file)
            trials += new
            logs.append(of_logs)
            missing = missing[len(new) :]
    tell(trials)
    return figures(trials, logs)


def kept(file: Path) -> tuple[list[Trial], list[Logs]]:
    """Return what a run before this one left in its file."""
    lines = file.read_text().splitlines() if file.exists() else []
    plain = [json.loads(line) for line in lines]
    return [Trial(**p) for p in plain if "fault" in p], [Logs(**p) for p in plain if "logs" in p]


def run(
    bus: str, numbers: Sequence[int], each: int, quick: bool, file: Path
) -> tuple[list[Trial], Logs]:
    """Do these trials on one rig until one fails; append them to `file`, and what the logs are."""
    trials: list[Trial] = []
    file.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name, file.open("a") as out:
        folder = Path(name)
        rig = Rig(bus, folder, quick)
        try:
            for number in numbers:
                trial = Trial(bus, number, fault_of(rig, number) if number < each else _LAST)
                try:
                    _try(rig, trial)
                except _FAILURES as error:
                    trial.failed = f"{type(error).__name__}: {error}"
                    trial.wrong.append(f"the trial failed: {trial.failed}")
                trials.append(trial)
                out.write(json.dumps(asdict(trial)) + "\n")
                out.flush()
                print(f"{bus} {number}/{each}", end="\r", file=sys.stderr)
                if trial.failed:
                    break
        finally:
            rig.close()
            found = Logs(len(list(folder.rglob("*.mcap"))), unreadable(folder, rig.cut))
            out.write(json.dumps(asdict(found)) + "\n")
    return trials, found


def version() -> str:
    """Return a digest of what decides a trial: the daemon, the electronics, and all in between."""
    roots = ("cli/run.py", "cli/electronics.py", "daemon", "drivers", "sim/electronics")
    here = (Path(__file__), Path(_fault_list.__file__), Path(_fault_rig.__file__))
    return code_version(roots, (*sorted((ROOT / "wire").rglob("*.py")), *here), SETTINGS)


def fault_of(rig: Rig, number: int) -> str:
    """Return the fault of a trial, which is the same in a run that carries on."""
    harmless = [name for name in HARMLESS if name != "disk full" or rig.small is not None]
    return random.Random(f"{rig.bus} {number}").choice([*ELECTRONICS, *PROCESSES, *harmless])


def figures(trials: Sequence[Trial], logs: Sequence[Logs]) -> list[Figure]:
    """Return the shares; what a trial that failed did not come to counts against them."""
    injected = [trial for trial in trials if trial.usable and trial.fault != _LAST]
    stops = [trial for trial in injected if trial.must_stop]
    others = [trial for trial in injected if trial.must_not_disturb]
    timed = [trial for trial in stops if trial.fault not in SHOWS_LATE]
    soon = [t.cycles is not None and t.cycles <= SOON for t in timed]
    own = [t.cycles is not None and t.cycles <= SOON + OWN_TIMEOUT.get(t.fault, 0) for t in timed]
    slowest = max((t.cycles for t in timed if t.cycles is not None), default=0)
    to_tell = [trial.told for trial in others if trial.told is not None]
    return [
        Figure("faults", len(injected), "", "faults injected in flight"),
        Figure("stopped", _share(t.cycles is not None for t in stops), "", "that must stop: did"),
        Figure("came_back", sum(t.came_back > 0 for t in stops), "", "force acted again after"),
        Figure("named", _share(t.named for t in stops), "", "named rightly"),
        Figure("within_3", _share(soon), "", f"zero force within {SOON} cycles"),
        Figure("within_own_timeout", _share(own), "", "and what bridges it, or the device's own"),
        Figure("slowest_stop", slowest, "cycles", "most to zero force at the device"),
        Figure("shows_late", len(stops) - len(timed), "", "without a promise, not among these"),
        Figure("undisturbed", _share(t.undisturbed for t in others), "", "flew on"),
        Figure("told", _share(to_tell), "", "of those with something to tell"),
        Figure("usable", _share(t.usable for t in trials), "", "lift-offs that succeeded"),
        Figure("failed", sum(bool(t.failed) for t in trials), "", "trials that did not end"),
        Figure("logs", sum(one.logs for one in logs), "", "logs that were opened"),
        Figure("unreadable", sum(one.unreadable for one in logs), "", "logs that do not open"),
    ]


def _share(true: Iterable[object]) -> float:
    counted = [bool(one) for one in true]
    return sum(counted) / max(len(counted), 1)


def tell(trials: Sequence[Trial]) -> None:
    """Say what went wrong, how long each fault took at most, and what each was called."""
    wrong = Counter(f"{t.bus}: {t.fault}: {what}" for t in trials for what in t.wrong)
    for text, count in wrong.most_common():
        print(f"{count} x {text}", file=sys.stderr)
    for fault in (*ELECTRONICS, *PROCESSES):
        those = [trial for trial in trials if trial.fault == fault and trial.usable]
        if those:
            names = Counter(trial.found for trial in those).most_common()
            longest = max(trial.cycles or 0 for trial in those)
            called = ", ".join(f"{count} {name}" for name, count in names)
            print(f"{fault}: at most {longest} cycles; {called}", file=sys.stderr)


def _try(rig: Rig, trial: Trial) -> None:
    home = rig.small if trial.fault == "disk full" and rig.small is not None else rig.folder
    try:
        status = rig.lift_off(home)
        trial.usable = rig.until(lambda s: s["state"] == "LEVITATING" and rig.forces()) is not None
        error = "no force acts"
    except DaemonError as refused:
        error = str(refused)
    if not trial.usable:
        trial.wrong.append(f"does not fly: {error}")
    elif trial.must_stop:
        _must_stop(rig, trial, status)
    elif trial.must_not_disturb:
        _must_not_disturb(rig, trial, status)


def _must_stop(rig: Rig, trial: Trial, status: dict[str, Any]) -> None:
    recorded, name = rig.recordings(), trial.fault
    began = time.monotonic()
    if name in ELECTRONICS:
        expected, forced = ELECTRONICS[name], rig.forced_periods(name)
    else:
        forced = rig.forced_periods()
        expected = PROCESSES[name](rig, status)
    while rig.forces() and time.monotonic() - began < GIVE_UP_S:
        time.sleep(0.005)
    cycles = rig.forced_periods() - forced
    if rig.forces():
        trial.wrong.append(f"force after {GIVE_UP_S:g} s")
    else:
        trial.cycles = cycles
        if name not in SHOWS_LATE and cycles > SOON + OWN_TIMEOUT.get(name, 0):
            trial.wrong.append(f"takes {cycles} cycles")
    trial.found = _name(rig, recorded)
    trial.named = trial.found in expected
    if not trial.named:
        trial.wrong.append(f"is called {trial.found}")
    trial.came_back = rig.forced_periods() - forced - cycles
    if trial.came_back:
        trial.wrong.append("force acts again")


def _must_not_disturb(rig: Rig, trial: Trial, status: dict[str, Any]) -> None:
    """Do it, fly on for 200 cycles, land, and see whether anything else came of it."""
    told = HARMLESS[trial.fault](rig, status)
    cycle = rig.ask("status")["cycle"]
    flown = rig.until(lambda s: s["cycle"] > cycle + 200 or s["fault"] != "NONE")
    if told is not None:
        trial.told = rig.until(told) is not None
    if trial.told is False:
        trial.wrong.append("is not told")
    trial.undisturbed = (
        flown is not None and flown["fault"] == "NONE" and flown["state"] == "LEVITATING"
    )
    if not trial.undisturbed:
        trial.wrong.append(f"disturbs: {flown and flown['fault']}")
    with contextlib.suppress(DaemonError):
        rig.ask("land")
    if trial.fault == "disk full":
        make_room(rig)


def _name(rig: Rig, before: set[Path]) -> str:
    """Return what the daemon calls the fault; a dead one has left a flight recording.

    `before`: the recordings that there were before the fault.
    """
    if rig.daemon.poll() is not None or not rig.path.exists():
        rig.daemon.wait(GIVE_UP_S)
        found = recorded_name(rig.recordings, before, GIVE_UP_S)
        time.sleep(1.5)  # its processes have to let go of the bus
        rig.daemon = rig.start()
        return found
    status = rig.until(lambda s: s["fault"] != "NONE")
    return str(status["fault"]) if status else "nothing"


def recorded_name(recordings: Callable[[], set[Path]], before: set[Path], seconds: float) -> str:
    """Return the fault in the first recording that is new; wait so long until it can be read."""
    give_up_s = time.monotonic() + seconds
    while time.monotonic() < give_up_s:
        for path in sorted(recordings() - before):
            with contextlib.suppress(LogError):  # it is being written
                return read_log(path).metadata["name"]
        time.sleep(0.1)
    return "nothing"


def unreadable(folder: Path, cut: set[str]) -> int:
    """Return how many logs do not open; of the flights `cut`, one without a row is none."""
    bad = 0
    for path in sorted(folder.rglob("*.mcap")):
        try:
            read_log(path)
        except LogError as error:
            without_a_row = "found the end of the file" in str(error)
            if not (without_a_row and path.parent.name in cut):
                print(error, file=sys.stderr)
                bad += 1
    return bad


if __name__ == "__main__":
    _table.run("Faults", measure)
