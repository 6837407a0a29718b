"""Identification against the simulator's truth: errors in dB and degrees, times, and ratios.

Flies the white-noise session on the nominal rig (one beam position of it with --quick), and
multisines for the same time, then identifies the plant from these logs by every method. The grey
box starts from a declared model that is 10 % off. Beside each method stands what one would
otherwise take: scipy's `csd` from plant input to output, numpy's SVD of the written-out Hankel
matrix, numpy's `lstsq` of the written-out convolution, and python-control's `eigensys_realization`
where that is installed.
"""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from levid.benchmarks.harness.declared_model import off_by_a_tenth
from levid.benchmarks.harness.multisine_records import fly_multisines
from levid.benchmarks.harness.table import Figure, median_times, run
from levid.benchmarks.harness.white_noise_records import fly as fly_noise
from levid.config.base import load_yaml
from levid.config.model import ModelConfig
from levid.config.rig import load_rig
from levid.config.session import SessionConfig, load_session
from levid.config.shipped import shipped
from levid.config.sim import SimConfig
from levid.daemon.loop.virtual_session import fly_virtually
from levid.identification.greybox.experiment import Experiment, experiment_from_log
from levid.identification.greybox.identify_greybox import identify_grey_box
from levid.identification.identify import identify
from levid.identification.nonparametric.local_polynomial import plant_by_local_polynomial
from levid.identification.nonparametric.markov_parameters import by_least_squares
from levid.identification.nonparametric.robust_multisine import at_every_position
from levid.identification.nonparametric.toeplitz_least_squares import ToeplitzGram, solve
from levid.identification.options import Options
from levid.identification.records.from_log import from_log, records_from_logs
from levid.identification.records.periodic_records import PeriodicRecord, periodic_record
from levid.identification.records.record import Record
from levid.identification.results import ClosedLoopPoint, IdentificationResult
from levid.identification.subspace.delay_removal import without_delay
from levid.identification.subspace.hankel_operator import HankelOperator, leading_svd
from levid.identification.subspace.ho_kalman import Scaling, decompose, realise
from levid.identification.subspace.pbsid import plant_by_subspace
from levid.identification.subspace.plant_from_loop import IdentifiedPlant, plant_from_loop
from levid.identification.subspace.response_uncertainty import SURE_95, response_with_errors
from levid.log.reader import read_log
from levid.sim.true_response import frequency_response

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
BAND_HZ = (1.0, 64.0)
LAG_S = 0.3e-3
ABOVE_NOISE = 15.0
"""Standard deviations of an estimate without a model: it then errs by 2 dB once in 14 000 entries.

By exp(-x^2) of a circular error, x = 15 (1 - 10^(-2 / 20)).
"""
LABELS = {
    "csd": "scipy csd from u to y",
    "ho_kalman": "Markov by least squares, Ho-Kalman",
    "subspace": "subspace",
    "multisine": "multisine",
    "local_polynomial": "local polynomial",
    "grey_box": "grey box",
    "sensitivity": "sensitivity, (15)",
    "joint": "joint input-output",
    "markov": "Markov by least squares, (14) alone",
    "correlation": "Markov by correlation, Ho-Kalman",
}


def measure(quick: bool) -> Sequence[Figure]:
    flown = fly(quick)
    options = Options(lag_s=LAG_S)
    results: list[IdentificationResult] = []
    whole = median_times(
        {"identify": lambda: results.append(identify(flown.records, options))}, 1 if quick else 3
    )
    points = [p for p in results[0].points if isinstance(p, ClosedLoopPoint)]
    seconds = sum(len(r.y) * r.Ts_s for r in flown.records)
    figures = [
        Figure("records_s", seconds, "s", f"{len(flown.records)} records at 1 kHz"),
        Figure("identify_s", whole["identify"], "s", "identify all of them"),
    ]
    estimates, costs = by_every_method(points, flown)
    figures += errors(estimates)
    figures += [Figure(f"{key}_s", s, "s", f"{LABELS[key]}: time") for key, s in costs.items()]
    figures += coverage(8 if quick else 40)
    figures += speeds(points[0], flown.records, quick)
    return figures


@dataclass(frozen=True)
class Flown:
    """The same logs as records and as the fit takes them, the model it starts from, multisines."""

    records: tuple[Record, ...]
    experiments: tuple[Experiment, ...]
    model: ModelConfig
    multisines: tuple[PeriodicRecord, ...]


def fly(quick: bool) -> Flown:
    """Fly the white-noise session, and multisines for the same time; `quick`: one position each."""
    rig_file, session_file = (
        shipped("rigs/loopback.yaml"),
        shipped("sessions/white-noise-1khz.yaml"),
    )
    session = load_session(session_file)
    beams_m = [-0.1, 0.0, 0.1]
    if quick:
        kept = [s for s in session.steps if s.record is None or s.record.name.startswith("middle")]
        session = SessionConfig(**{**session.model_dump(exclude_unset=True), "steps": kept})
        beams_m = [0.0]
    model = off_by_a_tenth(1)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "noise"
        flown = fly_virtually(
            load_rig(rig_file), rig_file, session, session_file.read_bytes(), out, lambda *_: None
        )
        logs = [read_log(path) for path in flown.records]
        records, _ = records_from_logs(logs)
        periodic = fly_multisines(Path(folder) / "multisines", beams_m, 60.0, seed=1)
        return Flown(
            tuple(records),
            tuple(experiment_from_log(log, model) for log in logs),
            model,
            tuple(periodic_record(read_log(path)) for path in periodic),
        )


