"""One turn of cyclictest, and one flight of the daemon: what each says of its cycles' times."""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from levid.benchmarks.harness.child_processes import started
from levid.benchmarks.harness.flown_rows import Flown, Found, Lag, found_in
from levid.benchmarks.harness.histogram import Histogram
from levid.benchmarks.harness.real_time import Rights
from levid.benchmarks.harness.running_daemon import Daemon, require_no_fault, running
from levid.config.shipped import shipped
from levid.daemon.client import Client
from levid.daemon.ipc.timing_histograms import WakeUps
from levid.log.reader import read_log

PRIORITY = 80
REST_S = 2.0
LIFT_AND_LAND_S = 3.3
"""What a flight takes beyond what it was asked for: all of it is logged."""
_TIMES = ("lateness", "execution", "woken")
_LONGEST_US = 20_000
_SYNC_S = 60.0
_LEAST_LOGGED = 0.5
"""Share of a flight's periods that have rows: skipped ones have none, and a stall skips many."""


@dataclass
class Turn:
    """What came of one contender: cycles, those that were late, times in us.

    `late` of cyclictest: woken up a period late or more; of the loop: ended so late. `lateness` of
    cyclictest is how late it woke up; of the loop how late it began, after its spin, and `woken`
    how late it woke up before that. `found`, `recorder_s` and `lags` are the loop's: its logs, the
    recorder's processor time in `seconds`, and the rows that waited for it.
    """

    cycles: int = 0
    late: int = 0
    lateness: Histogram = field(default_factory=Histogram)
    execution: Histogram = field(default_factory=Histogram)
    seconds: float = 0.0
    recorder_s: float = 0.0
    found: Found = field(default_factory=Found)
    lags: list[Lag] = field(default_factory=list)
    ring_s: float = 0.0
    woken: Histogram = field(default_factory=Histogram)

    @classmethod
    def together(cls, turns: Iterable[Turn]) -> Turn:
        """Return all of one contender's, without lags: those are of one flight each."""
        turns = list(turns)
        return cls(
            sum(one.cycles for one in turns),
            sum(one.late for one in turns),
            Histogram.together(one.lateness for one in turns),
            Histogram.together(one.execution for one in turns),
            sum(one.seconds for one in turns),
            sum(one.recorder_s for one in turns),
            sum((one.found for one in turns), Found()),
            woken=Histogram.together(one.woken for one in turns),
        )

    @property
    def plain(self) -> dict[str, Any]:
        """This as JSON has it."""
        times = {name: getattr(self, name).plain for name in _TIMES}
        return {**vars(self), **times, "found": asdict(self.found)}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Turn:
        """Return what `plain` gave."""
        return cls(
            **{
                **plain,
                **{name: Histogram.from_plain(plain[name]) for name in _TIMES},
                "found": Found(**plain["found"]),
                "lags": [Lag(*lag) for lag in plain["lags"]],
            }
        )


@dataclass(frozen=True)
class Flight:
    """A flight that has ended, its logs not yet read: that would disturb whoever has his turn."""

    logs: Path
    flown: Flown
    rate_hz: int
    seconds: float
    recorder_s: float
    woken: Histogram


def rest() -> None:
    """Bring to disk what the turn before left, and wait: each begins on a machine as quiet."""
    subprocess.run(["sync"], check=True, timeout=_SYNC_S)
    time.sleep(REST_S)


def wake_up(cyclictest: str, rate_hz: int, seconds: float) -> Turn:
    """Run cyclictest."""
    with waking_up(cyclictest, rate_hz, seconds) as turn:
        return turn()


