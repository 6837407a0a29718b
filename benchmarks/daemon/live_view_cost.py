"""Measure what the live view costs: processor time, and lateness of the loop with and without it.

A platform levitates on the loopback rig at 1 kHz in real time. Turns with the live view (100 Hz,
ten clients of which one never reads, and a page) and turns in which its process is stopped follow
each other in one flight; the log has the lateness. --quick: 6 rounds, otherwise 40 in 8 minutes.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.benchmarks.harness.processor_time import processor_time_s
from levid.benchmarks.harness.ratio_interval import Round, ratio_figures
from levid.benchmarks.harness.running_daemon import Daemon, loopback_rig, running
from levid.benchmarks.harness.start_and_end_processes import started
from levid.log.reader import read_log

CLIENTS = Path(__file__).with_name("live_view_clients.py")
PORT, PAGE_PORT, RATE_HZ = 28_765, 28_080, 100.0
TURN_S, SETTLE_S = 4.0, 1.0
MOST_CPU_PERCENT = 5.0
"""Share of one processor at 100 Hz."""
_LIMITS = {"late_cycles": 10_000, "late_in_window": 1_000_000, "stall_s": 2.0}
"""The benchmark counts late cycles; they must not end the flight."""


class Turn(NamedTuple):
    """The cycles of a turn without its beginning, and the processor time of the live process."""

    begin: int
    end: int
    cpu_percent: float


def measure(quick: bool) -> Iterator[Figure]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rig_file = loopback_rig(folder, **_LIMITS)
        rig = yaml.safe_load(rig_file.read_text())
        rig["live"] = {"port": PORT, "page_port": PAGE_PORT, "rate_hz": RATE_HZ}
        rig_file.write_text(yaml.safe_dump(rig))
        with running(rig_file, folder / "levid.sock") as daemon:
            yield from _fly(daemon, folder / "out", 6 if quick else 40)


def _fly(daemon: Daemon, out: Path, rounds: int) -> Iterator[Figure]:
    live = int(daemon.ask("status")["pids"]["live"])
    daemon.ask("levitate", out=str(out), levitate={"check_coils": False})
    with _clients(1):
        alone = _turn(daemon, live)
    turns: list[tuple[Turn, Turn]] = []
    with _clients(10):
        for number in range(rounds):
            pair: dict[bool, Turn] = {}
            for served in (True, False) if number % 2 else (False, True):
                os.kill(live, signal.SIGCONT if served else signal.SIGSTOP)
                pair[served] = _turn(daemon, live)
            os.kill(live, signal.SIGCONT)
            time.sleep(SETTLE_S)  # two turns without it would look like a process that hangs
            turns.append((pair[True], pair[False]))
    daemon.land()
    assert int(daemon.ask("status")["pids"]["live"]) == live, "the live process was restarted"
    rows = np.concatenate([read_log(path).rows for path in sorted(out.glob("*.mcap"))])
    yield Figure(
        "one_client_percent",
        alone.cpu_percent,
        "%",
        "live process at 100 Hz, one client: share of a processor",
        target=Target(MOST_CPU_PERCENT),
    )
    yield Figure(
        "ten_clients_percent",
        float(np.mean([served.cpu_percent for served, _ in turns])),
        "%",
        "    ten clients, one of them stalled, and a page",
        target=Target(MOST_CPU_PERCENT),
    )
    yield from _lateness(rows, turns)


def _lateness(rows: NDArray[np.void], turns: list[tuple[Turn, Turn]]) -> Iterator[Figure]:
    """Yield p99 with and without the live view, and the ratio of the shares of late cycles."""
    served = [_of(rows, turn) for turn, _ in turns]
    alone = [_of(rows, turn) for _, turn in turns]
    for key, parts, label in (("with", served, "with live view"), ("without", alone, "without")):
        late_us = 1e6 * np.concatenate([part["lateness_s"] for part in parts])
        for name, quantile in (("p50", 50.0), ("p99", 99.0)):
            yield Figure(
                f"{name}_{key}_us",
                float(np.percentile(late_us, quantile)),
                "us",
                f"lateness {name}, {label}",
                versus=f"{name}_without_us" if key == "with" else None,
            )
    counted = [
        Round(_late(some), len(some), _late(others), len(others))
        for some, others in zip(served, alone, strict=True)
    ]
    yield from ratio_figures(counted, "late_ratio_low", "late_ratio_high", "late cycles")


def _of(rows: NDArray[np.void], turn: Turn) -> NDArray[np.void]:
    return rows[(rows["cycle"] >= turn.begin) & (rows["cycle"] < turn.end)]


def _late(rows: NDArray[np.void]) -> int:
    return int(np.count_nonzero(rows["skipped"]))


def _turn(daemon: Daemon, live: int) -> Turn:
    time.sleep(SETTLE_S)  # it catches up on the rows of a turn without it
    begin, begin_s, used_s = daemon.ask("status")["cycle"], time.monotonic(), processor_time_s(live)
    time.sleep(TURN_S)
    share = (processor_time_s(live) - used_s) / (time.monotonic() - begin_s)
    return Turn(begin, daemon.ask("status")["cycle"], 100.0 * share)


def _clients(count: int) -> AbstractContextManager[subprocess.Popen[bytes]]:
    """Run clients in a process of low priority; the page is shown with more than one."""
    ports = {"port": PORT, "page_port": PAGE_PORT if count > 1 else None}
    settings = json.dumps({**ports, "clients": count})
    return started([sys.executable, str(CLIENTS), settings], stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    benchmark_runner.run(__doc__ or "", measure)
