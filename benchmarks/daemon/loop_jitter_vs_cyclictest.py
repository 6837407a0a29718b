"""Compare the punctuality of the daemon's loop with cyclictest, at the same priority and period.

The loop runs in a complete daemon: loopback plant, control and recording, while it levitates.
cyclictest (Debian: rt-tests) only wakes up; without it, its figures are empty. Both need SCHED_FIFO
and locked memory, and an idle machine.

The loop requests a wake-up before its deadline and spins for the rest; its lateness is measured
behind the spin. Sections: 1khz and 10khz are rounds of 30 s for each in turn; their order is
swapped every round. Rounds continue (20 to 40) until enough of them have late cycles. busy is one
flight of ten minutes at 10 kHz beside a disk that is written and synced continuously, with
cyclictest before and after it. The full run takes 1 to 2 hours, --quick two minutes.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.benchmarks.harness.busy_disk import busy_disk
from levid.benchmarks.harness.logged_vs_flown_rows import Flown, Found, found_in
from levid.benchmarks.harness.processor_time import processor_time_s
from levid.benchmarks.harness.ratio_interval import Round, again, ratio_figures
from levid.benchmarks.harness.real_time import Rights
from levid.benchmarks.harness.running_daemon import loopback_rig, require_no_fault, running
from levid.benchmarks.harness.start_and_end_processes import started
from levid.daemon.client import Client
from levid.log.reader import read_log

Times = NDArray[np.float32]

LOGS = Path(__file__).resolve().parents[2] / "build" / "timing"
"""Folder for logs, on a disk: the folder for temporary files may be in memory."""
SECTIONS = {"1khz": 1000, "10khz": 10_000, "busy": 10_000}
PRIORITY = 80
MOST_RECORDER = 0.15
_NO_TIMES: Times = np.empty(0, np.float32)
_LONGEST_US = 20_000


@dataclass
class Turn:
    """Cycles of one contender and their lateness in us; the other fields are the loop's.

    `late` counts wake-ups a period late or more (cyclictest), or cycles that end so late (loop);
    late_us: the lateness of these.
    """

    cycles: int = 0
    lateness_us: Times = field(default_factory=lambda: _NO_TIMES)
    late_us: Times = field(default_factory=lambda: _NO_TIMES)
    seconds: float = 0.0
    recorder_s: float = 0.0
    found: Found = field(default_factory=Found)

    @property
    def late(self) -> int:
        return len(self.late_us)

    @property
    def late_share(self) -> float | None:
        return self.late / self.cycles if self.cycles else None

    def __add__(self, other: Turn) -> Turn:
        return Turn(
            self.cycles + other.cycles,
            np.concatenate([self.lateness_us, other.lateness_us]),
            np.concatenate([self.late_us, other.late_us]),
            self.seconds + other.seconds,
            self.recorder_s + other.recorder_s,
            self.found + other.found,
        )


def main() -> None:
    """Measure the requested sections."""
    parser = benchmark_runner.parser(__doc__ or "")
    parser.add_argument(
        "--only", action="append", choices=SECTIONS, metavar="SECTION",
        help=f"measure only this section, of {', '.join(SECTIONS)}; may be repeated",
    )  # fmt: skip
    arguments = parser.parse_args()
    if not shutil.which("cyclictest"):
        print("timing: cyclictest not found. On Debian: apt install rt-tests", file=sys.stderr)
    LOGS.mkdir(parents=True, exist_ok=True)

    def measure() -> Iterator[Figure]:
        for section in arguments.only or SECTIONS:
            yield from (busy if section == "busy" else rounds)(section, arguments.quick)

    benchmark_runner.show("Timing", arguments, measure)


def rounds(section: str, quick: bool) -> Iterator[Figure]:
    """Measure rounds until enough have late cycles; yield the figures of their sum."""
    least, most, seconds = (1, 1, 5.0) if quick else (20, 40, 30.0)
    levid, peer = Turn(), Turn()
    late: list[Round] = []
    while len(late) < least or (peer.cycles and again(late, least, most)):
        print(f"{section}: round {len(late) + 1}", end="\r", file=sys.stderr)
        order = -1 if len(late) % 2 else 1
        turns = [turn(SECTIONS[section], seconds) for turn in (fly, cyclictest)[::order]]
        one, other = turns[::order]
        levid, peer = levid + one, peer + other
        late.append(Round(one.late, one.cycles, other.late, other.cycles))
    yield from figures(section, levid, peer)
    if peer.cycles:
        low, high = f"late_ratio_low_{section}", f"late_ratio_{section}"
        yield from ratio_figures(late, low, high, f"loop at {section}, cyclictest")


def busy(section: str, quick: bool) -> Iterator[Figure]:
    """Fly once beside a disk that is written continuously; yield the figures."""
    seconds, peer_s = (10.0, 5.0) if quick else (600.0, 120.0)
    rate_hz = SECTIONS[section]
    with busy_disk(LOGS) as writer:
        before = cyclictest(rate_hz, peer_s)
        levid = fly(rate_hz, seconds)
        after = cyclictest(rate_hz, peer_s)
        written_mib_s = writer.require_busy()
    yield Figure("written_mib_s_busy", written_mib_s, "MiB/s", "written and synced beside it")
    yield from figures("busy", levid, before + after)


def figures(section: str, levid: Turn, peer: Turn) -> Iterator[Figure]:
    """Yield lateness, shares of late cycles, lost rows and the recorder's load."""
    for key, share in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999)):
        versus = f"cyclictest_{key}_us_{section}"
        theirs, ours = _quantile(peer.lateness_us, share), _quantile(levid.lateness_us, share)
        yield Figure(versus, theirs, "us", f"cyclictest, {section}: wake-up, {key}")
        label = f"loop, {section}: lateness behind its spin, {key}"
        yield Figure(f"lateness_{key}_us_{section}", ours, "us", label, versus)
    late = f"cyclictest_late_share_{section}"
    yield Figure(late, peer.late_share, "", f"cyclictest, {section}: woken a period late, share")
    label = f"loop, {section}: ended a period late, share"
    yield Figure(f"late_share_{section}", levid.late_share, "", label, late)
    for key, share in (("p05", 0.05), ("p95", 0.95)):
        late_us = _quantile(levid.late_us, share)
        yield Figure(f"late_{key}_us_{section}", late_us, "us", f"lateness of these, {key}")
    wrong, label = levid.found.wrong, "rows missing, duplicate or foreign; cut logs"
    yield Figure(f"wrong_rows_{section}", wrong, "", label, target=Target(most=0))
    used, most = levid.recorder_s / levid.seconds, Target(most=MOST_RECORDER)
    label = "recorder: share of a processor"
    yield Figure(f"recorder_cpu_{section}", used, "", label, target=most)