@contextmanager
def waking_up(
    cyclictest: str, rate_hz: int, seconds: float, cpu: int | None = None
) -> Iterator[Callable[[], Turn]]:
    """Run cyclictest, on this processor or on any; yields what waits for its turn's end.

    Its histogram has a bin a microsecond.
    """
    period_us = 1_000_000 // rate_hz
    command = [
        *(cyclictest, "--quiet", "--mlockall", "--threads=1", f"--priority={PRIORITY}"),
        *(f"--interval={period_us}", f"--loops={int(seconds * rate_hz)}"),
        f"--histogram={_LONGEST_US}",
        *(() if cpu is None else (f"--affinity={cpu}",)),
    ]
    with started(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:

        def turn() -> Turn:
            said, problem = process.communicate(timeout=3 * seconds + 10)
            if process.returncode:
                raise RuntimeError(f"cyclictest: {problem.decode().strip() or process.returncode}")
            return of_cyclictest(said.decode(), period_us, seconds)

        yield turn


def of_cyclictest(said: str, period_us: int, seconds: float) -> Turn:
    """Return what cyclictest printed; what is beyond its histogram counts as the longest time."""
    bins = np.array(re.findall(r"^(\d+)\s+(\d+)\s*$", said, re.MULTILINE), dtype=np.int64)
    (overflows,) = re.findall(r"^# Histogram Overflows:\s*(\d+)", said, re.MULTILINE)
    us = np.append(np.repeat(bins[:, 0], bins[:, 1]), np.full(int(overflows), _LONGEST_US))
    return Turn(len(us), int((us >= period_us).sum()), Histogram.of(us), seconds=seconds)


def fly(
    rate_hz: int,
    seconds: float,
    folder: Path,
    ready: Callable[[], None] = rest,
    tell: Callable[[Lag], None] = lambda _: None,
    cpu: int | None = None,
) -> Flight:
    """Levitate for so long on a daemon of its own, everything recorded into `folder`.

    `ready` is called before lift-off, `tell` every second. The loop runs on this processor or on
    any; the daemon's others run on any, which they would not if the rig said so.

    Raises DaemonError, RuntimeError, OSError where it does not come to its end: a fault, a recorder
    that was started anew.
    """
    with tempfile.TemporaryDirectory() as name:
        rig, socket = rig_file(Path(name), rate_hz), Path(name) / "levid.sock"
        with running(rig, socket) as daemon:
            require_rights(Rights.of(daemon.pids["loop"]))
            if cpu is not None:
                stay_on(daemon.pids["loop"], cpu)
            ready()
            return _flown(daemon, rate_hz, seconds, folder / "log", tell)


def _flown(
    daemon: Daemon, rate_hz: int, seconds: float, logs: Path, tell: Callable[[Lag], None]
) -> Flight:
    flown = Flown(daemon.pids["supervisor"], daemon.rig_file)
    levitate = {"ramp_s": 0.5, "settle_s": 0, "check_coils": False}
    with Client(daemon.socket) as client:
        client.request("levitate", levitate=levitate, out=str(logs))
    recorder = daemon.pids["recorder"]
    began_s, used_s = time.monotonic(), processor_s(recorder)
    while (left_s := began_s + seconds - time.monotonic()) > 0:
        time.sleep(min(left_s, 1.0))
        flown.look()
        tell(flown.lags[-1])
        if flown.board.fault:
            require_no_fault(daemon.ask("status"))
    used_s = processor_s(recorder) - used_s
    took_s = time.monotonic() - began_s
    # cyclictest counts whole microseconds, rounded down.
    woken = Histogram.counted(np.floor(WakeUps.edges_us()), flown.woken)
    status = daemon.land()
    flown.wait_until_written()
    if status["recorder_restarts"]:
        raise RuntimeError(f"the recorder was started anew, {status['recorder_restarts']} times")
    return Flight(logs, flown, rate_hz, took_s, used_s, woken)


def read(flight: Flight) -> Turn:
    """Read the logs of a flight and hold them against what its loop wrote.

    Raises:
        RuntimeError: so few rows are there that the loop did not log what it flew.
    """
    late, lateness, execution = 0, [], []
    cycles: list[np.ndarray] = [np.empty(0, np.int64)]
    cut = 0
    for path in sorted(flight.logs.glob("*.mcap")):
        log = read_log(path)
        rows, cut = log.rows, cut + (not log.complete)
        ended_s = rows["lateness_s"].astype(float) + rows["execution_s"]
        late += int((ended_s >= 1.0 / flight.rate_hz).sum())
        lateness.append(Histogram.of(1e6 * rows["lateness_s"]))
        execution.append(Histogram.of(1e6 * rows["execution_s"]))
        cycles.append(rows["cycle"].astype(np.int64))
    logged = np.concatenate(cycles)
    if len(logged) < _LEAST_LOGGED * (due := flight.seconds * flight.rate_hz):
        raise RuntimeError(f"{len(logged)} rows are in the logs of {due:.0f} periods")
    return Turn(
        len(logged),
        late,
        Histogram.together(lateness),
        Histogram.together(execution),
        flight.seconds,
        flight.recorder_s,
        found_in(flight.flown.cycles, logged, cut),
        flight.flown.lags,
        flight.flown.capacity / flight.rate_hz,
        flight.woken,
    )


def stay_on(pid: int, cpu: int) -> None:
    """Keep all threads of a process on one processor."""
    for thread in Path(f"/proc/{pid}/task").iterdir():
        os.sched_setaffinity(int(thread.name), {cpu})


def require_rights(rights: Rights) -> None:
    """Raise SystemExit where the loop has not what cyclictest has: its figures would be others."""
    if rights.priority != PRIORITY or not rights.locked_mb:
        raise SystemExit(
            f"expected a loop at priority {PRIORITY} whose memory is locked, found priority "
            f"{rights.priority} and {rights.locked_mb:.0f} MB: it needs CAP_SYS_NICE and "
            "CAP_IPC_LOCK, or limits rtprio and memlock"
        )


def rig_file(folder: Path, rate_hz: int) -> Path:
    """Write the rig; what is late is counted here, not a reason to stop."""
    plain = yaml.safe_load(shipped("rigs/loopback.yaml").read_text())
    plain |= {
        "rate_hz": rate_hz,
        "model": str(shipped("models/rig.yaml")),
        "sim": str(shipped("sims/nominal.yaml")),
        "socket": str(folder / "levid.sock"),
        # As cyclictest asks for by itself.
        "realtime": {"priority": PRIORITY, "cpu_latency_us": 0},
        "recording": {"faults": str(folder / "faults")},
    }
    plain["limits"] |= {"late_cycles": 10_000, "late_in_window": 1_000_000, "stall_s": 30}
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(plain))
    return path


def processor_s(pid: int) -> float:
    """Return the processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
