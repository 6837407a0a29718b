"""Compare the punctuality of the daemon's loop with cyclictest, at the same priority and period.

The loop runs in a complete daemon: loopback plant, control and recording, while it levitates.
cyclictest (Debian: rt-tests) only wakes up; without it, use --alone. Both need SCHED_FIFO and
locked memory, and an idle machine.

Medians compare wake-ups. The loop requests a wake-up before its deadline and spins for the rest, so
its lateness is a separate figure. Both wait in clock_nanosleep with an absolute time.

Sections: 1khz and 10khz are rounds of 30 s for each contender in turn; their order is swapped every
round. together is the same at 10 kHz with both at once, each on its own processor, swapped every
round. Rounds continue (20 to 40) until enough of them have late cycles. busy is one flight of ten
minutes at 10 kHz beside a disk that is written and synced continuously, with cyclictest before and
after it. The full run takes 1.5 to 2.5 hours, --quick two minutes.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from levid.benchmarks.daemon.timing_contenders import (
    LIFT_AND_LAND_S,
    PRIORITY,
    Times,
    Turn,
    fly,
    waking_up,
)
from levid.benchmarks.harness import table
from levid.benchmarks.harness.busy_disk import busy_disk
from levid.benchmarks.harness.ratio_of_shares import MOST_RATIO, Round, again, ratio_figures
from levid.benchmarks.harness.real_time import hurry, relax
from levid.benchmarks.harness.table import Figure, Met, Target

LOGS = Path(__file__).resolve().parents[2] / "build" / "timing"
"""Folder for logs, on a disk: the folder for temporary files may be in memory."""
RATES_HZ = {"1khz": 1000, "10khz": 10_000, "together": 10_000}
SECTIONS = (*RATES_HZ, "busy")
MOST_MEDIAN = 1.2
MOST_P99_US, MOST_P999_US = 25.0, 100.0
QUIET_P999_US = 70.0
"""The 10 kHz tail targets apply only if cyclictest's own p99.9 is below this."""
MOST_RECORDER = 0.15
_REST_S, _SYNC_S = 2.0, 60.0


@dataclass(frozen=True)
class Plan:
    """Rounds, durations in s, and the path of cyclictest (None: --alone)."""

    cyclictest: str | None
    least: int = 20
    most: int = 40
    seconds: float = 30.0
    busy_s: float = 600.0
    busy_peer_s: float = 120.0


def main() -> None:
    """Measure the requested sections."""
    parser = table.parser(__doc__ or "")
    parser.add_argument("--alone", action="store_true", help="the loop only, without cyclictest")
    parser.add_argument(
        "--only", action="append", choices=SECTIONS, metavar="SECTION",
        help=f"measure only this section, of {', '.join(SECTIONS)}; may be repeated",
    )  # fmt: skip
    arguments = parser.parse_args()
    cyclictest = None if arguments.alone else shutil.which("cyclictest")
    if cyclictest is None and not arguments.alone:
        sys.exit("timing: cyclictest not found. On Debian: apt install rt-tests; or use --alone")
    if not hurry(PRIORITY):
        sys.exit(
            f"timing: no right to priority {PRIORITY}. Run it as root, or raise the limits rtprio "
            "and memlock"
        )
    relax()
    plan = Plan(cyclictest, 1, 1, 5.0, 10.0, 5.0) if arguments.quick else Plan(cyclictest)
    table.show("Timing", arguments, lambda: measure(plan, arguments.only or SECTIONS))


def measure(plan: Plan, sections: Sequence[str]) -> Iterator[Figure]:
    """Yield the figures of these sections."""
    LOGS.mkdir(parents=True, exist_ok=True)
    for section in sections:
        if section == "busy":
            yield from busy(plan)
        elif section != "together" or (
            plan.cyclictest is not None and len(os.sched_getaffinity(0)) > 1
        ):
            yield from rounds(plan, section)
        else:
            print("together: skipped, needs cyclictest and two processors", file=sys.stderr)


def rounds(plan: Plan, section: str) -> Iterator[Figure]:
    """Measure rounds until enough have late cycles; yield the figures of their sum."""
    ours: list[Turn] = []
    theirs: list[Turn] = []
    late: list[Round] = []
    one_round = both_at_once if section == "together" else in_turn
    while len(ours) < plan.least or (plan.cyclictest and again(late, plan.least, plan.most)):
        print(f"{section}: round {len(ours) + 1}", end="\r", file=sys.stderr)
        loop, peer = one_round(plan, RATES_HZ[section], len(ours))
        ours.append(loop)
        theirs.append(peer)
        late.append(Round(loop.late, loop.cycles, peer.late, peer.cycles))
    print(file=sys.stderr)
    levid, peer = Turn.together(ours), Turn.together(theirs)
    yield Figure(f"rounds_{section}", len(ours), "", f"{section}: rounds")
    yield from lateness_figures(section, levid, peer)
    if plan.cyclictest:
        low, high = f"late_ratio_low_{section}", f"late_ratio_{section}"
        yield from ratio_figures(late, low, high, f"loop at {section}, cyclictest")
    else:
        target = Target(most=MOST_RATIO, met=Met.NOT_ASKED)
        yield Figure(f"late_ratio_{section}", None, "", "ratio of late shares", target=target)
    yield from recorder_figures(section, levid)