def cyclictest(rate_hz: int, seconds: float) -> Turn:
    """Run cyclictest on a machine that has come to rest; return an empty turn if there is none."""
    if not (program := shutil.which("cyclictest")):
        return Turn()
    _rest()
    period_us = 1_000_000 // rate_hz
    command = [
        *(program, "--quiet", "--mlockall", "--threads=1", f"--priority={PRIORITY}"),
        *(f"--interval={period_us}", f"--loops={int(seconds * rate_hz)}"),
        f"--histogram={_LONGEST_US}",
    ]
    with started(command, stdout=subprocess.PIPE) as process:
        output, _ = process.communicate(timeout=3 * seconds + 10)
    if process.returncode:
        raise RuntimeError(f"cyclictest: expected exit code 0, found {process.returncode}")
    return of_cyclictest(output.decode(), period_us, seconds)


def of_cyclictest(output: str, period_us: int, seconds: float) -> Turn:
    """Parse cyclictest's histogram (1 us a bin); overflows count as the longest time."""
    bins = np.array(re.findall(r"^(\d+)\s+(\d+)\s*$", output, re.MULTILINE), dtype=np.int64)
    (overflows,) = re.findall(r"^# Histogram Overflows:\s*(\d+)", output, re.MULTILINE)
    us = np.append(np.repeat(bins[:, 0], bins[:, 1]), np.full(int(overflows), _LONGEST_US))
    lateness = us.astype(np.float32)
    return Turn(len(us), lateness, lateness[us >= period_us], seconds)


