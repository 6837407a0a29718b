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
and up to twice that where late cycles are in too few rounds to tell. busy: ten minutes of one
unbroken flight at 10 kHz beside a disk that is written to all the time, cyclictest beside the same
before and after it. The full run takes an hour and a quarter, at most two hours; --quick two
minutes. Rounds are kept in build/timing as they come: a run that was stopped carries on with them.
One that failed (a fault in flight, a recorder that was started anew) is counted, and not repeated.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import _table
from _busy_disk import NotBusyError, Writer, busy_disk
from _code_version import code_version
from _kept import KEPT, Kept, host_digest
from _real_time import hurry, relax
from _rows import Lag
from _shares import MOST_RATIO, Round, again, ratio_figures
from _table import Figure, Met, Target
from _trend import trend
from _turns import PRIORITY, Turn, fly, read, rest, wake_up

from levid.config.shipped import shipped
from levid.daemon.client import DaemonError
from levid.log.errors import LogError

LOGS = KEPT / "timing"
"""Where logs are written: on a disk, which the folder for temporary files may not be."""
RATES_HZ = {"1khz": 1000, "10khz": 10_000}
SECTIONS = (*RATES_HZ, "busy")
MOST_MEDIAN = 1.2
MOST_P99_US, MOST_P999_US = 25.0, 100.0
QUIET_P999_US = 70.0
"""What cyclictest's own p99.9 has to stay below for the loop's to be asked about, at 10 kHz."""
MOST_RECORDER = 0.15
MOST_LAG_S_MIN = 0.1
"""At that ten minutes take a second of the ring's fifteen: whoever keeps up does not fall back."""
_LEAST_TREND_S = 300.0
_NONE = Target(most=0)
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
        if section in RATES_HZ:
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


def slowest(written: Sequence[tuple[float, float]], looks: int) -> float | None:
    """Return the least MiB/s over so many looks at the time in s and the MiB that were down."""
    pairs = zip(written, written[looks:], strict=False)
    return min(((b - a) / (to_s - at_s) for (at_s, a), (to_s, b) in pairs), default=None)


def pairs(lines: Sequence[dict[str, Any]]) -> list[Round]:
    """Return the late cycles of the rounds in which both had their turn."""
    return [
        Round(*(line[who][key] for who in ("loop", "cyclictest") for key in ("late", "cycles")))
        for line in lines
        if "loop" in line and "cyclictest" in line
    ]


def rate_figures(name: str, lines: Sequence[dict[str, Any]]) -> list[Figure]:
    """Return what the loop was like at one rate, beside cyclictest if that was run."""
    levid = Turn.together(Turn.from_plain(line["loop"]) for line in lines if "loop" in line)
    peer = Turn.together(
        Turn.from_plain(line["cyclictest"]) for line in lines if "cyclictest" in line
    )
    failed = sum("failed" in line for line in lines)
    figures = [Figure(f"rounds_{name}", len(lines), "", f"{name}: rounds")]
    figures.append(Figure(f"failed_rounds_{name}", failed, "", "that failed", None, _NONE))
    for key, share in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999)):
        ours, theirs = levid.lateness.quantile(share), peer.lateness.quantile(share)
        versus = f"cyclictest_{key}_us_{name}"
        figures += [
            Figure(versus, theirs, "us", f"cyclictest at {name}: wake-up, {key}"),
            Figure(
                f"lateness_{key}_us_{name}", ours, "us",
                f"loop at {name}: lateness after its spin, {key}", versus,
                tail_target(name, key, peer),
            ),
        ]  # fmt: skip
    ours, theirs = levid.woken.quantile(0.5), peer.lateness.quantile(0.5)
    medians = ours / theirs if ours is not None and theirs else None
    late = f"cyclictest_late_share_{name}"
    figures += [
        Figure(
            f"wake_up_p50_us_{name}", ours, "us", f"loop at {name}: wake-up, before its spin, p50",
            f"cyclictest_p50_us_{name}",
        ),
        Figure(
            f"median_ratio_{name}", medians, "", "wake-up over cyclictest's: medians", None,
            Target(most=MOST_MEDIAN),
        ),
        Figure(late, _share(peer), "", f"cyclictest at {name}: woken up a period late"),
        Figure(f"late_share_{name}", _share(levid), "", f"loop at {name}: ended late", late),
    ]  # fmt: skip
    low, high, who = f"late_ratio_low_{name}", f"late_ratio_{name}", f"loop at {name}, cyclictest"
    if turns := pairs(lines):
        figures += ratio_figures(turns, low, high, who)
    else:
        label = f"{who}: ratio of the shares, 95 % bounds"
        target = Target(most=MOST_RATIO, met=Met.NOT_ASKED)
        figures += [Figure(low, None, "", label), Figure(high, None, "", label, None, target)]
    return [*figures, *recorder_figures(name, levid)]


