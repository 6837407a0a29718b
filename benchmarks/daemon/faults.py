"""Random faults while flying, against electronics in a process of their own, on CAN FD and serial.

From one list zero force and the right name must follow, from the other nothing but a word of it;
after either the daemon has to be usable, and every log has to open. Zero force is due within 3
cycles where the loop can end it itself, from where it runs again if it was held up, and from the
last moment at which a limit is exceeded if that takes its time; where it is dead, or the device
hears nothing of it, within the device's own timeout. --quick: 40 faults; else 1,000, in about an
hour. What did not come about is tried again. Trials are kept as they come, so that a run that was
stopped carries on; one that fails counts as failed in all that was asked of it. The clock is not
stepped here, for the machine has others on it: that is in tests/rig_vm, on a machine of its own.
--only flies those faults of the list that are of these kinds; they are kept apart from a whole run.
Faults that nothing outside the daemon can provoke, such as a control law that computes no number,
have tests of their own.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TextIO

from levid.benchmarks.daemon.fault_figures import figures, tell
from levid.benchmarks.daemon.fault_list import BUSES, LAST, case_of, kinds
from levid.benchmarks.daemon.fault_rig import SETTINGS, Rig
from levid.benchmarks.daemon.fault_trial import Trial, attempt, keep_what_is_wrong
from levid.benchmarks.harness import table
from levid.benchmarks.harness.code_version import ROOT, code_version
from levid.benchmarks.harness.table import Figure

KEPT = Path(__file__).resolve().parents[2] / "build" / "faults"
_ATTEMPTS = 3
_RIGS_IN_VAIN = 3
_NONE_FLEW = 3
"""So many trials in a row without a lift-off end a rig: the next ones would not fly either."""


@dataclass
class Kept:
    """What a file holds: the attempts, and the numbers of those that were begun, in order."""

    trials: list[Trial] = field(default_factory=list)
    begun: list[int] = field(default_factory=list)

    @property
    def interrupted(self) -> int:
        """Attempts that a run was stopped in."""
        return len(self.begun) - len(self.trials)

    def missing(self, wanted: Sequence[int]) -> list[int]:
        """Return which of the numbers are still to be tried; who only has to fly is the last."""
        tries = Counter(t.number for t in self.trials)
        over = {t.number for t in self.trials if t.injected or t.skipped}
        over |= {t.number for t in self.trials if t.fault == LAST and t.flew}
        return [n for n in wanted if n not in over and tries[n] < _ATTEMPTS]


def main() -> None:
    options = table.parser(__doc__ or "")
    known = sorted({kind for bus in BUSES for kind in kinds(bus)})
    options.add_argument(
        "--only", nargs="+", default=[], choices=known, metavar="KIND", help=f"of {known}"
    )
    arguments = options.parse_args()
    table.show("Faults", arguments, lambda: measure(arguments.quick, arguments.only))


def measure(quick: bool, only: Sequence[str] = ()) -> list[Figure]:
    """Fly all trials that no run before this one has flown; of some kinds `only` if given."""
    each = 20 if quick else 500
    apart = "".join(f"-{kind.replace(' ', '-')}" for kind in sorted(only))
    files = {bus: KEPT / f"{bus}-{each}{apart}-{version()}.jsonl" for bus in BUSES}
    wanted = {
        bus: [n for n in range(each) if not only or case_of(bus, n).kind in only]
        + ([] if only else [each])
        for bus in BUSES
    }
    if not any(wanted.values()):
        sys.exit(f"expected a fault that is among the first {each} on a bus, found {list(only)}")
    all_kept = {bus: kept(file) for bus, file in files.items()}
    if not any(found.missing(wanted[bus]) for bus, found in all_kept.items()):
        # It is whole, and not to be carried on.
        for bus, file in files.items():
            put_aside(file)
            all_kept[bus] = Kept()
    for bus, found in all_kept.items():
        in_vain = 0
        while found.missing(wanted[bus]):  # the rig is made anew where a trial failed
            before = len(found.trials)
            try:
                run(bus, found, wanted[bus], each, files[bus])
            except (RuntimeError, OSError) as error:
                in_vain += 1
                print(f"{bus}: {error}", file=sys.stderr)
                if in_vain >= _RIGS_IN_VAIN:
                    break
            if any(trial.flew for trial in found.trials[before:]):
                in_vain = 0
    trials = [trial for found in all_kept.values() for trial in found.trials]
    tell(trials)
    asked = sum(len(numbers) for numbers in wanted.values()) - (0 if only else len(BUSES))
    return figures(trials, asked, sum(found.interrupted for found in all_kept.values()))


def kept(file: Path) -> Kept:
    """Return what a run before this one left in its file, and take half a last line out of it."""
    found = Kept()
    if not file.exists():
        return found
    text = file.read_text()
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        file.write_text(whole)
    for line in whole.splitlines():
        plain = json.loads(line)
        if "begun" in plain:
            found.begun.append(plain["begun"])
        else:
            found.trials.append(Trial.of(plain))
    return found


def put_aside(file: Path) -> None:
    """Keep the file of a whole run beside the new one, and those of others before it."""
    if not file.exists():
        return
    number = 1
    while (to := file.with_suffix(f".before-{number}.jsonl")).exists():
        number += 1
    file.replace(to)


def run(bus: str, found: Kept, wanted: Sequence[int], each: int, file: Path) -> None:
    """Fly what is missing of the numbers on one rig until a trial fails; append to found and file.

    Raises:
        RuntimeError, OSError: there is no rig, or none that lifts off.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name,
        file.open("a") as out,
        contextlib.closing(Rig(bus, Path(name))) as rig,
    ):
        grounded = 0
        while missing := found.missing(wanted):
            trial = _try(rig, missing[0], each, found, out)
            grounded = 0 if trial.flew else grounded + (not trial.skipped)
            if grounded == _NONE_FLEW:
                raise RuntimeError(f"{grounded} trials in a row did not lift off: {trial.why_not}")
            print(f"{bus} {trial.number}/{each}", end="\r", file=sys.stderr)
            if trial.failed:
                return


def _try(rig: Rig, number: int, each: int, found: Kept, out: TextIO) -> Trial:
    """Fly one trial; it is written down before, too: whatever stops a run is no secret."""
    case = case_of(rig.bus, number, last=number == each)
    trial = Trial(rig.bus, number, case.kind, case.line, case.state)
    found.begun.append(number)
    _put(out, {"begun": number})
    try:
        attempt(rig, case, trial)
    except Exception as error:  # noqa: BLE001 - whatever it is, the next trials go on
        trial.failed = f"{type(error).__name__}: {error}"
        trial.wrong.append(f"the trial failed: {trial.failed}")
    keep_what_is_wrong(rig, trial, KEPT / "wrong")
    found.trials.append(trial)
    _put(out, asdict(trial))
    return trial


def _put(out: TextIO, plain: Mapping[str, object]) -> None:
    out.write(json.dumps(plain) + "\n")
    out.flush()


def version() -> str:
    """Return a digest of what decides a trial: the daemon, the electronics, and all in between."""
    roots = ("cli/run.py", "daemon", "drivers", "sim/electronics")
    here = Path(__file__).parent
    own = (*sorted(here.glob("fault*.py")), here.parent / "harness" / "memory_pressure.py")
    digest = code_version(roots, (*sorted((ROOT / "wire").rglob("*.py")), *own), SETTINGS)
    return f"{digest}-{'root' if os.geteuid() == 0 else 'user'}"


def _end(*_: object) -> None:
    """Answer SIGTERM, once: all processes are ended, and nothing is to end that."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(1)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _end)
    main()