@dataclass(frozen=True)
class Estimate:
    """P (F, 3, 3) at freq_hz (F,) by one method at one position, and the noise it has to bear.

    `noise` (F, 3, 3): standard deviation of what the same data tell without a model.
    """

    key: str
    beam_m: float
    freq_hz: Array
    P: Complex
    noise: Array


def by_every_method(
    points: Sequence[ClosedLoopPoint], flown: Flown
) -> tuple[list[Estimate], dict[str, float]]:
    """Return every method's estimates at all positions, and what some of them cost in s."""
    found: list[Estimate] = []
    start = perf_counter()
    grey = identify_grey_box(flown.model, flown.experiments, 0.0)
    costs = {"grey_box": perf_counter() - start, "subspace": 0.0, "local_polynomial": 0.0}
    for point in points:
        assert point.beam_m is not None
        used = used_all(point, flown.records)
        training = [r.rows(0, len(r.y) * 3 // 4) for r in used]
        start = perf_counter()
        plant_by_subspace(training, lag_pole=point.plant.lag_pole)
        costs["subspace"] += perf_counter() - start
        start = perf_counter()
        local = plant_by_local_polynomial(used, point.freq_hz)
        costs["local_polynomial"] += perf_counter() - start
        assert point.subspace is not None
        for key, P in (
            ("csd", by_csd(point, flown.records)),
            ("ho_kalman", point.from_ho_kalman),
            ("correlation", by_correlation(point)),
            ("markov", point.from_markov),
            ("sensitivity", point.from_sensitivity.H),
            ("joint", point.from_joint.H),
            ("local_polynomial", local.H),
            ("subspace", point.subspace.response.H),
            ("grey_box", grey.response({"x_b": point.beam_m}, point.freq_hz)),
        ):
            noise = point.from_joint.standard_deviation
            found.append(Estimate(key, point.beam_m, point.freq_hz, P, noise))
    start = perf_counter()
    approximations = at_every_position(flown.multisines)
    costs["multisine"] = perf_counter() - start
    for bla in approximations:
        assert bla.beam_m is not None
        noise = bla.standard_deviation
        found.append(Estimate("multisine", bla.beam_m, bla.freq_hz, bla.H, noise))
    return found, costs


def errors(estimates: Sequence[Estimate]) -> list[Figure]:
    """Return the worst errors of every method over all positions and the band.

    On the diagonal, and off it wherever the true coupling stands ABOVE_NOISE times above the noise;
    where none does, only that share is told.
    """
    config = load_yaml(shipped("sims/nominal.yaml"), SimConfig)
    figures = []
    couplings = ~np.eye(3, dtype=bool)
    for key, label in LABELS.items():
        dB, degrees, coupled_dB, judged = [], [], [], []
        for e in (e for e in estimates if e.key == key):
            band = (e.freq_hz >= BAND_HZ[0]) & (e.freq_hz <= BAND_HZ[1])
            true = frequency_response(config, e.beam_m, e.freq_hz[band], 1000.0)
            level = np.abs(20 * np.log10(np.abs(e.P[band] / true)))
            dB.append(np.einsum("fii->fi", level))
            angle = np.angle(np.einsum("fii->fi", e.P[band] / true), deg=True)
            degrees.append(np.abs(angle))
            seen = couplings & (np.abs(true) > ABOVE_NOISE * e.noise[band])
            judged.append(seen[:, couplings])
            coupled_dB.append(level[seen])
        against = {"db": "csd_db", "deg": "csd_deg"} if key != "csd" else {}
        figures += [
            Figure(f"{key}_db", _worst(dB), "dB", f"{label}: largest error", against.get("db")),
            Figure(f"{key}_deg", _worst(degrees), "deg", f"{label}: phase", against.get("deg")),
        ]
        if key == "csd":  # which has no response off the diagonal
            continue
        share = 100 * float(np.mean(np.concatenate(judged)))
        figures.append(Figure(f"{key}_offdiag_percent", share, "%", f"{label}: couplings judged"))
        if share:  # else nothing is known of their error
            worst = _worst(coupled_dB)
            figures.append(Figure(f"{key}_offdiag_db", worst, "dB", f"{label}: their error"))
    return figures


def _worst(errors: Sequence[Array]) -> float:
    """Return the largest error; one that is no number is none that is small."""
    return float(np.max(np.concatenate(errors)))


def coverage(seeds: int) -> list[Figure]:
    """Return how often the subspace method's 95 % intervals hold the truth, over short flights."""
    freq_hz = np.geomspace(*BAND_HZ, 40)
    true = frequency_response(load_yaml(shipped("sims/nominal.yaml"), SimConfig), 0.1, freq_hz, 1e3)
    inside: list[float] = []
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as folder:
            logs = fly_noise(Path(folder), 1000, [0.1], 10.0, 100 + seed)
            records = [from_log(read_log(path)) for path in logs]
        found = plant_by_subspace(records, 6, float(np.exp(-records[0].Ts_s / LAG_S)))
        P = response_with_errors(found.plant, found.covariance, freq_hz)
        magnitude = np.abs(np.abs(P.H) - np.abs(true)) / P.magnitude_deviation
        phase = np.abs(np.angle(P.H / true)) / P.phase_deviation_rad
        inside += [float(np.mean(magnitude < SURE_95)), float(np.mean(phase < SURE_95))]
    return [
        Figure("coverage_flights", seeds, "", "flights of 3 x 10 s"),
        Figure(
            "subspace_coverage_percent",
            100 * float(np.mean(inside)),
            "%",
            "of the subspace method's 95 % intervals hold the truth",
        ),
    ]


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
    return IdentifiedPlant(core, point.plant.delay_steps, pole).response(point.freq_hz)


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