def tail_target(name: str, key: str, peer: Turn) -> Target | None:
    """Return what a tail at 10 kHz should be, asked where cyclictest's own is short enough."""
    most = {"p99": MOST_P99_US, "p999": MOST_P999_US}.get(key)
    if name != "10khz" or most is None:
        return None
    theirs = peer.lateness.quantile(0.999)
    quiet = theirs is not None and theirs < QUIET_P999_US
    return Target(most=most, met=None if quiet else Met.NOT_ASKED)


def recorder_figures(name: str, levid: Turn) -> list[Figure]:
    """Return what a cycle took, and how the recorder kept up with it."""
    used = levid.recorder_s / levid.seconds if levid.seconds else None
    wrong = levid.found.wrong - levid.found.missing
    p50, p99 = (levid.execution.quantile(share) for share in (0.5, 0.99))
    asked = None if levid.cycles else Met.NOT_ASKED
    none = Target(most=0, met=asked)
    return [
        Figure(f"execution_p50_us_{name}", p50, "us", f"loop at {name}: a cycle takes, p50"),
        Figure(f"execution_p99_us_{name}", p99, "us", "p99"),
        Figure(f"lost_rows_{name}", levid.found.missing, "", "flown rows in no log", None, none),
        Figure(f"wrong_rows_{name}", wrong, "", "twice, strange, cut logs", None, none),
        Figure(
            f"recorder_cpu_{name}", used, "", "recorder: share of a processor", None,
            Target(most=MOST_RECORDER),
        ),
    ]  # fmt: skip


def busy_figures(lines: Sequence[dict[str, Any]]) -> list[Figure]:
    """Return how the recorder fared in one flight at 10 kHz beside a busy disk."""
    (line,) = (line for line in lines if "lag_rows" not in line)
    levid = Turn.from_plain(line["loop"]) if "loop" in line else Turn()
    peer = Turn.from_plain(line["cyclictest"]) if "cyclictest" in line else Turn()
    written = line.get("written", [])
    rows = [lag.rows for lag in levid.lags]
    grows = trend([lag.at_s for lag in levid.lags], rows)
    long = levid.seconds >= _LEAST_TREND_S
    keeps_up = Target(most=MOST_LAG_S_MIN, met=None if long else Met.NOT_ASKED)
    second = 10_000.0
    late = "cyclictest_late_share_busy"
    failed = int("failed" in line)
    return [
        Figure("failed_busy", failed, "", "busy disk: flights that failed", None, _NONE),
        Figure("flight_s_busy", levid.seconds, "s", "one flight at 10 kHz, the disk busy"),
        Figure(
            "written_mib_s_busy", slowest(written, max(len(written) - 1, 1)), "MiB/s",
            "written and synced beside it",
        ),
        Figure("slowest_mib_s_busy", slowest(written, 10), "MiB/s", "in its slowest ten seconds"),
        *recorder_figures("busy", levid),
        Figure("ring_s_busy", levid.ring_s, "s", "what the ring holds"),
        Figure("lag_s_busy", max(rows) / second if rows else None, "s", "recorder: largest lag"),
        Figure("lag_median_s_busy", median(rows) / second if rows else None, "s", "median lag"),
        Figure(
            "lag_trend_busy", 60 * grows.slope / second if grows else None, "s/min",
            "the lag grows by", None, keeps_up,
        ),
        Figure(
            "lag_trend_error_busy", 60 * grows.error / second if grows else None, "s/min",
            "standard error of that",
        ),
        Figure(late, _share(peer), "", "cyclictest before and after it: a period late"),
        Figure("late_share_busy", _share(levid), "", "loop: ended late", late),
    ]  # fmt: skip


def _share(turn: Turn) -> float | None:
    return turn.late / turn.cycles if turn.cycles else None


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
    names = ("timing", "_turns", "_rows", "_busy_disk", "_daemon", "_histogram")
    sources = [here / f"{name}.py" for name in names]
    settings = (shipped("rigs/loopback.yaml"), shipped("sims/nominal.yaml"))
    return code_version(("cli/run.py", "daemon", "drivers/loopback.py"), sources, settings)


def _arguments() -> argparse.Namespace:
    parser = _table.parser(__doc__ or "")
    parser.add_argument("--alone", action="store_true", help="the loop only, without cyclictest")
    parser.add_argument(
        "--only", action="append", choices=SECTIONS, default=[], metavar="SECTION",
        help=f"measure this only, of {', '.join(SECTIONS)}; may be given again",
    )  # fmt: skip
    return parser.parse_args()


if __name__ == "__main__":
    asked = _arguments()
    _table.show("Timing", asked, lambda: measure(asked.quick, asked.alone, asked.only))
