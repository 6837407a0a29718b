"""`identify` against the simulator's known plant: errors of each method, coverage, time.

White noise is flown on the nominal rig at three beam positions (one with --quick). The errors of
each method's P stand beside those of scipy's `csd` from plant input to output, which ignores the
loop. The grey box is in greybox.py; methods of other packages and multisines are in peers.py.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np
from scipy import signal

from levid.benchmarks.harness.table import Figure, run
from levid.benchmarks.identification.known_plant import (
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
from levid.identification.subspace.delay_removal import without_delay
from levid.identification.subspace.ho_kalman import Scaling, decompose, realise
from levid.identification.subspace.pbsid import plant_by_subspace
from levid.identification.subspace.plant_from_loop import IdentifiedPlant, plant_from_loop
from levid.identification.subspace.response_uncertainty import SURE_95, response_with_errors
from levid.log.reader import read_log

ABOVE_NOISE = 15.0
"""Couplings are judged where they are so many standard deviations of an estimate without a model.

Such an estimate errs by 2 dB there once in 14 000 entries: exp(-x^2), x = 15 (1 - 10^(-2 / 20)).
"""


def measure(quick: bool) -> Iterator[Figure]:
    with tempfile.TemporaryDirectory() as folder:
        beams_m = [0.0] if quick else [-0.1, 0.0, 0.1]
        logs = fly_white_noise(Path(folder), 1000, beams_m, 60.0, seed=1)
        records = [from_log(read_log(path)) for path in logs]
    seconds = sum(len(r.y) * r.Ts_s for r in records)
    yield Figure("records_s", seconds, "s", f"{len(records)} records at 1 kHz")
    begin = perf_counter()
    result = identify(records, Options(lag_s=LAG_S))
    yield Figure("identify_s", perf_counter() - begin, "s", "identify all of them")
    yield from errors([p for p in result.points if isinstance(p, ClosedLoopPoint)], records)
    yield from coverage(8 if quick else 40)


def errors(points: Sequence[ClosedLoopPoint], records: Sequence[Record]) -> Iterator[Figure]:
    """Yield the largest errors of each method over all positions, 1 to 64 Hz.

    On the diagonal, and off it where the true coupling is ABOVE_NOISE times the noise.
    """
    ratios: dict[str, list[Complex]] = {}
    couplings: dict[str, list[Complex]] = {}
    seen = []
    for point in points:
        assert point.beam_m is not None
        band = (point.freq_hz >= BAND_HZ[0]) & (point.freq_hz <= BAND_HZ[1])
        true = true_response(point.beam_m, point.freq_hz[band], 1000.0)
        coupling = ~np.eye(3, dtype=bool) & (
            np.abs(true) > ABOVE_NOISE * point.from_joint.standard_deviation[band]
        )
        seen.append(coupling.sum() / (6 * band.sum()))
        for label, P in by_every_method(point, records).items():
            ratios.setdefault(label, []).append(diagonal_ratio(P[band], true))
            couplings.setdefault(label, []).append((P[band] / true)[coupling])
    share = 100 * float(np.mean(seen))
    yield Figure("offdiag_percent", share, "%", "couplings above the noise, judged below")
    for label, found in ratios.items():
        key, (dB, degrees) = _KEYS[label], worst(found)
        versus = ("csd_db", "csd_deg") if key != "csd" else (None, None)
        yield Figure(f"{key}_db", dB, "dB", f"{label}: largest error", versus[0])
        yield Figure(f"{key}_deg", degrees, "deg", f"{label}: phase", versus[1])
        if key != "csd" and share:  # csd has no response off the diagonal
            off_dB, _ = worst(couplings[label])
            yield Figure(f"{key}_offdiag_db", off_dB, "dB", f"{label}: error of couplings")


_KEYS = {
    "scipy csd from u to y": "csd",
    "Markov by least squares, Ho-Kalman": "ho_kalman",
    "Markov by correlation, Ho-Kalman": "correlation",
    "Markov by least squares, (14) alone": "markov",
    "sensitivity, (15)": "sensitivity",
    "joint input-output": "joint",
    "subspace": "subspace",
}


def by_every_method(point: ClosedLoopPoint, records: Sequence[Record]) -> dict[str, Complex]:
    """Return each method's P (F, 3, 3), in the order of _KEYS."""
    assert point.subspace is not None
    found = (
        by_csd(point, records), point.from_ho_kalman, by_correlation(point), point.from_markov,
        point.from_sensitivity.H, point.from_joint.H, point.subspace.response.H,
    )  # fmt: skip
    return dict(zip(_KEYS, found, strict=True))


def by_csd(point: ClosedLoopPoint, records: Sequence[Record]) -> Complex:
    """Return csd(u, y) / csd(u, u) of each axis, segments of 10 s."""
    H = np.ones((len(point.freq_hz), 3, 3), complex)
    for record in (r for r in records if r.name in point.records):
        assert record.u is not None
        axis = int(np.flatnonzero(record.excited)[0])
        u, y = record.u[:, axis], record.y[:, axis]
        freq, across = signal.csd(u, y, 1 / record.Ts_s, nperseg=round(10 / record.Ts_s))
        _, power = signal.welch(u, 1 / record.Ts_s, nperseg=round(10 / record.Ts_s))
        H[:, axis, axis] = (across / power)[np.searchsorted(freq, point.freq_hz - 1e-6)]
    return H


def by_correlation(point: ClosedLoopPoint) -> Complex:
    """Return the paper's own method: correlation, nine states, (14)."""
    estimate = point.markov["correlation"]
    pole = float(np.exp(-estimate.Ts_s / LAG_S))
    delay = point.plant.delay_steps
    series = without_delay(estimate.g, delay, pole, point.controller, estimate.Ts_s)
    scaling = Scaling(np.array([3e-4, 3e-4, 9e-5]), np.array([0.1, 0.1, 1.3]))
    loop = realise(decompose(series, estimate.Ts_s, scaling), 9)
    core = plant_from_loop(loop, point.controller)
    return IdentifiedPlant(core, delay, pole).response(point.freq_hz)


def coverage(seeds: int) -> Iterator[Figure]:
    """Yield how often the subspace method's 95 % intervals contain the truth, in short flights."""
    freq_hz = np.geomspace(*BAND_HZ, 40)
    true = true_response(0.1, freq_hz, 1000.0)
    inside = []
    for seed in range(100, 100 + seeds):
        with tempfile.TemporaryDirectory() as folder:
            logs = fly_white_noise(Path(folder), 1000, [0.1], 10.0, seed)
            records = [from_log(read_log(path)) for path in logs]
        found = plant_by_subspace(records, 6, float(np.exp(-records[0].Ts_s / LAG_S)))
        P = response_with_errors(found.plant, found.covariance, freq_hz)
        magnitude = np.abs(np.abs(P.H) - np.abs(true)) / P.magnitude_deviation
        phase = np.abs(np.angle(P.H / true)) / P.phase_deviation_rad
        inside += [np.mean(magnitude < SURE_95), np.mean(phase < SURE_95)]
    percent = 100 * float(np.mean(inside))
    yield Figure("coverage_flights", seeds, "", "flights of 3 x 10 s")
    label = "of the subspace method's 95 % intervals contain the truth"
    yield Figure("subspace_coverage_percent", percent, "%", label)


if __name__ == "__main__":
    run("Identification", measure)