def in_turn(plan: Plan, rate_hz: int, number: int) -> tuple[Turn, Turn]:
    """Return the turns of the loop and cyclictest; their order depends on the round's number."""
    peer = Turn()
    with tempfile.TemporaryDirectory(dir=LOGS) as folder:
        if number % 2 == 0:
            peer = _peer(plan, rate_hz, plan.seconds)
        read = fly(rate_hz, plan.seconds, Path(folder), _rest)
        if number % 2:
            peer = _peer(plan, rate_hz, plan.seconds)
        return read(), peer


def both_at_once(plan: Plan, rate_hz: int, number: int) -> tuple[Turn, Turn]:
    """Return the turns of both at the same time, on processors that are swapped every round."""
    cyclictest = plan.cyclictest or ""
    ours, theirs = sorted(os.sched_getaffinity(0))[:2][:: -1 if number % 2 else 1]
    seconds = plan.seconds + LIFT_AND_LAND_S
    with tempfile.TemporaryDirectory(dir=LOGS) as folder, ExitStack() as stack:
        peers: list[Callable[[], Turn]] = []

        def ready() -> None:
            _rest()
            peer = waking_up(cyclictest, rate_hz, seconds, cpu=theirs)
            peers.append(stack.enter_context(peer))

        read = fly(rate_hz, plan.seconds, Path(folder), ready, cpu=ours)
        return read(), peers[0]()


def busy(plan: Plan) -> Iterator[Figure]:
    """Fly once beside a disk that is written continuously; yield the figures."""
    with tempfile.TemporaryDirectory(dir=LOGS) as folder:
        with busy_disk(LOGS) as writer:
            before = _peer(plan, 10_000, plan.busy_peer_s)
            read = fly(10_000, plan.busy_s, Path(folder), lambda: None)
            after = _peer(plan, 10_000, plan.busy_peer_s)
            written_mib_s = writer.require_busy()
        levid, peer = read(), Turn.together([before, after])
    yield Figure("flight_s_busy", levid.seconds, "s", "one flight at 10 kHz beside a busy disk")
    yield Figure("written_mib_s_busy", written_mib_s, "MiB/s", "written and synced beside it")
    yield from lateness_figures("busy", levid, peer)
    yield from recorder_figures("busy", levid)
    yield Figure("lag_s_busy", levid.largest_lag_s, "s", "largest lag of the recorder")


def lateness_figures(section: str, levid: Turn, peer: Turn) -> Iterator[Figure]:
    """Yield quantiles of lateness and wake-ups, and shares of late cycles."""
    quiet = _quantile(peer.lateness_us, 0.999)
    judged = None if quiet is not None and quiet < QUIET_P999_US else Met.NOT_ASKED
    limits = {"p99": MOST_P99_US, "p999": MOST_P999_US} if section == "10khz" else {}
    for key, share in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999)):
        versus = f"cyclictest_{key}_us_{section}"
        theirs, ours = _quantile(peer.lateness_us, share), _quantile(levid.lateness_us, share)
        target = Target(most=limits[key], met=judged) if key in limits else None
        yield Figure(versus, theirs, "us", f"cyclictest, {section}: wake-up, {key}")
        label = f"loop, {section}: lateness after its spin, {key}"
        yield Figure(f"lateness_{key}_us_{section}", ours, "us", label, versus, target)
    ours, theirs = _quantile(levid.woken_us, 0.5), _quantile(peer.lateness_us, 0.5)
    label = f"loop, {section}: wake-up before its spin, p50"
    yield Figure(f"wake_up_p50_us_{section}", ours, "us", label, f"cyclictest_p50_us_{section}")
    if section != "busy":
        ratio = ours / theirs if ours is not None and theirs else None
        label = "wake-up, ratio of the medians to cyclictest"
        yield Figure(f"median_ratio_{section}", ratio, "", label, target=Target(most=MOST_MEDIAN))
    late = f"cyclictest_late_share_{section}"
    yield Figure(late, _late(peer), "", f"cyclictest, {section}: woken a period late, share")
    label = f"loop, {section}: ended a period late, share"
    yield Figure(f"late_share_{section}", _late(levid), "", label, late)


def recorder_figures(section: str, levid: Turn) -> Iterator[Figure]:
    """Yield rows that the logs lack, and the recorder's share of a processor."""
    missing, none = levid.found.missing, Target(most=0)
    wrong = levid.found.wrong - missing
    used = levid.recorder_s / levid.seconds
    yield Figure(f"lost_rows_{section}", missing, "", "flown rows in no log", target=none)
    yield Figure(
        f"wrong_rows_{section}", wrong, "", "duplicates, foreign rows, cut logs", None, none
    )
    label = "recorder: share of a processor"
    yield Figure(f"recorder_cpu_{section}", used, "", label, target=Target(most=MOST_RECORDER))


def _peer(plan: Plan, rate_hz: int, seconds: float) -> Turn:
    """Run cyclictest, if there is one."""
    if plan.cyclictest is None:
        return Turn()
    _rest()
    with waking_up(plan.cyclictest, rate_hz, seconds) as turn:
        return turn()


def _rest() -> None:
    """Write what the last turn left to disk and pause: each turn starts on a quiet machine."""
    subprocess.run(["sync"], check=True, timeout=_SYNC_S)
    time.sleep(_REST_S)


def _quantile(times_us: Times, share: float) -> float | None:
    return float(np.quantile(times_us, share)) if len(times_us) else None


def _late(turn: Turn) -> float | None:
    return turn.late / turn.cycles if turn.cycles else None


if __name__ == "__main__":
    main()
