"""Compare what the loop and the log cost in this checkout and in a commit.

    python benchmarks/daemon/processor_time_vs_commit.py [COMMIT] [--pairs N] [--json] [--check]

A process of each version runs its own benchmark of the loop in virtual time and of the log (the
functions of `virtual_time_speed.py` and `log_read_write_speed.py`). A pair is several runs of each
in turn, of which the least processor time counts: other work on the machine only adds to it. The
interval is that of the mean logarithm of the pairs' ratios (Student's t).
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from scipy import stats

from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.harness.checkout_of_commit import Version, both_versions

CASES = {
    "loop_1khz": "loop, 1 kHz",
    "loop_10khz": "loop, 10 kHz",
    "log_write": "write a log",
    "log_read": "read a log of 10 kHz",
    "log_read_1khz": "read a log of 1 kHz",
}
WORKER = Path(__file__).with_name("processor_time_worker.py")
LIMIT = 1.03
RUNS = 6
"""Runs of each version in a pair. Other work on the machine only adds cost: the least counts."""


def main() -> None:
    options = parser(__doc__ or "")
    options.add_argument(
        "commit", nargs="?", default="HEAD", metavar="COMMIT", help="commit to compare with (HEAD)"
    )
    options.add_argument(
        "--pairs", type=int, metavar="N", help="pairs of each case (20; with --quick 4)"
    )
    options.add_argument(
        "--case",
        nargs="+",
        choices=CASES,
        default=tuple(CASES),
        metavar="NAME",
        help=f"cases, of {', '.join(CASES)} (all)",
    )
    arguments = options.parse_args()
    pairs = arguments.pairs or (4 if arguments.quick else 20)
    show(
        f"Cost over {arguments.commit}",
        arguments,
        lambda: compare(arguments.commit, pairs, arguments.case),
    )


def compare(commit: str, pairs: int, cases: Sequence[str]) -> Iterator[Figure]:
    """Yield for each case the ratio of the costs, and both bounds of its 95 % interval."""
    with both_versions(commit) as (before, after), _worker(before) as old, _worker(after) as new:
        for case in cases:
            label = CASES[case]
            for worker in (old, new):
                _cost_s(worker, case)  # imports, compiled code, page cache
            logs = [math.log(_ratio(old, new, case)) for _ in range(pairs)]
            print(f"{label}: {pairs} pairs", file=sys.stderr, flush=True)
            ratio, low, high = ratio_95(logs)
            yield Figure(f"{case}_ratio", ratio, "", f"{label}: this checkout / {commit}")
            yield Figure(f"{case}_low", low, "", "    lower bound, 95 %")
            yield Figure(f"{case}_high", high, "", "    upper bound, 95 %", target=Target(LIMIT))


def _ratio(old: subprocess.Popen[str], new: subprocess.Popen[str], case: str) -> float:
    """Return the ratio of the least costs of one pair: new over old."""
    costs_s: dict[int, list[float]] = {old.pid: [], new.pid: []}
    for run in range(RUNS):
        for worker in (old, new) if run % 2 else (new, old):
            costs_s[worker.pid].append(_cost_s(worker, case))
    return min(costs_s[new.pid]) / min(costs_s[old.pid])


def ratio_95(logs: list[float]) -> tuple[float, float, float]:
    """Return the ratio whose logarithm is the mean of `logs`, and its 95 % interval."""
    mean, deviation = float(np.mean(logs)), float(np.std(logs, ddof=1))
    half = float(stats.t.ppf(0.975, len(logs) - 1)) * deviation / math.sqrt(len(logs))
    return math.exp(mean), math.exp(mean - half), math.exp(mean + half)


def _worker(version: Version) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(WORKER), str(version.folder / "levid" / "benchmarks")],
        cwd=version.folder,
        env=version.environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _cost_s(worker: subprocess.Popen[str], case: str) -> float:
    """Return the processor time in s of one run; exits if the process ended."""
    pipes: tuple[IO[Any] | None, ...] = (worker.stdin, worker.stdout)
    to_worker, from_worker = pipes
    assert to_worker is not None
    assert from_worker is not None
    to_worker.write(f"{case}\n")
    to_worker.flush()
    answer = from_worker.readline()
    if not answer:
        sys.exit(f"{case}: the process of one version ended, see its traceback above")
    return float(json.loads(answer))


if __name__ == "__main__":
    main()
