"""Identification against the simulator's truth: errors in dB and degrees, times, and ratios.

Flies the white-noise session on the nominal rig (a part of it with --quick), then identifies it
from its logs. Beside each method stands what one would otherwise take: scipy's `csd` from plant
input to output, numpy's SVD of the written-out Hankel matrix, numpy's `lstsq` of the written-out
convolution, and python-control's `eigensys_realization` where that is installed.
"""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from _table import Figure, median_times, run
from numpy.typing import NDArray
from scipy import signal

from levid.config.base import load_yaml
from levid.config.rig import load_rig
from levid.config.session import SessionConfig, load_session
from levid.config.shipped import shipped
from levid.config.sim import SimConfig
from levid.daemon.virtual import fly_virtually
from levid.identification.data import Record
from levid.identification.from_log import records_from_logs
from levid.identification.hankel import HankelOperator, leading_svd
from levid.identification.ho_kalman import Scaling, decompose, realise
from levid.identification.identify import identify
from levid.identification.loop import without_delay
from levid.identification.markov import by_least_squares
from levid.identification.options import Options
from levid.identification.plant import Plant, plant_from_loop
from levid.identification.results import ClosedLoopPoint, IdentificationResult
from levid.identification.toeplitz import ToeplitzGram, solve
from levid.log.reader import read_log
from levid.sim.truth import frequency_response

Complex = NDArray[np.complex128]
BAND_HZ = (1.0, 64.0)
LAG_S = 0.3e-3


def measure(quick: bool) -> Sequence[Figure]:
    records = fly(quick)
    options = Options(lag_s=LAG_S)
    results: list[IdentificationResult] = []
    whole = median_times(
        {"identify": lambda: results.append(identify(records, options))}, 1 if quick else 3
    )
    points = [p for p in results[0].points if isinstance(p, ClosedLoopPoint)]
    seconds = sum(len(r.y) * r.Ts_s for r in records)
    figures = [
        Figure("records_s", seconds, "s", f"{len(records)} records at 1 kHz"),
        Figure("identify_s", whole["identify"], "s", "identify all of them"),
    ]
    figures += errors(points, records)
    figures += speeds(points[0], records, quick)
    return figures


def fly(quick: bool) -> list[Record]:
    """Return the records of the white-noise session; one beam position of it with `quick`."""
    rig_file, session_file = (
        shipped("rigs/loopback.yaml"),
        shipped("sessions/white-noise-1khz.yaml"),
    )
    session = load_session(session_file)
    if quick:
        kept = [s for s in session.steps if s.record is None or s.record.name.startswith("middle")]
        session = SessionConfig(**{**session.model_dump(exclude_unset=True), "steps": kept})
    with tempfile.TemporaryDirectory() as folder:
        flown = fly_virtually(
            load_rig(rig_file), rig_file, session, session_file.read_bytes(), Path(folder),
            lambda *_: None,
        )  # fmt: skip
        records, _ = records_from_logs([read_log(path) for path in flown.records])
    return list(records)


def errors(points: Sequence[ClosedLoopPoint], records: Sequence[Record]) -> list[Figure]:
    """Return the worst errors of every method over all positions, the band and the diagonal."""
    config = load_yaml(shipped("sims/nominal.yaml"), SimConfig)
    methods: dict[str, tuple[str, Callable[[ClosedLoopPoint], Complex]]] = {
        "csd": ("scipy csd from u to y", lambda p: by_csd(p, records)),
        "ho_kalman": ("Markov by least squares, Ho-Kalman", lambda p: p.from_ho_kalman),
        "correlation": ("Markov by correlation, Ho-Kalman", by_correlation),
        "markov": ("Markov by least squares, (14) alone", lambda p: p.from_markov),
        "sensitivity": ("sensitivity, (15)", lambda p: p.from_sensitivity.H),
        "joint": ("joint input-output", lambda p: p.from_joint.H),
    }
    figures = []
    for key, (label, response) in methods.items():
        dB = degrees = 0.0
        for point in points:
            assert point.beam_m is not None
            band = (point.freq_hz >= BAND_HZ[0]) & (point.freq_hz <= BAND_HZ[1])
            true = frequency_response(config, point.beam_m, point.freq_hz, 1000.0)
            ratio = np.einsum("fii->fi", response(point)[band]) / np.einsum("fii->fi", true[band])
            dB = max(dB, float(np.abs(20 * np.log10(np.abs(ratio))).max()))
            degrees = max(degrees, float(np.abs(np.angle(ratio, deg=True)).max()))
        versus = None if key == "csd" else "csd"
        figures.append(
            Figure(
                f"error_{key}_db", dB, "dB", f"{label}: largest error", versus and "error_csd_db"
            )
        )
        figures.append(
            Figure(
                f"error_{key}_deg", degrees, "deg", f"{label}: phase", versus and "error_csd_deg"
            )
        )
    return figures


