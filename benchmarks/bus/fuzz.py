"""A million random and mutated frames and bytes into each decoder: what passes, and what it costs.

Everything is judged again by other means: what a decoder accepts, what numbers it makes of it, and
what it refuses; with the right checksum too, so that all else has to be checked. Of random frames,
those pass that the width of counter and checksum predict; `z` is how far the count is from that, in
standard deviations. Every processor takes one decoder after the other; the full run takes about ten
minutes on two. What is done is kept: a run that was stopped carries on.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import partial
from multiprocessing import active_children
from pathlib import Path
from time import perf_counter

import numpy as np

from levid.benchmarks.bus.fuzz_can import (
    can_lengths,
    can_mutated,
    can_random,
    frames_unpacked,
    local_bus,
)
from levid.benchmarks.bus.fuzz_can_cycle import readings_taken, setpoints_taken
from levid.benchmarks.bus.fuzz_canopen import drives_heard, nodes_told
from levid.benchmarks.bus.fuzz_canopen_sequences import drives_followed
from levid.benchmarks.bus.fuzz_sdo import sdo_answers
from levid.benchmarks.bus.fuzz_serial import (
    serial_blocks,
    serial_crc12,
    serial_resealed,
    stream_of_noise,
)
from levid.benchmarks.bus.fuzz_serial_port import transactions
from levid.benchmarks.bus.mutations import Outcome
from levid.benchmarks.harness import table
from levid.benchmarks.harness.code_version import ROOT, code_version
from levid.benchmarks.harness.kept_results import Parts
from levid.benchmarks.harness.table import Figure, Target
from levid.config.shipped import shipped

KEPT = Path(__file__).resolve().parents[2] / "build" / "fuzz"
Fuzz = Callable[[int, np.random.Generator], Outcome]
RUNS: dict[str, tuple[Fuzz, str]] = {
    "can_random": (partial(can_random, right_counter=False), "random CAN FD frames"),
    "can_counter": (
        partial(can_random, right_counter=True),
        "random CAN FD frames, right counter",
    ),
    "can_lengths": (can_lengths, "random payloads of 0 to 64 bytes, classic CAN and FD"),
    "can_mutated": (can_mutated, "mutated CAN frames"),
    "can_resealed": (partial(can_mutated, resealed=True), "mutated CAN frames, right checksum"),
    "kernel": (frames_unpacked, "noise where the kernel lays out a frame"),
    "local_bus": (local_bus, "messages on a local bus"),
    "readings": (readings_taken, "CAN frames of readings, cycle after cycle, among noise"),
    "setpoints": (setpoints_taken, "the same of setpoints, at emulated electronics"),
    "serial": (serial_blocks, "random and mutated serial blocks"),
    "serial_crc12": (serial_crc12, "random serial frames, 12 bits of the checksum"),
    "serial_resealed": (serial_resealed, "mutated serial frames, right checksum"),
    "stream": (stream_of_noise, "stretches of noise between serial frames"),
    "port": (transactions, "answers at a serial port, among noise"),
    "drives": (drives_heard, "frames of CANopen drives, random and near the right"),
    "sequences": (drives_followed, "the same, cycle after cycle"),
    "sdo": (sdo_answers, "answers of CANopen drives by SDO"),
    "nodes": (nodes_told, "frames to emulated CANopen drives"),
}
NONE, BY_CHANCE = Target(most=0), Target(most=4.0, least=-4.0)
PREDICTED = ("can_random", "can_counter", "can_lengths", "serial_crc12")
"""Those of which counter and checksum alone say how many pass."""


def measure(quick: bool) -> list[Figure]:
    n = 20_000 if quick else 1_000_000
    kept = Parts(KEPT / f"{n}-{version()}.jsonl")
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        jobs: dict[Future[tuple[Outcome, float]], str] = {
            pool.submit(one, key, n): key for key in RUNS if key not in kept
        }
        try:
            for job in as_completed(jobs):
                outcome, seconds = job.result()
                kept.keep(jobs[job], [asdict(outcome), seconds])
                print(f"{jobs[job]}: {seconds:.0f} s", file=sys.stderr)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in active_children():
                worker.terminate()
            raise
    found = {key: kept.get(key) for key in RUNS}
    kept.finish()
    return [
        figure
        for key, (outcome, seconds) in found.items()
        for figure in figures_of(key, Outcome(**outcome), seconds)
    ]


def one(key: str, n: int) -> tuple[Outcome, float]:
    """Return what came of a decoder, and how long that took in s."""
    start = perf_counter()
    outcome = RUNS[key][0](n, np.random.default_rng([5, *key.encode()]))
    return outcome, perf_counter() - start


def figures_of(key: str, outcome: Outcome, seconds: float) -> list[Figure]:
    label = RUNS[key][1]
    figures = [
        Figure(f"{key}_tried", outcome.tried, "", label),
        Figure(f"{key}_accepted", outcome.accepted / outcome.tried, "", f"{label}: share accepted"),
        Figure(f"{key}_wrong", outcome.wrong, "", f"{label}: judged wrongly, or lost", target=NONE),
        Figure(f"{key}_s", seconds, "s", f"{label}: took"),
    ]
    if key in PREDICTED:
        figures.append(
            Figure(f"{key}_z", outcome.z, "sd", f"{label}: off the prediction by", target=BY_CHANCE)
        )
    return figures


def version() -> str:
    """Return a digest of the decoders, of what they are in, and of what tries them."""
    here = Path(__file__).parent
    sources = [*(ROOT / "wire").rglob("*.py"), *here.glob("fuzz_*.py"), here / "mutations.py"]
    settings = [shipped(f"{name}.yaml") for name in ("rigs/canfd", "sims/nominal")]
    return code_version(
        ("drivers", "sim/electronics"), (*sorted(sources), Path(__file__)), settings
    )


if __name__ == "__main__":
    table.run("Decoders against noise", measure)
