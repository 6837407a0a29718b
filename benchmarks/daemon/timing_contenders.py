"""Run the two contenders of the timing benchmark: a flight of the daemon, and cyclictest."""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from levid.benchmarks.harness.child_processes import started
from levid.benchmarks.harness.flown_rows import Flown, Found, found_in
from levid.benchmarks.harness.real_time import Rights
from levid.benchmarks.harness.running_daemon import loopback_rig, require_no_fault, running
from levid.daemon.client import Client
from levid.daemon.ipc.timing_histograms import WakeUps
from levid.log.reader import read_log

Times = NDArray[np.float32]

PRIORITY = 80
LIFT_AND_LAND_S = 3.3
"""Time that a flight takes in addition to the requested time; all of it is logged."""
_NO_TIMES: Times = np.empty(0, np.float32)
_LONGEST_US = 20_000
_LEAST_LOGGED = 0.5
"""Share of the periods that must have rows: skipped periods have none."""


@dataclass
class Turn:
    """Cycles of one contender, the late ones, and its times in us.

    `late` counts wake-ups a period late or more (cyclictest), or cycles that end so late (loop).
    `lateness_us` is measured at the wake-up (cyclictest), or at the start of a cycle after the
    loop's spin; `woken_us` is the loop's wake-up before its spin. The other fields are the loop's.
    """

    cycles: int = 0
    late: int = 0
    lateness_us: Times = field(default_factory=lambda: _NO_TIMES)
    woken_us: Times = field(default_factory=lambda: _NO_TIMES)
    seconds: float = 0.0
    recorder_s: float = 0.0
    found: Found = field(default_factory=Found)
    largest_lag_s: float = 0.0

    @classmethod
    def together(cls, turns: Iterable[Turn]) -> Turn:
        """Return the sum of several turns of one contender."""
        turns = list(turns)
        return cls(
            sum(turn.cycles for turn in turns),
            sum(turn.late for turn in turns),
            np.concatenate([_NO_TIMES, *(turn.lateness_us for turn in turns)]),
            np.concatenate([_NO_TIMES, *(turn.woken_us for turn in turns)]),
            sum(turn.seconds for turn in turns),
            sum(turn.recorder_s for turn in turns),
            sum((turn.found for turn in turns), Found()),
            max((turn.largest_lag_s for turn in turns), default=0.0),
        )


@contextmanager
def waking_up(
    cyclictest: str, rate_hz: int, seconds: float, cpu: int | None = None
) -> Iterator[Callable[[], Turn]]:
    """Run cyclictest, on one processor if `cpu` is given; yield a function that returns its turn.

    Raises:
        RuntimeError: cyclictest fails.
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
            output, errors = process.communicate(timeout=3 * seconds + 10)
            if process.returncode:
                raise RuntimeError(f"cyclictest: {errors.decode().strip() or process.returncode}")
            return of_cyclictest(output.decode(), period_us, seconds)

        yield turn


def of_cyclictest(output: str, period_us: int, seconds: float) -> Turn:
    """Parse cyclictest's histogram (1 us a bin); overflows count as the longest time."""
    bins = np.array(re.findall(r"^(\d+)\s+(\d+)\s*$", output, re.MULTILINE), dtype=np.int64)
    (overflows,) = re.findall(r"^# Histogram Overflows:\s*(\d+)", output, re.MULTILINE)
    us = np.append(np.repeat(bins[:, 0], bins[:, 1]), np.full(int(overflows), _LONGEST_US))
    return Turn(len(us), int((us >= period_us).sum()), us.astype(np.float32), seconds=seconds)


