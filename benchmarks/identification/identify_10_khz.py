"""Identification at 10 kHz without decimation: time, memory, and the same P as from 1 kHz.

White noise is flown at 10 kHz in nine records (three short ones with --quick). A process of its own
goes from the logs to P: Markov parameters by least squares, Ho-Kalman, (14). Beside it, all of
`identify`, with and without the fit of the declared model, and P of a flight at 1 kHz.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from levid.benchmarks.harness.benchmark_runner import Figure, Target, run
from levid.benchmarks.harness.child_measurement import Outcome, measure_apart
from levid.benchmarks.identification.identification_methods import levid_ho_kalman
from levid.benchmarks.identification.simulated_flight_and_truth import (
    LAG_S,
    Complex,
    diagonal_ratio,
    fly_white_noise,
    true_response,
    worst,
)
from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.identify import identify
from levid.identification.options import Options
from levid.identification.records.from_log import from_log
from levid.identification.records.record import operating_points
from levid.identification.run_identification import study
from levid.log.reader import read_log

FREQ_HZ = np.unique(np.round(np.geomspace(1.0, 64.0, 60), 1))
MOST_S, MOST_GB, MOST_ALL_S = Target(most=60.0), Target(most=3.0), Target(most=90.0)
MEMORY_BYTES, TIMEOUT_S = 8_000_000_000, 600.0


def measure(quick: bool) -> Iterator[Figure]:
    beams_m, duration_s = ([0.1], 30.0) if quick else ([-0.1, 0.0, 0.1], 60.0)
    most_s, most_gb, most_all_s = (None,) * 3 if quick else (MOST_S, MOST_GB, MOST_ALL_S)
    with tempfile.TemporaryDirectory() as folder:
        logs = fly_white_noise(Path(folder, "fast"), 10_000, beams_m, duration_s, 1)
        slow_logs = fly_white_noise(Path(folder, "slow"), 1_000, beams_m, duration_s, 2)
        fast, slow = _apart(to_plants, logs), _apart(to_plants, slow_logs)
        whole, every = _apart(to_results, logs), _apart(to_all, logs)
    label = f"from {len(logs)} logs of {duration_s:g} s at 10 kHz to P"
    yield Figure("to_plants_s", fast.seconds, "s", label, target=most_s)
    yield Figure("to_plants_gb", fast.peak_bytes / 1e9, "GB", "peak memory", target=most_gb)
    yield Figure("identify_s", whole.seconds, "s", "from the logs to all results of identify")
    yield Figure("identify_gb", whole.peak_bytes / 1e9, "GB", "peak memory")
    yield Figure("all_s", every.seconds, "s", "the declared model fitted too", target=most_all_s)
    yield Figure("all_gb", every.peak_bytes / 1e9, "GB", "peak memory", target=most_gb)
    for key, rate_hz, found in (("", 10_000, fast.value), ("1khz_", 1_000, slow.value)):
        true = [true_response(beam_m, FREQ_HZ, rate_hz) for beam_m in beams_m]
        dB, degrees = worst([diagonal_ratio(*P) for P in zip(found, true, strict=True)])
        label = f"largest error of the diagonal from {rate_hz} Hz, 1 to 64 Hz"
        yield Figure(f"error_{key}db", dB, "dB", label)
        yield Figure(f"error_{key}deg", degrees, "deg", "phase")
    both = zip(fast.value, slow.value, strict=True)
    differ = np.array([diagonal_ratio(held(a, 1e-4), held(b, 1e-3)) for a, b in both])
    percent = 100.0 * float(np.sqrt(np.mean(np.abs(differ - 1.0) ** 2)))
    yield Figure("differ_percent", percent, "%", "P from 10 kHz less P from 1 kHz: rms")


def to_plants(logs: Sequence[Path]) -> list[Complex]:
    """Return P at each beam position."""
    points = operating_points([from_log(read_log(path)) for path in logs])
    return [levid_ho_kalman(point.records, FREQ_HZ) for point in points]


def to_results(logs: Sequence[Path]) -> None:
    """Do what `levid identify` does before its report."""
    identify([from_log(read_log(path)) for path in logs], Options(lag_s=LAG_S))


def to_all(logs: Sequence[Path]) -> None:
    """Do all that `levid identify` does before its report."""
    model = load_model(shipped("models/rig.yaml"))
    study(logs, lambda _: model, Options())


def held(P: Complex, Ts_s: float) -> Complex:
    """Return P without the effects of sampling: one cycle of delay and the zero-order hold.

    Aliases above half the rate add less than 2e-4 of P up to 64 Hz at 1 kHz.
    """
    hold = np.sinc(FREQ_HZ * Ts_s) * np.exp(-3j * np.pi * FREQ_HZ * Ts_s)
    return np.asarray(P / hold[:, None, None])


def _apart(call: Callable[..., object], logs: Sequence[Path]) -> Outcome:
    outcome = measure_apart(call, logs, timeout_s=TIMEOUT_S, memory_bytes=MEMORY_BYTES)
    if outcome.failed:
        raise SystemExit(f"failed: {outcome.failed}")
    return outcome


if __name__ == "__main__":
    run("Identification at 10 kHz", measure)
