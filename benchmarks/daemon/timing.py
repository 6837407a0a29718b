"""How punctual the daemon's loop is, beside cyclictest in turn with it, at one priority and period.

The loop is the whole daemon's: loopback plant, control and recording included, while it levitates.
cyclictest (Debian's rt-tests) does nothing but wake up; without it only --alone is measured. Both
need the right to SCHED_FIFO and to lock memory, and a machine that has nothing else to do.

Medians are compared of wake-ups: when each was woken, against the moment it had asked for. The loop
asks for one before its deadline and spins the rest, so that its lateness, a figure of its own, says
nothing of the kernel. Both wait in clock_nanosleep with an absolute time. cyclictest hands it over
as it is; to time.sleep a duration is told, which Python adds to a clock that it reads anew: what
lies between the two looks at the clock, and the interpreter's way back, count as the loop's.

1khz, 10khz: ten minutes of each contender in rounds of 30 s, their order swapped in every round,
and up to twice that where late cycles are in too few rounds to tell. together: as many rounds at
10 kHz in which both run at once, each on a processor of its own, swapped in every round, the
daemon's other processes on either: what a machine does to both, say a host that takes it away, is
in both shares then, where in turns it makes them differ by ten times from one turn to the next.
busy: ten minutes of one unbroken flight at 10 kHz beside a disk that is written to all the time,
cyclictest beside the same before and after it. The full run takes an hour and a half, at most two
and a half; --quick two minutes. Rounds are kept in build/timing as they come: a run that was
stopped carries on with them. One that failed (a fault in flight, a recorder that was started anew)
is counted, and not repeated.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from levid.benchmarks.daemon.timing_figures import busy_figures, pairs, rate_figures
from levid.benchmarks.daemon.timing_rounds import (
    LIFT_AND_LAND_S,
    PRIORITY,
    Turn,
    fly,
    read,
    rest,
    wake_up,
    waking_up,
)
from levid.benchmarks.harness import table
from levid.benchmarks.harness.busy_disk import NotBusyError, Writer, busy_disk
from levid.benchmarks.harness.code_version import code_version
from levid.benchmarks.harness.flown_rows import Lag
from levid.benchmarks.harness.kept_results import KEPT, Kept, host_digest
from levid.benchmarks.harness.ratio_of_shares import again
from levid.benchmarks.harness.real_time import hurry, relax
from levid.benchmarks.harness.table import Figure
from levid.config.shipped import shipped
from levid.daemon.client import DaemonError
from levid.log.errors import LogError

LOGS = KEPT / "timing"
"""Where logs are written: on a disk, which the folder for temporary files may not be."""
RATES_HZ = {"1khz": 1000, "10khz": 10_000, "together": 10_000}
SECTIONS = (*RATES_HZ, "busy")
_TOGETHER = 2
"""Processors that it takes to run both at once."""
_IN_A_ROW = 3
_FAILURES = (
    DaemonError, LogError, NotBusyError, OSError, RuntimeError, ValueError,
    subprocess.SubprocessError,
)  # fmt: skip
_LEAST, _MOST, _SECONDS = 20, 40, 30.0
_BUSY_S, _BUSY_PEER_S = 600.0, 120.0


class Plan:
    """How long what is measured takes, and with whom; cyclictest is None where it is --alone."""

    def __init__(self, quick: bool, cyclictest: str | None) -> None:
        self.cyclictest = cyclictest
        self.least, self.most, self.seconds = (1, 1, 5.0) if quick else (_LEAST, _MOST, _SECONDS)
        self.busy_s, self.busy_peer_s = (10.0, 5.0) if quick else (_BUSY_S, _BUSY_PEER_S)
        kind = "quick" if quick else "full"
        with_whom = "" if cyclictest else "-alone"
        self.file = LOGS / f"{kind}{with_whom}-{version()}-{host_digest()}.jsonl"


def measure(quick: bool, alone: bool = False, only: Sequence[str] = ()) -> Iterator[Figure]:
    """Yield the figures of these sections, of all if none is named."""
    plan = Plan(quick, None if alone else _cyclictest())
    _require_priority()
    kept = Kept(plan.file)
    print(f"rounds are kept in {plan.file}", file=sys.stderr)
    if old := {s: len(kept.of(s)) for s in only or SECTIONS if kept.of(s)}:
        since = kept.lines[0].get("begun", "before")
        counts = ", ".join(f"{count} of {section}" for section, count in old.items())
        print(f"of a run begun {since}, not measured again: {counts}", file=sys.stderr)
    _clean(LOGS)
    for section in only or SECTIONS:
        if section == "together" and (why := _not_together(plan)):
            print(f"together: {why}", file=sys.stderr)
        elif section in RATES_HZ:
            try:
                rounds(plan, kept, section)
            except BaseException:
                yield from rate_figures(section, kept.of(section))
                raise
            yield from rate_figures(section, kept.of(section))
        else:
            busy(plan, kept)
            yield from busy_figures(kept.of(section))
    if not only:
        kept.close()


def rounds(plan: Plan, kept: Kept, section: str) -> None:
    """Fly and wake up in turns until there are rounds enough; keep each."""
    rate_hz, in_a_row = RATES_HZ[section], 0
    while True:
        lines = kept.of(section)
        done, turns = len(lines), pairs(lines)
        more = plan.cyclictest is not None and again(turns, 0, plan.most)
        if done >= (plan.most if more else plan.least):
            print(file=sys.stderr)
            return
        print(f"{section}: round {done + 1}", end="\r", file=sys.stderr)
        line: dict[str, Any] = {"section": section, "round": done}
        try:
            if section == "together" and plan.cyclictest is not None:
                line |= both_at_once(rate_hz, plan.seconds, done, plan.cyclictest)
            else:
                line |= one_round(rate_hz, plan.seconds, done, plan.cyclictest)
            in_a_row = 0
        except _FAILURES as error:
            in_a_row += 1
            line |= _failed(section, error)
        kept.add(line)
        if in_a_row == _IN_A_ROW:
            raise RuntimeError(f"{in_a_row} rounds in a row failed, the last: {line['failed']}")


def one_round(
    rate_hz: int, seconds: float, number: int, cyclictest: str | None
) -> dict[str, dict[str, Any]]:
    """Return the turns of both; who was first in one round is second in the next."""
    found = {}
    LOGS.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=_prefix(), dir=LOGS) as folder:

        def loop() -> None:
            found["loop"] = fly(rate_hz, seconds, Path(folder))

        def peer() -> None:
            if cyclictest is not None:
                rest()
                found["cyclictest"] = wake_up(cyclictest, rate_hz, seconds)

        for turn in (loop, peer) if number % 2 else (peer, loop):
            turn()
        found["loop"] = read(found["loop"])  # logs are read when nobody is timed
    return {who: turn.plain for who, turn in found.items()}


def both_at_once(
    rate_hz: int, seconds: float, number: int, cyclictest: str
) -> dict[str, dict[str, Any]]:
    """Return what came of both, each on a processor of its own; the next round swaps these."""
    ours, theirs = sorted(os.sched_getaffinity(0))[:_TOGETHER][:: -1 if number % 2 else 1]
    LOGS.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory(prefix=_prefix(), dir=LOGS) as folder,
        ExitStack() as stack,
    ):
        peers: list[Callable[[], Turn]] = []

        def ready() -> None:
            rest()
            longer_s = seconds + LIFT_AND_LAND_S
            peers.append(stack.enter_context(waking_up(cyclictest, rate_hz, longer_s, cpu=theirs)))

        flight = fly(rate_hz, seconds, Path(folder), ready, cpu=ours)
        found = {"cyclictest": peers[0](), "loop": read(flight)}
    return {who: turn.plain for who, turn in found.items()}


def busy(plan: Plan, kept: Kept) -> None:
    """Fly once without a break beside a disk that is written to, cyclictest before and after."""
    if any("lag_rows" not in line for line in kept.of("busy")):
        return
    line: dict[str, Any] = {"section": "busy"}
    LOGS.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(prefix=_prefix(), dir=LOGS) as folder:
            with busy_disk(LOGS) as writer:
                peers = [_peer(plan, writer)]
                written: list[tuple[float, int]] = []

                def tell(lag: Lag) -> None:
                    written.append((lag.at_s, writer.mib))
                    if not len(written) % 60:  # a flight that is stopped leaves these
                        kept.add({"section": "busy", "at_s": lag.at_s, "lag_rows": lag.rows})

                flight = fly(10_000, plan.busy_s, Path(folder), lambda: None, tell)
                line["written"] = written
                writer.require_busy()
                try:
                    peers.append(_peer(plan, writer))
                except _FAILURES as error:  # of what comes after: the flight stands
                    line |= _failed("busy", error)
            line["loop"] = read(flight).plain
            line["cyclictest"] = Turn.together(peers).plain
    except _FAILURES as error:
        line |= _failed("busy", error)
    kept.add(line)


def _not_together(plan: Plan) -> str:
    if plan.cyclictest is None:
        return "not without cyclictest"
    if (found := len(os.sched_getaffinity(0))) < _TOGETHER:
        return f"expected {_TOGETHER} processors, found {found}"
    return ""


def _peer(plan: Plan, writer: Writer) -> Turn:
    """Let cyclictest have its turn beside the writer, which has to be writing still."""
    if plan.cyclictest is None:
        return Turn()
    turn = wake_up(plan.cyclictest, 10_000, plan.busy_peer_s)
    writer.require_busy()
    return turn


def _failed(section: str, error: Exception) -> dict[str, str]:
    why = f"{type(error).__name__}: {error}"
    print(f"{section}: a round failed: {why}", file=sys.stderr)
    return {"failed": why}


def _prefix() -> str:
    return f"flight-{os.getpid()}-"


def _clean(folder: Path) -> None:
    """Remove the logs of runs that were killed: a gigabyte each."""
    for left in folder.glob("flight-*"):
        pid = left.name.split("-")[1]
        if not Path(f"/proc/{pid}").exists():
            shutil.rmtree(left, ignore_errors=True)


def _cyclictest() -> str:
    found = shutil.which("cyclictest")
    if found is None:
        raise SystemExit(
            "timing: no cyclictest to compare with; on Debian: apt install rt-tests. "
            "--alone measures the loop without it"
        )
    return found


def _require_priority() -> None:
    """Refuse at once what cannot be measured here."""
    if not hurry(PRIORITY):
        raise SystemExit(
            f"timing: no right to priority {PRIORITY}: run it as root, or raise the limits rtprio "
            "and memlock"
        )
    relax()


def version() -> str:
    """Return a digest of what a round depends on: the daemon, and how it is measured here."""
    here = Path(__file__).parent
    shared = ("flown_rows", "busy_disk", "running_daemon", "histogram")
    sources = [here / "timing.py", here / "timing_rounds.py"]
    sources += [here.parent / "harness" / f"{name}.py" for name in shared]
    settings = (shipped("rigs/loopback.yaml"), shipped("sims/nominal.yaml"))
    return code_version(("cli/run.py", "daemon", "drivers/loopback.py"), sources, settings)


def _arguments() -> argparse.Namespace:
    parser = table.parser(__doc__ or "")
    parser.add_argument("--alone", action="store_true", help="the loop only, without cyclictest")
    parser.add_argument(
        "--only", action="append", choices=SECTIONS, default=[], metavar="SECTION",
        help=f"measure this only, of {', '.join(SECTIONS)}; may be given again",
    )  # fmt: skip
    return parser.parse_args()


if __name__ == "__main__":
    asked = _arguments()
    table.show("Timing", asked, lambda: measure(asked.quick, asked.alone, asked.only))