def fly(
    rate_hz: int,
    seconds: float,
    folder: Path,
    ready: Callable[[], None],
    cpu: int | None = None,
) -> Callable[[], Turn]:
    """Levitate on a new daemon, with logs in `folder`; return a function that reads them.

    Reading is separate because it would disturb a contender that runs at the same time. `ready` is
    called before lift-off. With `cpu`, the loop runs on this processor; other processes run on any.

    Raises:
        DaemonError: a fault in flight.
        RuntimeError: the recorder was restarted.
    """
    with tempfile.TemporaryDirectory() as name:
        rig = _rig(Path(name), rate_hz)
        with running(rig, Path(name) / "levid.sock") as daemon:
            loop, recorder = daemon.pids["loop"], daemon.pids["recorder"]
            _require_rights(Rights.of(loop))
            if cpu is not None:
                for thread in Path(f"/proc/{loop}/task").iterdir():
                    os.sched_setaffinity(int(thread.name), {cpu})
            ready()
            flown = Flown(daemon.pids["supervisor"], rig)
            levitate = {"ramp_s": 0.5, "settle_s": 0, "check_coils": False}
            with Client(daemon.socket) as client:
                client.request("levitate", levitate=levitate, out=str(folder))
            began_s, used_s = time.monotonic(), _processor_s(recorder)
            while (left_s := began_s + seconds - time.monotonic()) > 0:
                time.sleep(min(left_s, 1.0))
                flown.look()
                if flown.board.fault:
                    require_no_fault(daemon.ask("status"))
            used_s = _processor_s(recorder) - used_s
            took_s = time.monotonic() - began_s
            # cyclictest counts whole microseconds, rounded down: so does this.
            woken_us = np.repeat(np.floor(WakeUps.edges_us()), flown.woken).astype(np.float32)
            restarts = daemon.land()["recorder_restarts"]
            flown.wait_until_written()
    if restarts:
        raise RuntimeError(f"expected no restart of the recorder, found {restarts}")

    def read() -> Turn:
        turn = read_flight(folder, rate_hz, took_s, flown.cycles)
        turn.woken_us, turn.recorder_s = woken_us, used_s
        turn.largest_lag_s = max(flown.lags, default=0) / rate_hz
        return turn

    return read


def read_flight(folder: Path, rate_hz: int, seconds: float, flown: NDArray[np.int64]) -> Turn:
    """Read the logs of a flight and compare them with the cycles that the loop recorded.

    Raises:
        RuntimeError: fewer than half of the periods have rows.
    """
    logs = [read_log(path) for path in sorted(folder.glob("*.mcap"))]
    lateness_s, execution_s, cycles = (
        np.concatenate([np.empty(0), *(log.rows[name] for log in logs)])
        for name in ("lateness_s", "execution_s", "cycle")
    )
    if len(cycles) < _LEAST_LOGGED * seconds * rate_hz:
        raise RuntimeError(
            f"{folder}: expected rows of {seconds * rate_hz:.0f} periods, found {len(cycles)}"
        )
    cut = sum(not log.complete for log in logs)
    return Turn(
        len(cycles),
        int((lateness_s + execution_s >= 1.0 / rate_hz).sum()),
        (1e6 * lateness_s).astype(np.float32),
        seconds=seconds,
        found=found_in(flown, cycles.astype(np.int64), cut),
    )


def _require_rights(rights: Rights) -> None:
    """Exit unless the loop has the same priority and memory lock as cyclictest."""
    if rights.priority != PRIORITY or not rights.locked_mb:
        raise SystemExit(
            f"timing: expected a loop at priority {PRIORITY} with locked memory, found priority "
            f"{rights.priority} and {rights.locked_mb:.0f} MB locked. Run it as root, or raise the "
            "limits rtprio and memlock"
        )


def _rig(folder: Path, rate_hz: int) -> Path:
    """Write a rig that counts late cycles instead of stopping at them."""
    limits = {"late_cycles": 10_000, "late_in_window": 1_000_000, "stall_s": 30}
    file = loopback_rig(folder, **limits)
    plain = yaml.safe_load(file.read_text())
    plain |= {"rate_hz": rate_hz, "realtime": {"priority": PRIORITY, "cpu_latency_us": 0}}
    file.write_text(yaml.safe_dump(plain))
    return file


def _processor_s(pid: int) -> float:
    """Return the processor time of a process in s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
