"""`identify` against the simulator's known plant: errors of each method, coverage, time.

White noise is flown on the nominal rig at three beam positions (one with --quick). The errors of
each method's P stand beside those of scipy's `csd` from plant input to output, which ignores the
loop. The grey box is in greybox.py; other packages are in package_comparison.py.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np

from levid.benchmarks.harness.benchmark_runner import Figure, run
from levid.benchmarks.identification.identification_methods import scipy_csd_direct
from levid.benchmarks.identification.simulated_flight_and_truth import (
    BAND_HZ,
    LAG_S,
    Complex,
    diagonal_ratio,
    fly_white_noise,
    true_response,
    worst,
)
from levid.identification.identify import identify
from levid.identification.options import Options
from levid.identification.records.from_log import from_log
from levid.identification.records.record import Record
from levid.identification.results import ClosedLoopPoint
from levid.identification.subspace.plant_by_spectra import plant_by_spectra
from levid.identification.subspace.response_uncertainty import SURE_95, response_with_errors
from levid.log.reader import read_log


def measure(quick: bool) -> Iterator[Figure]:
    records = flown([0.0] if quick else [-0.1, 0.0, 0.1], 60.0, 1)
    begin = perf_counter()
    result = identify(records, Options(lag_s=LAG_S))
    label = f"identify {len(records)} records of 60 s at 1 kHz"
    yield Figure("identify_s", perf_counter() - begin, "s", label)
    yield from errors([p for p in result.points if isinstance(p, ClosedLoopPoint)], records)
    yield from coverage(8 if quick else 40, 10.0)
    yield from coverage(4 if quick else 24, 30.0)


def flown(beams_m: Sequence[float], duration_s: float, seed: int) -> list[Record]:
    """Return records of white noise at each input and beam position."""
    with tempfile.TemporaryDirectory() as folder:
        logs = fly_white_noise(Path(folder), 1000, beams_m, duration_s, seed)
        return [from_log(read_log(path)) for path in logs]


def errors(points: Sequence[ClosedLoopPoint], records: Sequence[Record]) -> Iterator[Figure]:
    """Yield the largest errors of each method's diagonal over all positions, 1 to 64 Hz."""
    ratios: dict[str, list[Complex]] = defaultdict(list)
    for point in points:
        assert point.beam_m is not None
        assert point.subspace is not None
        band = (point.freq_hz >= BAND_HZ[0]) & (point.freq_hz <= BAND_HZ[1])
        there = [record for record in records if record.name in point.records]
        true = true_response(point.beam_m, point.freq_hz, 1000.0)
        for key, P in {
            "csd": scipy_csd_direct(there, point.freq_hz),
            "ho_kalman": point.from_ho_kalman,
            "markov": point.from_markov,
            "sensitivity": point.from_sensitivity.H,
            "joint": point.from_joint.H,
            "subspace": point.subspace.response.H,
        }.items():
            ratios[key].append(diagonal_ratio(P[band], true[band]))
    for key, found in ratios.items():
        dB, degrees = worst(found)
        versus = ("csd_db", "csd_deg") if key != "csd" else (None, None)
        yield Figure(f"{key}_db", dB, "dB", f"{key}: largest error", versus[0])
        yield Figure(f"{key}_deg", degrees, "deg", f"{key}: phase", versus[1])


def coverage(seeds: int, duration_s: float) -> Iterator[Figure]:
    """Yield how often the subspace method's 95 % intervals contain the truth, in short flights."""
    freq_hz = np.geomspace(*BAND_HZ, 40)
    true = true_response(0.1, freq_hz, 1000.0)
    inside = []
    for seed in range(100, 100 + seeds):
        records = flown([0.1], duration_s, seed)
        found = plant_by_spectra(records, 6, float(np.exp(-records[0].Ts_s / LAG_S)))
        P = response_with_errors(found.plant, found.covariance, freq_hz)
        magnitude = np.abs(np.abs(P.H) - np.abs(true)) / P.magnitude_deviation
        phase = np.abs(np.angle(P.H / true)) / P.phase_deviation_rad
        inside += [np.mean(magnitude < SURE_95), np.mean(phase < SURE_95)]
    percent = 100 * float(np.mean(inside))
    label = (
        f"of the subspace method's 95 % intervals hold the truth, {seeds} x 3 x {duration_s:g} s"
    )
    yield Figure(f"subspace_coverage_{duration_s:g}s_percent", percent, "%", label)


if __name__ == "__main__":
    run("Identification", measure)
