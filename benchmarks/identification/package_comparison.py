"""levid against other packages on the same records: error, time and memory of the identified plant.

White noise is flown at each input in turn, with the beam off the middle, so that theta and z
couple. Each method of identification_methods.py identifies P from these logs in a process of its
own. The figures are medians over several flights. `pip install 'levid[peers]'` installs the other
packages; the table reports those that are missing or fail.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from levid.benchmarks.harness.benchmark_runner import Figure, run
from levid.benchmarks.harness.child_measurement import Outcome, measure_apart
from levid.benchmarks.identification.identification_methods import CONTENDERS
from levid.benchmarks.identification.simulated_flight_and_truth import (
    BAND_HZ,
    diagonal_ratio,
    fly_white_noise,
    true_response,
)
from levid.identification.records.from_log import from_log
from levid.log.reader import read_log

RATE_HZ = 1000
BEAM_M = 0.1
FREQ_HZ = np.unique(np.round(np.geomspace(*BAND_HZ, 100), 1))  # bins of spectra over 10 s
MEMORY_BYTES = 8_000_000_000


def measure(quick: bool) -> Iterator[Figure]:
    """Yield medians over the flights; None for a contender that failed or diverged."""
    seeds, duration_s, timeout_s = ([1], 20.0, 60.0) if quick else ([1, 2, 3], 60.0, 300.0)
    true = true_response(BEAM_M, FREQ_HZ, RATE_HZ)
    outcomes: dict[str, list[Outcome]] = {contender.key: [] for contender in CONTENDERS}
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            logs = fly_white_noise(Path(folder), RATE_HZ, [BEAM_M], duration_s, seed)
            records = [from_log(read_log(path)) for path in logs]
        for contender in CONTENDERS:
            if any(outcome.failed for outcome in outcomes[contender.key]):
                continue
            outcome = measure_apart(
                contender.identify, records, FREQ_HZ,
                packages=[contender.package] if contender.package else [],
                timeout_s=timeout_s, memory_bytes=MEMORY_BYTES,
            )  # fmt: skip
            outcomes[contender.key].append(outcome)
    for contender in CONTENDERS:
        found, key = outcomes[contender.key], contender.key
        error = seconds = mb = None
        what = found[-1].failed or "rms error of P's diagonal"
        if not found[-1].failed:
            ratios = [diagonal_ratio(outcome.value, true) for outcome in found]
            percent = [100 * float(np.sqrt(np.mean(np.abs(r - 1) ** 2))) for r in ratios]
            seconds = statistics.median(outcome.seconds for outcome in found)
            mb = statistics.median(outcome.peak_bytes / 1e6 for outcome in found)
            error = statistics.median(percent) if np.all(np.isfinite(percent)) else None
        ours = None if key == CONTENDERS[0].key else CONTENDERS[0].key
        for name, value, unit, label in (
            ("error", error, "%", what),
            ("time", seconds, "s", "from records to P"),
            ("memory", mb, "MB", "peak memory"),
        ):
            versus = ours and f"{name}_{ours}"
            yield Figure(f"{name}_{key}", value, unit, f"{contender.label}: {label}", versus)


if __name__ == "__main__":
    run("levid against other packages", measure)
