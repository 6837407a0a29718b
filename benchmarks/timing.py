"""How punctual the daemon's loop is, beside cyclictest in turn with it, at one priority and period.

The loop is the whole daemon's: loopback plant, control and recording included, while it levitates.
cyclictest (Debian's rt-tests) does nothing but wake up; where it is missing, the loop is alone.
Both need the right to SCHED_FIFO. The full run takes 10 minutes of each contender at each rate, and
up to three times that where too few cycles are late to tell; and 10 minutes at 10 kHz with a disk
that has something else to do.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import _table
import numpy as np
import yaml
from _busy_disk import busy_disk
from _daemon import missing_rows, running
from _shares import Round, again, ratio_figures
from _table import Figure

from levid.config.shipped import shipped
from levid.daemon.client import Client
from levid.log.reader import read_log

PRIORITY = 80
_LONGEST_US = 20_000
LOGS = Path(__file__).resolve().parent.parent / "build" / "timing"
"""Where logs are written: on a disk, which the folder for temporary files may not be."""


@dataclass
class Measured:
    """Of one contender at one rate: lateness in us, cycles, late ones, and the recorder's."""

    lateness_us: list[np.ndarray] = field(default_factory=list)
    execution_us: list[np.ndarray] = field(default_factory=list)
    cycles: int = 0
    late: int = 0
    lost: int = 0
    recorder_s: float = 0.0
    seconds: float = 0.0

    def quantile(self, share: float) -> float:
        return float(np.quantile(np.concatenate(self.lateness_us), share))

    @classmethod
    def of(cls, rounds: Sequence[Measured]) -> Measured:
        """Return all rounds together."""
        return cls(
            [a for one in rounds for a in one.lateness_us],
            [a for one in rounds for a in one.execution_us],
            *(
                sum(getattr(one, name) for one in rounds)
                for name in ("cycles", "late", "lost", "recorder_s", "seconds")
            ),
        )

    @property
    def late_share(self) -> float:
        return self.late / max(self.cycles, 1)


def measure(quick: bool) -> list[Figure]:
    cyclictest = shutil.which("cyclictest")
    if cyclictest is None:
        print("no cyclictest to compare with; on Debian: apt install rt-tests", file=sys.stderr)
    least, most, seconds = (1, 1, 5.0) if quick else (20, 60, 30.0)
    figures: list[Figure] = []
    for rate_hz in (1000, 10_000):
        levid: list[Measured] = []
        peer: list[Measured] = []
        turns: list[Round] = []
        while len(levid) < least or (cyclictest is not None and again(turns, least, most)):
            if cyclictest is not None:
                peer.append(wake_up(cyclictest, rate_hz, seconds))
            levid.append(ours := fly(rate_hz, seconds))
            if peer:
                turns.append(Round(ours.late, ours.cycles, peer[-1].late, peer[-1].cycles))
        name = f"{rate_hz // 1000}khz"
        figures += loop_figures(name, Measured.of(levid), Measured.of(peer))
        if turns:
            who = f"loop at {name}, cyclictest"
            figures += ratio_figures(turns, f"late_ratio_low_{name}", f"late_ratio_{name}", who)
    return [*figures, *busy_figures(least, seconds)]


def busy_figures(rounds: int, seconds: float) -> list[Figure]:
    """Return what the recorder loses at 10 kHz while another process keeps its disk busy."""
    LOGS.mkdir(parents=True, exist_ok=True)
    flights: list[Measured] = []
    written = 0
    for _ in range(rounds):
        with busy_disk(LOGS) as written_mib:
            flights.append(fly(10_000, seconds))
            written += written_mib()
    if not written:
        raise SystemExit(f"timing: nothing was written to {LOGS}: the disk was not busy")
    levid = Measured.of(flights)
    return [
        Figure("lost_rows_busy_10khz", levid.lost, "", "rows lost at 10 kHz, the disk busy"),
        Figure("busy_s", levid.seconds, "s", "in flight with the disk busy"),
        Figure("busy_written_mib", written, "MiB", "written and synced beside it"),
        Figure("late_share_busy_10khz", levid.late_share, "", "cycles that ended late then"),
    ]