def fly(rate_hz: int, seconds: float) -> Turn:
    """Levitate on a new daemon; return what its logs say.

    Raises:
        DaemonError: a fault in flight.
        RuntimeError: the recorder was restarted.
    """
    folder = tempfile.TemporaryDirectory
    with folder() as name, folder(dir=LOGS) as logs:
        rig = _rig(Path(name), rate_hz)
        with running(rig, Path(name) / "levid.sock") as daemon:
            _rest()
            recorder = daemon.pids["recorder"]
            rights = Rights.of(daemon.pids["loop"])
            if rights.priority != PRIORITY or not rights.locked_mb:
                raise SystemExit(
                    f"timing: expected a loop at priority {PRIORITY} with locked memory, found "
                    f"{rights}. Run it as root, or raise the limits rtprio and memlock"
                )
            flown = Flown(daemon.pids["supervisor"], rig)
            levitate = {"ramp_s": 0.5, "settle_s": 0, "check_coils": False}
            with Client(daemon.socket) as client:
                client.request("levitate", levitate=levitate, out=logs)
            began_s, used_s = time.monotonic(), processor_time_s(recorder)
            while (left_s := began_s + seconds - time.monotonic()) > 0:
                time.sleep(min(left_s, 1.0))
                flown.look()
                if flown.control_words.fault:
                    require_no_fault(daemon.ask("status"))
            used_s = processor_time_s(recorder) - used_s
            took_s = time.monotonic() - began_s
            restarts = daemon.land()["recorder_restarts"]
            flown.wait_until_written()
        if restarts:
            raise RuntimeError(f"expected no restart of the recorder, found {restarts}")
        turn = read_flight(Path(logs), rate_hz, took_s, flown.cycles)
    turn.recorder_s = used_s
    return turn


def read_flight(folder: Path, rate_hz: int, seconds: float, flown: NDArray[np.int64]) -> Turn:
    """Read the logs of a flight and compare them with the cycles that the loop recorded."""
    logs = [read_log(path) for path in sorted(folder.glob("*.mcap"))]
    lateness_s, execution_s, cycles = (
        np.concatenate([np.empty(0), *(log.rows[name] for log in logs)])
        for name in ("lateness_s", "execution_s", "cycle")
    )
    lateness_us = (1e6 * lateness_s).astype(np.float32)
    late_us = lateness_us[lateness_s + execution_s >= 1.0 / rate_hz]
    found = found_in(flown, cycles.astype(np.int64), sum(not log.complete for log in logs))
    return Turn(len(cycles), lateness_us, late_us, seconds, found=found)


def _rig(folder: Path, rate_hz: int) -> Path:
    """Write a rig that counts late cycles instead of stopping at them."""
    limits = {"late_cycles": 10_000, "late_in_window": 1_000_000, "stall_s": 30}
    file = loopback_rig(folder, **limits)
    plain = yaml.safe_load(file.read_text())
    plain |= {"rate_hz": rate_hz, "realtime": {"priority": PRIORITY, "cpu_latency_us": 0}}
    file.write_text(yaml.safe_dump(plain))
    return file


def _rest() -> None:
    """Write what the last turn left to disk and pause: each turn starts on a quiet machine."""
    subprocess.run(["sync"], check=True, timeout=60.0)
    time.sleep(2.0)


def _quantile(times_us: Times, share: float) -> float | None:
    return float(np.quantile(times_us, share)) if len(times_us) else None


if __name__ == "__main__":
    main()
