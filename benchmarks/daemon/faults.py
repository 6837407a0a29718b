"""Inject random faults in flight, on CAN FD and serial; check zero force, names and logs.

The electronics run in their own process. A fault of one kind must end the force and be named
correctly; a harmless fault must only appear in the status. Afterwards the daemon must be usable and
every log must open. Zero force is required within 3 cycles if the loop can act, counted from the
moment the fault is visible. If the loop is dead or the device does not receive its commands, the
device's own timeout counts. --quick: 40 faults, otherwise 1,000 in about an hour. --only selects
kinds. Files of a failed trial are kept in build/faults.
"""

from __future__ import annotations

import contextlib
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from levid.benchmarks.daemon.fault_list import BUSES, SOON, Case, case_of, kinds
from levid.benchmarks.daemon.fault_logs import LAST_S
from levid.benchmarks.daemon.fault_rig import Rig
from levid.benchmarks.daemon.fault_trial import Trial, attempt
from levid.benchmarks.harness import table
from levid.benchmarks.harness.table import Figure, Target

KEPT = Path(__file__).resolve().parents[2] / "build" / "faults"
_ATTEMPTS = 3
ALL, MOST, NONE = Target(least=1.0), Target(least=0.99), Target(most=0)


def main() -> None:
    """Run the trials of the requested kinds."""
    parser = table.parser(__doc__ or "")
    known = sorted({kind for bus in BUSES for kind in kinds(bus)})
    parser.add_argument("--only", nargs="+", choices=known, metavar="KIND", help=f"of {known}")
    arguments = parser.parse_args()
    table.show("Faults", arguments, lambda: measure(arguments.quick, arguments.only or known))


def measure(quick: bool, only: Collection[str]) -> Iterable[Figure]:
    """Run the trials on both buses; yield their figures, also if they are interrupted."""
    trials: list[Trial] = []
    asked = 0
    try:
        for bus in BUSES:
            cases = [case_of(bus, number) for number in range(20 if quick else 500)]
            cases = [case for case in cases if case.kind in only]
            asked += len(cases)
            while cases:  # a failed trial needs a new rig
                _run(bus, cases, trials)
    finally:
        yield from figures(trials, asked)


def _run(bus: str, cases: list[Case], trials: list[Trial]) -> None:
    """Run cases on one rig and remove them from the list, until it is empty or a trial fails."""
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name,
        contextlib.closing(Rig(bus, Path(name))) as rig,
    ):
        while cases:
            case = cases.pop(0)
            for _ in range(_ATTEMPTS):
                print(f"{bus} {case.number}: {case.kind}", end="        \r", file=sys.stderr)
                trial = attempt(rig, case)
                _remove_files(rig, trial)
                if not trial.not_injected or trial.failed:
                    break
            trials.append(trial)
            for wrong in [*trial.wrong, *filter(None, [trial.not_injected, trial.skipped])]:
                print(f"{bus} {case.number}: {case.kind} in {case.state}: {wrong}", file=sys.stderr)
            if trial.failed:
                return


def _remove_files(rig: Rig, trial: Trial) -> None:
    """Delete the logs of a trial; keep a copy if something is wrong."""
    for path in {rig.flight, rig.folder / "faults"} - {rig.folder}:
        if trial.wrong:
            to = KEPT / f"{trial.case.bus}-{trial.case.number}" / path.name
            with contextlib.suppress(OSError, shutil.Error):
                shutil.copytree(path, to, dirs_exist_ok=True)
        shutil.rmtree(path, ignore_errors=True)


def figures(trials: Sequence[Trial], asked: int) -> Iterable[Figure]:
    """Yield the figures; an injected fault counts in every share, even if its trial failed."""
    injected = [trial for trial in trials if trial.injected]
    stops = [trial for trial in injected if trial.kind.must_stop]
    others = [trial for trial in injected if not trial.kind.must_stop]
    own = [trial for trial in stops if not trial.kind.own_timeout]
    skipped = sum(bool(trial.skipped) for trial in trials)
    for name in sorted({trial.case.kind for trial in stops}):
        those = [trial for trial in stops if trial.case.kind == name]
        names = Counter(trial.found for trial in those)
        most = max((t.cycles for t in those if t.cycles is not None), default=None)
        print(f"{name}: at most {most} cycles; reported as {dict(names)}", file=sys.stderr)
    yield Figure("asked", asked, "", "faults requested")
    yield Figure("skipped", skipped, "", "skipped: no right to inject them")
    target = Target(least=asked - skipped)
    yield Figure("faults", len(injected), "", "faults injected in flight", target=target)
    yield Figure(
        "stopped", _share(t.cycles is not None for t in stops), "", "force ended", target=ALL
    )
    again = sum(t.force_again for t in stops)
    yield Figure("came_back", again, "", "force acted again", target=NONE)
    label = f"loop can act: zero force within {SOON} cycles"
    in_time = _share(_within(t, t.kind.shows + SOON) for t in own)
    yield Figure("within_3", in_time, "", label, target=ALL)
    promised = _share(_within(t, t.kind.most_cycles) for t in stops)
    yield Figure("within_promise", promised, "", "all: in time, or own timeout", target=ALL)
    yield Figure("named", _share(t.named for t in stops), "", "correct name", target=MOST)
    yield Figure("recorded", _share(t.recorded for t in stops), "", "recorded", target=MOST)
    undisturbed = _share(t.undisturbed for t in others)
    yield Figure("undisturbed", undisturbed, "", "harmless: flew on", target=ALL)
    reported = _share(t.reported for t in others)
    yield Figure("told", reported, "", "harmless: in the status", target=ALL)
    usable = _share(t.clears is not None and t.clears <= 1 for t in stops)
    yield Figure("usable", usable, "", "usable after one clear", target=ALL)
    failed = sum(bool(trial.failed) for trial in trials)
    yield Figure("failed", failed, "", "trials that did not end", target=NONE)
    yield Figure("logs", sum(t.logs.logs for t in injected), "", "logs read")
    without = sum(not t.logs.logs for t in injected)
    yield Figure("without_log", without, "", "flights without a log", target=NONE)
    unreadable = sum(t.logs.unreadable for t in injected)
    yield Figure("unreadable", unreadable, "", "logs that do not open", target=NONE)
    missing = sum(t.logs.missing for t in injected)
    yield Figure("missing", missing, "", "rows missing in flight", target=NONE)
    tail_s = max((t.logs.tail_s for t in injected), default=0.0)
    label = "longest time missing at the end of a log"
    yield Figure("longest_tail", tail_s, "s", label, target=Target(most=LAST_S))


def _within(trial: Trial, most: int) -> bool:
    return trial.cycles is not None and trial.cycles <= most


def _share(true: Iterable[object]) -> float | None:
    """Return the share that is true, None of nothing."""
    counted = [bool(one) for one in true]
    return sum(counted) / len(counted) if counted else None


if __name__ == "__main__":
    main()
