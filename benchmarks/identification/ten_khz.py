"""Identification at 10 kHz without decimation: time, memory, and the same P as from 1 kHz.

White noise is flown at 10 kHz in nine records (three short ones with --quick). A process of its own
goes from the logs to P: Markov parameters by least squares, Ho-Kalman, (14). Beside it, all of
`identify`, and P of a flight of the same plant at 1 kHz.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from levid.benchmarks.harness.isolated import Outcome, measure_apart
from levid.benchmarks.harness.table import Figure, Target, run
from levid.benchmarks.identification.contenders import impulse_taps
from levid.benchmarks.identification.known_plant import (
    LAG_S,
    Array,
    Complex,
    diagonal_ratio,
    fly_white_noise,
    true_response,
    worst,
)
from levid.identification.identify import identify
from levid.identification.nonparametric.frequency_response import (
    plant_from_sensitivity,
    sensitivity,
)
from levid.identification.nonparametric.markov_parameters import estimate_markov
from levid.identification.options import Options
from levid.identification.records.from_log import from_log
from levid.identification.records.record import operating_points
from levid.identification.subspace.delay_removal import without_delay
from levid.identification.subspace.ho_kalman import Scaling, decompose, realise
from levid.identification.subspace.plant_from_loop import IdentifiedPlant, plant_from_loop
from levid.log.reader import read_log

FREQ_HZ = np.unique(np.round(np.geomspace(1.0, 64.0, 60), 1))  # bins of spectra over 10 s
WITHIN_95 = float(np.sqrt(-np.log(0.05)))
"""A circular complex normal variable is within 1.73 standard deviations in 95 % of cases."""
MOST_S, MOST_GB = Target(most=60.0), Target(most=3.0)
LEAST_AGREE = Target(least=90.0)
"""Of 95: errors of neighbouring frequencies and of one record's entries are correlated, so that the
share varies by some percent from flight to flight."""
MEMORY_BYTES, TIMEOUT_S = 8_000_000_000, 600.0


@dataclass
class Found:
    """P (F, 3, 3) of each beam position by both methods, from the logs of one flight."""

    beams_m: list[float] = field(default_factory=list)
    ho_kalman: list[Complex] = field(default_factory=list)
    spectral: list[Complex] = field(default_factory=list)
    standard_deviation: list[Array] = field(default_factory=list)
    stages_s: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.stages_s[name] = self.stages_s.get(name, 0.0) + time.perf_counter() - start


def measure(quick: bool) -> Iterator[Figure]:
    beams_m, duration_s = ([0.1], 30.0) if quick else ([-0.1, 0.0, 0.1], 60.0)
    most_s, most_gb = (None, None) if quick else (MOST_S, MOST_GB)
    with tempfile.TemporaryDirectory() as folder:
        logs = fly_white_noise(Path(folder, "fast"), 10_000, beams_m, duration_s, 1)
        slow_logs = fly_white_noise(Path(folder, "slow"), 1_000, beams_m, duration_s, 2)
        size = sum(path.stat().st_size for path in logs)
        label = f"{len(logs)} records of {duration_s:g} s at 10 kHz"
        yield Figure("logs_mb", size / 1e6, "MB", label)
        fast = _apart(to_plants, logs)
        yield Figure("to_plants_s", fast.seconds, "s", "from the logs to P", target=most_s)
        yield Figure("to_plants_gb", fast.peak_bytes / 1e9, "GB", "peak memory", target=most_gb)
        for name, seconds in fast.value.stages_s.items():
            yield Figure(f"{name.replace(' ', '_')}_s", seconds, "s", f"of that: {name}")
        yield from _agreement(fast.value, _apart(to_plants, slow_logs).value)
        whole = _apart(to_results, logs)
        yield Figure("identify_s", whole.seconds, "s", "from the logs to all results of identify")
        yield Figure("identify_gb", whole.peak_bytes / 1e9, "GB", "peak memory")


def _agreement(ten: Found, one: Found) -> Iterator[Figure]:
    (db, deg), (db_1, deg_1) = errors(ten, 10_000), errors(one, 1_000)
    differ = np.array([diagonal_ratio(*P) for P in zip(ten.ho_kalman, one.ho_kalman, strict=True)])
    differ_percent = 100.0 * float(np.sqrt(np.mean(np.abs(differ - 1.0) ** 2)))
    difference = np.abs(np.array(ten.spectral) - np.array(one.spectral))
    deviation = np.hypot(ten.standard_deviation, one.standard_deviation)
    agree = 100.0 * float(np.mean(difference < WITHIN_95 * deviation))
    yield Figure("error_db", db, "dB", "Ho-Kalman, diagonal, 1 to 64 Hz: largest error")
    yield Figure("error_deg", deg, "deg", "phase")
    yield Figure("error_1khz_db", db_1, "dB", "the same from 1 kHz: largest error", "error_db")
    yield Figure("error_1khz_deg", deg_1, "deg", "phase", "error_deg")
    yield Figure("differ_percent", differ_percent, "%", "Ho-Kalman, 10 kHz less 1 kHz: rms")
    label = "(15), all entries: share within 95 % confidence"
    yield Figure("agree_percent", agree, "%", label, None, LEAST_AGREE)


def to_plants(logs: Sequence[Path]) -> Found:
    """Return P at each position, and the time of each stage."""
    found = Found()
    with found.stage("reading"):
        records = [from_log(read_log(path)) for path in logs]
    for point in operating_points(records):
        first = point.records[0]
        assert first.controller is not None
        pole = float(np.exp(-first.Ts_s / LAG_S))
        with found.stage("markov parameters"):
            g = estimate_markov(point.records, impulse_taps(point.records), "least_squares").g
        with found.stage("ho_kalman"):
            series = without_delay(g, first.leading_zeros, pole, first.controller, first.Ts_s)
            loop = realise(decompose(series, first.Ts_s, Scaling.of(point.records)), 9)
        with found.stage("plant"):
            core = plant_from_loop(loop, first.controller)
            plant = IdentifiedPlant(core, first.leading_zeros, pole)
        with found.stage("sensitivity"):
            S = sensitivity(point.records, FREQ_HZ, 10.0)
            P = plant_from_sensitivity(S, first.controller)
        found.beams_m.append(point.beam_m or 0.0)
        found.ho_kalman.append(_between_samples(plant.response(FREQ_HZ), first.Ts_s))
        found.spectral.append(_between_samples(P.H, first.Ts_s))
        found.standard_deviation.append(P.standard_deviation)
    return found


def to_results(logs: Sequence[Path]) -> None:
    """Do what `levid identify` does before its report."""
    identify([from_log(read_log(path)) for path in logs], Options(lag_s=LAG_S))


def errors(found: Found, rate_hz: int) -> tuple[float, float]:
    """Return the largest error of the diagonal at any position, in dB and degrees."""
    ratios = []
    for beam_m, P in zip(found.beams_m, found.ho_kalman, strict=True):
        true = _between_samples(true_response(beam_m, FREQ_HZ, rate_hz), 1.0 / rate_hz)
        ratios.append(diagonal_ratio(P, true))
    return worst(ratios)


def _between_samples(P: Complex, Ts_s: float) -> Complex:
    """Return P without the effects of sampling: one cycle of delay and the zero-order hold.

    Aliases above half the rate add less than 2e-4 of P up to 64 Hz at 1 kHz.
    """
    held = np.sinc(FREQ_HZ * Ts_s) * np.exp(-3j * np.pi * FREQ_HZ * Ts_s)
    return np.asarray(P / held[:, None, None])


def _apart(call: Callable[..., object], logs: Sequence[Path]) -> Outcome:
    outcome = measure_apart(call, logs, timeout_s=TIMEOUT_S, memory_bytes=MEMORY_BYTES)
    if outcome.failed:
        raise SystemExit(f"failed: {outcome.failed}")
    return outcome


if __name__ == "__main__":
    run("Identification at 10 kHz", measure)