def by_csd(point: ClosedLoopPoint, records: Sequence[Record]) -> Complex:
    """Return what scipy alone gives: csd(u, y) / csd(u, u) of each axis, 10 s segments."""
    H = np.ones((len(point.freq_hz), 3, 3), complex)
    for axis in range(3):
        record = next(
            r for r in records if r.name in point.records and r.excited[axis] and r.u is not None
        )
        assert record.u is not None
        u, y = record.u[:, axis], record.y[:, axis]
        freq, across = signal.csd(u, y, 1 / record.Ts_s, nperseg=round(10 / record.Ts_s))
        _, power = signal.welch(u, 1 / record.Ts_s, nperseg=round(10 / record.Ts_s))
        H[:, axis, axis] = (across / power)[np.searchsorted(freq, point.freq_hz - 1e-6)]
    return H


def by_correlation(point: ClosedLoopPoint) -> Complex:
    """Return the paper's own way: correlation, nine states, (14)."""
    estimate = point.markov["correlation"]
    pole = float(np.exp(-estimate.Ts_s / LAG_S))
    series = without_delay(
        estimate.g, point.plant.delay_steps, pole, point.controller, estimate.Ts_s
    )
    scaling = Scaling(np.array([3e-4, 3e-4, 9e-5]), np.array([0.1, 0.1, 1.3]))
    loop = realise(decompose(series, estimate.Ts_s, scaling), 9)
    core = plant_from_loop(loop, point.controller)
    return Plant(core, point.plant.delay_steps, pole).response(point.freq_hz)


def speeds(point: ClosedLoopPoint, records: Sequence[Record], quick: bool) -> list[Figure]:
    """Return times beside dense linear algebra, at sizes that it can still do."""
    blocks, taps, rows, repeats = (200, 200, 4000, 3) if quick else (500, 500, 20_000, 3)
    g = point.markov["least_squares"].g
    operator = HankelOperator(g[2:], blocks, blocks)
    used = [r.rows(0, rows) for r in records if r.name in point.records]
    T, Y = written_out(used, taps)

    def by_fft() -> object:
        gram = ToeplitzGram.from_records(used, taps)
        return solve(gram, gram.right_hand_side([r.y for r in used]))

    whole = HankelOperator(g[2:], len(g) // 2 - 1, len(g) // 2 - 1)
    times = median_times(
        {
            "dense_svd": lambda: np.linalg.svd(operator.dense()),
            "fft_svd": lambda: leading_svd(operator, 24),
            "dense_ls": lambda: np.linalg.lstsq(T, Y, rcond=None),
            "fft_ls": by_fft,
            "whole_svd": lambda: leading_svd(whole, 24),
            "whole_ls": lambda: by_least_squares(used_all(point, records), len(g)),
        },
        repeats,
    )
    side = 3 * blocks
    figures = [
        Figure("hankel_dense_s", times["dense_svd"], "s", f"Hankel {side} square, numpy SVD"),
        Figure(
            "hankel_fft_s", times["fft_svd"], "s", "the same, 24 triplets by FFT", "hankel_dense_s"
        ),
        Figure("ls_dense_s", times["dense_ls"], "s", f"{len(T)} x {T.shape[1]}, numpy lstsq"),
        Figure("ls_fft_s", times["fft_ls"], "s", "the same by FFT", "ls_dense_s"),
        Figure("hankel_whole_s", times["whole_svd"], "s", f"Hankel {3 * (len(g) // 2)} square"),
        Figure("ls_whole_s", times["whole_ls"], "s", f"{3 * len(g)} taps from 3 x 60 s"),
    ]
    return figures + python_control(g, blocks)


def used_all(point: ClosedLoopPoint, records: Sequence[Record]) -> list[Record]:
    return [r for r in records if r.name in point.records]


def written_out(records: Sequence[Record], taps: int) -> tuple[NDArray[np.float64], ...]:
    """Return the convolution matrix of all records and inputs, and the outputs."""
    rows = []
    for record in records:
        padded = np.concatenate([np.zeros((taps - 1, 3)), record.v])
        window = np.lib.stride_tricks.sliding_window_view(padded, taps, axis=0)[:, :, ::-1]
        rows.append(window.reshape(len(record.v), -1)[record.first_row(taps) :])
    return np.vstack(rows), np.vstack([r.y[r.first_row(taps) :] for r in records])


def python_control(g: NDArray[np.float64], blocks: int) -> list[Figure]:
    """Return the time of python-control's eigensystem realisation, if it is there."""
    installed = importlib.util.find_spec("control") is not None
    present = Figure(
        "control_installed", float(installed), "", "python-control installed (1) or not"
    )
    if not installed:
        return [present]
    import control

    markov = g[: 2 * blocks + 1].transpose(1, 2, 0)
    times = median_times(
        {"era": lambda: control.eigensys_realization(markov, 9, m=blocks, n=blocks)}, 1
    )
    label = f"python-control eigensys_realization, {3 * blocks} square"
    return [present, Figure("control_era_s", times["era"], "s", label, "hankel_fft_s")]


if __name__ == "__main__":
    run("identification", measure)
