"""Validate a model on records: simulation fit, residual spectrum, whiteness, noise floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch
from scipy.stats import chi2, norm

from ...model.declared_model import DeclaredModel
from ..subspace.fit_percent import nrmse_fit_percent
from .experiment_from_log import Experiment
from .free_run import free_run
from .free_run_noise_floor import floor_psd, noise_floor
from .intersample_input import Hold
from .noise_model import Noise
from .prediction_errors import predict

Array = NDArray[np.float64]

_LAGS = 25
_SEGMENT_S = 4.0
_SEGMENT_ROWS = 64
"""Least rows of a segment: 32 lines, of which a Hann window averages three."""


@dataclass(frozen=True)
class Whiteness:
    """The Ljung-Box test of one-step-ahead errors, one value for each output (n,).

    correlation (n, lags): autocorrelation from lag 1 on; bound: limit that 99 % of white records do
    not exceed at any lag; p_value: probability that a white record has a larger statistic.
    """

    correlation: Array
    bound: float
    p_value: Array


@dataclass(frozen=True)
class Validation:
    """One record against its free-run simulation, rows from `time_s` on.

    measured, simulated (N, n); fit_percent (n,); error_rms (n,) of measured minus simulated;
    floor_rms (n,): noise floor of a perfect model in this record's loop; floor_spread (n,): its
    relative standard deviation for one record of this length; freq_hz (F,), error_psd and floor_psd
    (F, n): one-sided spectra of error and noise floor; schedule: scheduling variables of the same
    rows (N,), in SI units.
    """

    record: str
    time_s: Array
    measured: Array
    simulated: Array
    fit_percent: Array
    error_rms: Array
    floor_rms: Array
    floor_spread: Array
    freq_hz: Array
    error_psd: Array
    floor_psd: Array
    whiteness: Whiteness
    schedule: Mapping[str, Array]


def validate(model: DeclaredModel, experiment: Experiment, hold: Hold, noise: Noise) -> Validation:
    """Simulate a record, and compare the error with the noise floor."""
    run = free_run(model, experiment, hold, noise)
    rows = slice(run.counts_from, None)
    measured, simulated = experiment.y[rows], run.y[rows]
    error = measured - simulated
    floor = noise_floor(model, experiment, hold, noise)
    segment = min(max(round(_SEGMENT_S / experiment.Ts_s), _SEGMENT_ROWS), len(error))
    freq_hz, error_psd = welch(error, 1 / experiment.Ts_s, nperseg=segment, axis=0)
    errors = predict(model, experiment, hold, noise).errors[rows]
    time_s = np.asarray(np.arange(run.counts_from, len(experiment.y)) * experiment.Ts_s)
    return Validation(
        experiment.name,
        time_s,
        measured,
        simulated,
        nrmse_fit_percent(measured, simulated),
        error.std(axis=0),
        floor.rms,
        floor.spread,
        freq_hz,
        error_psd,
        floor_psd(model, experiment, hold, noise, freq_hz),
        whiteness(errors),
        {name: values[rows] for name, values in experiment.schedule.items()},
    )


def whiteness(errors: Array, lags: int = _LAGS) -> Whiteness:
    """Apply the Ljung-Box test to whitened errors (N, n), with `lags` lags, at most N / 4."""
    n, centred = len(errors), errors - errors.mean(axis=0)
    lags = min(lags, n // 4)  # larger lags are sums of few terms
    power = np.sum(centred**2, axis=0)
    rho = np.array([np.sum(centred[k:] * centred[:-k], axis=0) / power for k in range(1, lags + 1)])
    Q = n * (n + 2) * np.sum(rho**2 / (n - np.arange(1, lags + 1))[:, None], axis=0)
    # The lags are nearly independent: each may exceed the bound with its share of 1 %.
    bound = float(norm.isf(0.005 / max(lags, 1))) / np.sqrt(n)
    return Whiteness(rho.T, bound, np.asarray(chi2.sf(Q, lags)))


def summary_lines(validations: Sequence[Validation], names: Sequence[str]) -> list[str]:
    """Return a line for each record: fit in percent and error over noise floor, by output."""
    lines = []
    for v in validations:
        parts = [
            f"{name} {fit:.2f} % ({error / max(floor, 1e-300):.2f} x floor)"
            for name, fit, error, floor in zip(
                names, v.fit_percent, v.error_rms, v.floor_rms, strict=True
            )
        ]
        lines.append(f"{v.record}: {', '.join(parts)}")
    return lines
