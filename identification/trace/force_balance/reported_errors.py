"""Compute a model's errors on the part of a record that neither fitted nor chose it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...greybox.experiment.experiment_from_log import Experiment
from ...greybox.free_run.free_run_noise_floor import floor_rms
from ...greybox.prediction.noise_model import Noise
from ...greybox.validation import metric_of
from ...records.record import IdentificationError
from ...rounding import ROUNDED_SD, SINGLE_ROUNDING, TINY
from ...value_with_interval import PERCENT
from ..linearised.linearisation_point import WorkingPoint
from ..records.record_from_log import TraceRecord
from ..records.sensor_and_amplifier_noise import Disturbance
from ..records.sensor_white_noise import white_noise
from ..residual.free_run_with_effects import free_run
from ..search_options import SearchOptions
from .force_record import ForceModel, ForceRecord

Array = NDArray[np.float64]
Metric = Literal["free_run", "force"]

DIVERGED = 1.0 / SearchOptions.accuracy
"""Error over the output's standard deviation above which a simulation has diverged."""


@dataclass(frozen=True)
class ReportedError:
    """Errors of one record, each (n,), in SI units.

    error: RMS of the free-run simulation, nan without one. floor: what the stated noise of the
    outputs alone leaves of it in the record's loop, nan if it is not stated. output, force_acting,
    force: standard deviations of the output, of the acting and of the missing force. force_noise:
    what the noise of the outputs, stated or estimated, gives of the last. settled: whether the
    simulation with effects converged.
    """

    record: str
    seconds: float
    error: Array
    floor: Array
    output: Array
    force: Array
    force_acting: Array
    force_noise: Array
    settled: bool


def output_noise(records: Sequence[TraceRecord]) -> Array:
    """Return the noise of each output (n,), with quantisation, as stated or estimated.

    What is not stated comes from the upper half of the frequencies, where there is more than noise
    if the record is sampled slowly.
    """
    found = []
    for record in records:
        e = record.experiment
        n = e.y.shape[1]
        own = np.full(n, np.nan) if e.noise_sd is None else e.noise_sd
        step_stated = np.full(n, np.nan) if e.resolution is None else e.resolution
        seen = np.array([_step(column) for column in e.y.T])
        step = np.where(
            np.isfinite(step_stated), step_stated, np.where(np.isfinite(own), 0.0, seen)
        )
        sd = np.where(np.isfinite(own), np.hypot(own, ROUNDED_SD * step), white_noise(e.y))
        # An axis that rests all the time says nothing of its noise.
        rests = (np.ptp(e.y, axis=0) == 0.0) & np.isnan(own) & np.isnan(step_stated)
        found.append(np.where(rests, np.nan, np.maximum(sd, ROUNDED_SD * step)))
    spread = np.max([r.experiment.y.std(axis=0) for r in records], axis=0)
    moves = np.any(np.isfinite(found), axis=0)
    sd = np.nanmedian(np.where(moves, found, 0.0), axis=0)
    return np.asarray(np.maximum(sd, SINGLE_ROUNDING * spread))


def _step(values: Array) -> float:
    """Return the smallest step between the values of a quantised record; 0 if it has none.

    A record is quantised if most neighbouring values of its sorted ones are equal.
    """
    ordered = np.sort(values)
    steps = np.diff(ordered)
    positive = steps[steps > 0.0]
    if 2 * len(positive) > len(steps) or not len(positive):
        return 0.0
    return float(np.median(positive))


def reported_error(
    point: ForceModel,
    record: TraceRecord,
    begin: int,
    below: tuple[ForceRecord, Array],
    stated: Noise | None,
) -> ReportedError:
    """Return the errors of a model on the rows of a record from `begin` on.

    below: the same rows below the band's limit, and the RMS missing force that the noise of the
    outputs gives there (n,). stated: the noise that the records state, None if they do not.
    """
    seen, noise = below
    missing = seen.varying(seen.missing_force(point))
    acting = seen.acting_force(point)
    e = record.experiment.rows(begin, record.rows)
    error = floor = np.full(e.y.shape[1], np.nan)
    settled = True
    if runs_free(point, e):
        error, settled = _simulated(point, record, begin, missing, seen)
        if stated is not None:
            floor = floor_rms(point.model, e, seen.band.hold, stated)
    return ReportedError(
        record.name,
        len(e.y) * e.Ts_s,
        error,
        floor,
        e.y.std(axis=0),
        missing.std(axis=0),
        acting.std(axis=0),
        noise,
        settled,
    )


def runs_free(point: ForceModel, experiment: Experiment) -> bool:
    """Return whether a free run measures the model: it is stable, and slow enough for the rows.

    A stiff stage below its resonance has a mass near nothing if its record does not tell the mass.
    """
    try:
        return metric_of(point.model, experiment) == "free_run"
    except IdentificationError:
        return False


def noise_of_filter(missing: Array, seen: ForceRecord) -> Noise:
    """Return the noise by which a filter estimates the state at the begin of a free run.

    missing (n,): variance of the missing force, which is white below the band's limit.
    """
    density = np.maximum(missing / (2.0 * seen.band.cutoff_hz), TINY)
    return Noise.independent(density, seen.noise_sd**2)


def _simulated(
    point: ForceModel, record: TraceRecord, begin: int, missing: Array, seen: ForceRecord
) -> tuple[Array, bool]:
    """Return the RMS error (n,) of a free run, nan if it diverges or does not converge, and whether
    it converged."""
    e, sd = record.experiment, seen.noise_sd
    noise = noise_of_filter(missing.var(axis=0), seen)
    disturbance = Disturbance(noise, float(np.median(sd)), measured=False)
    at = WorkingPoint(point.model, point.parameters, point.placed, disturbance, seen.band.hold)
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            run = free_run(at, record, sd, begin)
            readings = run.gap @ record.places.decoupling.T
            error = (e.y - readings)[run.counts_from :]
            rms = np.sqrt(np.mean(error**2, axis=0))
    except (IdentificationError, np.linalg.LinAlgError):
        return np.full(e.y.shape[1], np.nan), False
    bounded = bool(np.all(rms < DIVERGED * e.y[begin:].std(axis=0)))
    return (rms if bounded and run.settled else np.full_like(rms, np.nan)), run.settled


@dataclass(frozen=True)
class PooledError:
    """Errors of all records (n,): RMS, in per cent of the output, and in per cent of the force.

    floor: as ReportedError.floor. noise_percent: force that the noise of the outputs gives.
    """

    error: Array
    floor: Array
    percent: Array
    force_percent: Array
    noise_percent: Array

    @classmethod
    def of(cls, errors: Sequence[ReportedError]) -> PooledError:
        """Return the errors of records, by their length."""
        weight = np.array([e.seconds for e in errors])[:, None] / sum(e.seconds for e in errors)

        def rms(name: str) -> Array:
            values = np.array([getattr(e, name) for e in errors])
            return np.asarray(np.sqrt(np.sum(weight * values**2, axis=0)))

        with np.errstate(divide="ignore", invalid="ignore"):
            return cls(
                rms("error"),
                rms("floor"),
                PERCENT * rms("error") / rms("output"),
                PERCENT * rms("force") / rms("force_acting"),
                PERCENT * rms("force_noise") / rms("force_acting"),
            )
