"""Rate how often `identify` recognises loops that only noise excites.

Each seed draws other noise and other gains of a mass of 1 kg on 50 N/m and 2 N s/m. False alarms
are counted on open-loop records of several inputs and on excited loops.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.signal import lfilter

from levid.benchmarks.harness.benchmark_runner import Figure, Target, run
from levid.benchmarks.harness.loops_under_noise import Loop, multisine, steps
from levid.identification.nonparametric.feedback_test import (
    InputOrigin,
    input_origins,
)
from levid.identification.records.record import Record

ROWS = 2000
SEEDS, QUICK = 200, 4
NONE, ALL = Target(most=0.0), Target(least=97.0)


def loop(seed: int) -> Loop:
    """Return a loop with gains, delay and noise of one seed."""
    rng = np.random.default_rng(seed)
    delay = int(rng.integers(0, 4))
    most = 30.0 / (1.0 + delay)
    return Loop(
        kp=rng.uniform(0.1, 1.0) * most,
        ki=rng.choice([0.0, 1.0]) * rng.uniform(0.1, 1.0) * most,
        kd=rng.choice([0.0, 0.3]),
        delay=delay,
        force=rng.choice([0.1, 0.3]),
        sensor=10.0 ** rng.uniform(-5.0, -3.0),
        input=rng.choice([0.0, 0.003]),
    )


def inputs(seed: int) -> dict[str, np.ndarray]:
    """Return inputs of unit size by name."""
    white = np.random.default_rng(10_000 + seed).normal(size=ROWS)
    return {
        "white": white,
        "coloured": lfilter([0.3], [1.0, -0.95], white),
        "multisine": multisine(ROWS, 60, seed),
        "steps": steps(ROWS, 100, seed),
        "one_step": (np.arange(ROWS) > ROWS // 4).astype(float),
    }


def found(record: Record, what: Callable[[InputOrigin], bool]) -> bool:
    """Return whether any input of a record is so."""
    return any(what(origin) for origin in input_origins([record]))


def measure(quick: bool) -> Iterator[Figure]:
    """Yield the rates over the seeds."""
    seeds = range(QUICK if quick else SEEDS)
    hits = [
        found(loop(s).record(ROWS, s, feedback=declared), lambda o: o.unexcited)
        for s in seeds
        for declared in (False, True)
    ]
    yield Figure("seeds", len(seeds), "", "seeds")
    yield Figure(
        "unexcited", 100.0 * np.mean(hits), "%", "loops without excitation that are recognised",
        None, ALL,
    )  # fmt: skip
    for name in inputs(0):
        alarms = [found(loop(s).record(ROWS, s, given=inputs(s)[name]), _fed_back) for s in seeds]
        yield Figure(
            f"open_{name}", 100.0 * np.mean(alarms), "%",
            f"false alarms, open loop, {name.replace('_', ' ')}", None, NONE,
        )  # fmt: skip
    for name in inputs(0):
        if name == "one_step":
            continue
        excited = [
            loop(s).record(ROWS, s, excitation=2.0 * inputs(s)[name], feedback=True) for s in seeds
        ]
        alarms = [found(record, lambda o: o.unexcited) for record in excited]
        yield Figure(
            f"excited_{name}", 100.0 * np.mean(alarms), "%",
            f"false alarms, loop excited by {name}", None, NONE,
        )  # fmt: skip


def _fed_back(origin: InputOrigin) -> bool:
    return origin.fed_back


if __name__ == "__main__":
    run("Feedback and excitation", measure)