def loop_figures(name: str, levid: Measured, peer: Measured) -> list[Figure]:
    """Return what the loop was like, beside cyclictest if that was run."""
    who = f"cyclictest at {name}"
    figures = []
    for key, share in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999)):
        theirs = f"cyclictest_{key}_us_{name}" if peer.cycles else None
        if theirs is not None:
            figures.append(Figure(theirs, peer.quantile(share), "us", f"{who}: wake-up, {key}"))
        ours, label = f"lateness_{key}_us_{name}", f"loop at {name}: lateness, {key}"
        figures.append(Figure(ours, levid.quantile(share), "us", label, theirs))
    if peer.cycles:
        key = f"cyclictest_late_share_{name}"
        figures.append(Figure(key, peer.late_share, "", f"{who}: a period late"))
    execution = np.concatenate(levid.execution_us)
    return [
        *figures,
        Figure(f"execution_p50_us_{name}", float(np.median(execution)), "us", "a cycle, p50"),
        Figure(f"execution_p99_us_{name}", float(np.quantile(execution, 0.99)), "us", "p99"),
        Figure(f"late_share_{name}", levid.late_share, "", f"loop at {name}: ended late"),
        Figure(f"lost_rows_{name}", levid.lost, "", "rows that the recorder lost"),
        Figure(
            f"recorder_cpu_{name}",
            levid.recorder_s / levid.seconds,
            "",
            "recorder: share of a processor",
        ),
    ]


def wake_up(cyclictest: str, rate_hz: int, seconds: float) -> Measured:
    """Run cyclictest; its histogram has a bin a microsecond."""
    period_us = 1_000_000 // rate_hz
    told = subprocess.run(
        [
            *(cyclictest, "--quiet", "--mlockall", "--threads=1", f"--priority={PRIORITY}"),
            *(f"--interval={period_us}", f"--loops={int(seconds * rate_hz)}"),
            f"--histogram={_LONGEST_US}",
        ],
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    bins = np.array(re.findall(r"^(\d+)\s+(\d+)\s*$", told, re.MULTILINE), dtype=np.int64)
    (overflows,) = re.findall(r"^# Histogram Overflows:\s*(\d+)", told, re.MULTILINE)
    lateness = np.repeat(bins[:, 0], bins[:, 1]).astype(float)
    lateness = np.concatenate([lateness, np.full(int(overflows), float(_LONGEST_US))])
    return Measured([lateness], cycles=len(lateness), late=int((lateness >= period_us).sum()))


def fly(rate_hz: int, seconds: float) -> Measured:
    """Levitate for so long on the daemon, everything recorded; read what its log says."""
    into = Measured()
    LOGS.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory(dir=LOGS) as out:
        rig, socket = _rig(Path(folder), rate_hz), Path(folder) / "levid.sock"
        with running(rig, socket) as pids, Client(socket) as client:
            levitate = {"ramp_s": 0.5, "settle_s": 0}
            client.request("levitate", levitate=levitate, out=f"{out}/log")
            began, used = time.monotonic(), _processor_s(pids["recorder"])
            time.sleep(seconds)
            into.recorder_s += _processor_s(pids["recorder"]) - used
            into.seconds += time.monotonic() - began
            client.request("land")
            while client.request("status")["state"] != "IDLE":
                time.sleep(0.1)
            lost = client.request("status")["lost"]
        logs = list(Path(out, "log").glob("*.mcap"))
        into.lost += max(lost, missing_rows(logs))  # as it says, and as the logs say
        rows = np.concatenate([read_log(path).rows for path in logs])
    period_s = 1.0 / rate_hz
    into.lateness_us.append(1e6 * rows["lateness_s"])
    into.execution_us.append(1e6 * rows["execution_s"])
    into.cycles += len(rows)
    into.late += int((rows["lateness_s"] + rows["execution_s"] >= period_s).sum())
    return into


def _rig(folder: Path, rate_hz: int) -> Path:
    plain = yaml.safe_load(shipped("rigs/loopback.yaml").read_text())
    plain |= {
        "rate_hz": rate_hz,
        "sim": str(shipped("sims/nominal.yaml")),
        "socket": str(folder / "levid.sock"),
        "realtime": {"priority": PRIORITY},
        "recording": {"faults": str(folder / "faults")},
    }
    # What is late is counted here, not a reason to stop.
    plain["limits"] |= {"late_cycles": 10_000, "late_in_window": 1_000_000, "stall_s": 30}
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(plain))
    return path


def _processor_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    _table.run("Timing", measure)
