"""Validate a model on records: simulation fit, residual spectrum, whiteness, noise floor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch
from scipy.stats import chi2, norm

from ...model.declared_model import DeclaredModel
from ..subspace.fit_percent import BLOCKS, larger_by_chance, nrmse_fit_percent
from .experiment.experiment_from_log import Experiment
from .experiment.intersample_input import Hold
from .force_balance.instrumental_variables import force_percent
from .free_run.free_run_noise_floor import floor_psd, noise_floor
from .free_run.free_run_simulation import first_row, free_run
from .prediction.discretisation import motion
from .prediction.multistep_prediction import horizon_rows, predict_ahead
from .prediction.noise_model import Noise
from .prediction.prediction_errors import predict

Array = NDArray[np.float64]

Metric = Literal["free_run", "prediction"]

_DIVERGED = 100.0
"""Error over the output's standard deviation above which a simulation has diverged."""
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
    """One record against its free-run simulation or its prediction, rows from `time_s` on.

    `metric`: free_run, or prediction for a loop with an unknown controller; then `simulated` is
    predicted `horizon_s` ahead, and one_step_percent (n,) is the error one row ahead over the
    output, RMS without the mean. measured, simulated (N, n); fit_percent (n,); error_rms (n,) of
    measured minus simulated; floor_rms (n,): noise floor of a perfect model in this record's loop,
    nan where nothing separates noise from the model's error; floor_spread (n,): its relative
    standard deviation for one record of this length; freq_hz (F,), error_psd and floor_psd (F, n):
    one-sided spectra of error and noise floor; force_percent (n,): residual force over input force,
    nan if it is not known; schedule: scheduling variables of the same rows (N,), in SI units.
    """

    record: str
    metric: Metric
    horizon_s: float
    one_step_percent: Array
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
    force_percent: Array
    whiteness: Whiteness
    schedule: Mapping[str, Array]

    @property
    def error_percent(self) -> Array:
        """Error over the output (n,) in per cent, RMS without the mean."""
        with np.errstate(divide="ignore", invalid="ignore"):  # an output may rest in these rows
            return np.asarray(100.0 * self.error_rms / self.measured.std(axis=0))

    @property
    def explains_something(self) -> bool:
        """Whether the error at an output is smaller than the output, by more than chance."""
        if len(self.measured) < BLOCKS:
            return bool(np.any(self.error_percent < 100.0))
        pairs = zip(self.measured.T, (self.measured - self.simulated).T, strict=True)
        return any(bool(np.all(np.isfinite(e))) and not larger_by_chance(y, e) for y, e in pairs)


def metric_of(model: DeclaredModel, experiment: Experiment) -> Metric:
    """Return what measures the model's error on a record.

    A free run needs the loop. Without a loop the input is known, but an integrating or unstable
    model forgets an error of its state in no shorter time than the record lasts.
    """
    if experiment.loop is not None:
        return "free_run"
    at = motion(model, experiment, "zoh")
    slowest = float(np.abs(np.linalg.eigvals(at.flow)).max()) if at.fixed else 0.0
    forgets = slowest < np.exp(-1.0 / len(experiment.y))
    return "free_run" if forgets and not experiment.feedback else "prediction"


def validate(
    model: DeclaredModel,
    experiment: Experiment,
    hold: Hold,
    noise: Noise,
    floor_noise: Noise | None = None,
) -> Validation:
    """Simulate or predict a record, and compare the error with the noise floor.

    `noise` is that of the Kalman filter, `floor_noise` that of the floor; None: there is no floor.
    """
    metric = metric_of(model, experiment)
    n = experiment.y.shape[1]
    horizon = 0
    first, outputs = 0, experiment.y
    if metric == "free_run":
        run = free_run(model, experiment, hold, noise)
        first, outputs = run.counts_from, run.y
        if not _bounded(run.y, experiment.y):
            metric = "prediction"
    if metric == "prediction":
        horizon = horizon_rows(model, experiment, hold)
        first = max(first_row(experiment), horizon)
        outputs = predict_ahead(model, experiment, hold, noise, horizon)
    rows = slice(first, None)
    measured, simulated = experiment.y[rows], outputs[rows]
    error = measured - simulated
    known = predict(model, experiment, hold, noise)
    one_step, errors = known.innovations[rows], known.errors[rows]
    unknown = np.full(n, np.nan)
    floor = None
    if floor_noise is not None and metric == "free_run":
        floor = noise_floor(model, experiment, hold, floor_noise)
    segment = min(max(round(_SEGMENT_S / experiment.Ts_s), _SEGMENT_ROWS), len(error))
    freq_hz, error_psd = welch(error, 1 / experiment.Ts_s, nperseg=segment, axis=0)
    time_s = np.asarray(np.arange(first, len(experiment.y)) * experiment.Ts_s)
    with np.errstate(divide="ignore", invalid="ignore"):
        one_step_percent = 100.0 * one_step.std(axis=0) / measured.std(axis=0)
    return Validation(
        experiment.name,
        metric,
        horizon * experiment.Ts_s,
        one_step_percent,
        time_s,
        measured,
        simulated,
        nrmse_fit_percent(measured, simulated),
        error.std(axis=0),
        unknown if floor is None else floor.rms,
        unknown if floor is None else floor.spread,
        freq_hz,
        error_psd,
        np.full_like(error_psd, np.nan)
        if floor is None or floor_noise is None
        else floor_psd(model, experiment, hold, floor_noise, freq_hz),
        force_percent(model, [experiment], hold),
        whiteness(errors),
        {name: values[rows] for name, values in experiment.schedule.items()},
    )


def _bounded(simulated: Array, measured: Array) -> bool:
    """Return whether a simulation stays near the outputs; a wrong controller may destabilise it."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.sqrt(np.mean((simulated - measured) ** 2, axis=0))
    return bool(np.all(error < _DIVERGED * measured.std(axis=0)))


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
