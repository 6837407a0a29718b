"""Compute the free-run error of a model and its noise floor, by record and DOF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from ...greybox.free_run.free_run_noise_floor import motion_covariance
from ...value_with_interval import PERCENT
from ..linearised.linearisation_point import WorkingPoint
from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions
from .free_run_with_effects import free_run

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RecordError:
    """The free-run error of one record, on the rows that count (after 5 s).

    rows, seconds: length of the rows that count. squares: mean square over rows and sensors, in
    sensor noise variances; floor: the same of noise alone. pose_squares, pose_floor (n,): mean
    squares of the pose's error in SI units; pose_power (n,): those of the pose, without its mean.
    freq_hz (F,), psd (F, n): one-sided spectrum of the
    pose's error. settled: whether the simulation with effects converged. blocks (B,): `squares`
    times the seconds of blocks of about four seconds.
    """

    name: str
    rows: int
    seconds: float
    squares: float
    floor: float
    pose_squares: Array
    pose_floor: Array
    pose_power: Array
    freq_hz: Array
    psd: Array
    settled: bool
    blocks: Array


def record_error(point: WorkingPoint, record: TraceRecord) -> RecordError:
    """Return the free-run error of a record and its noise floor.

    If the simulation diverges they are not finite, without a warning.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return _record_error(point, record)


def _record_error(point: WorkingPoint, record: TraceRecord) -> RecordError:
    run = free_run(point, record)
    e, places = record.experiment, record.places
    error = record.gap[run.counts_from :] - run.gap[run.counts_from :]
    T, sd = places.decoupling, point.disturbance.sensor_sd
    pose = error @ T.T
    moved = motion_covariance(point.model, e, point.hold, point.disturbance.noise)
    shown = np.diag(places.sensor_shape @ moved @ places.sensor_shape.T)
    segment = min(round(SearchOptions.block_s / e.Ts_s), len(error))
    freq_hz, psd = welch(pose, 1 / e.Ts_s, nperseg=segment, axis=0)
    return RecordError(
        record.name,
        len(error),
        len(error) * e.Ts_s,
        float(np.mean(error**2)) / sd**2,
        float(np.mean(shown)) / sd**2 + 1.0,
        np.mean(pose**2, axis=0),
        np.diag(moved) + point.disturbance.noise.output_variance,
        np.var(record.gap[run.counts_from :] @ T.T, axis=0),
        freq_hz,
        psd,
        run.settled,
        _blocks(np.mean(error**2, axis=1) / sd**2, e.Ts_s),
    )


def _blocks(squares: Array, Ts_s: float) -> Array:
    """Return the sums over blocks of squares (rows,), times the sampling period (B,)."""
    blocks = max(round(len(squares) * Ts_s / SearchOptions.block_s), 1)
    return np.array([Ts_s * part.sum() for part in np.array_split(squares, blocks)])


def pooled(errors: Sequence[RecordError]) -> tuple[float, float]:
    """Return RMS error and noise floor over all records and sensors, in noise deviations."""
    weights = shares(errors)
    return (
        float(np.sqrt(weights @ np.array([e.squares for e in errors]))),
        float(np.sqrt(weights @ np.array([e.floor for e in errors]))),
    )


def pooled_pose(errors: Sequence[RecordError]) -> tuple[Array, Array]:
    """Return RMS error and noise floor of each DOF (n,) over all records, in SI units."""
    weights = shares(errors)
    squares = np.array([e.pose_squares for e in errors])
    floors = np.array([e.pose_floor for e in errors])
    return np.sqrt(weights @ squares), np.sqrt(weights @ floors)


def percent_of_pose(errors: Sequence[RecordError]) -> Array:
    """Return the RMS error of each DOF (n,) over the pose's RMS without its mean, in per cent."""
    weights = shares(errors)
    squares, power = (
        weights @ np.array([getattr(e, name) for e in errors])
        for name in ("pose_squares", "pose_power")
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(PERCENT * np.sqrt(squares / power))


def shares(errors: Sequence[RecordError]) -> Array:
    """Return each record's share (R,) of the time that counts."""
    seconds = np.array([e.seconds for e in errors])
    return np.asarray(seconds / seconds.sum())
