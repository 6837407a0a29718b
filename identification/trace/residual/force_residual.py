"""Compute a record's residual: generalised force, non-rigid readings, and drive force."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from ....model.effects.base import Placed, Term
from ...greybox.free_run.free_run_noise_floor import powers_of
from ...greybox.prediction.discretisation import Motion, input_moments
from ...rounding import ROUNDED_SD, TINY
from ..linearised.drive_force_residual import beside_motion, calm, drive_errors
from ..linearised.intersample_moments import POINTS, force_moments
from ..linearised.linearisation_point import Along, WorkingPoint, along, corrected_experiment
from ..records.effect_signals import rate
from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions

Array = NDArray[np.float64]

_EDGE_ROWS = POINTS // 2
"""Rows at both ends without a central difference of sixth order."""
FADE_S = 0.5
"""Duration of the fade of Missing.force at both ends of a record."""
_THIRD = float(np.cbrt(2.0))
_PASSED = SearchOptions().much_left
"""Least ratio of a residual's density to the noise's that passes the filter."""
WORST = SearchOptions.least_gain**-2
"""Largest ratio of the force-equivalent noise to its minimum; beyond, the force is unknown."""
_LINE = SearchOptions().least_squares
"""Ratio to noise above which a line always passes; averages of ten spectra do not reach it."""


@dataclass(frozen=True)
class Missing:
    """The residual of a record at a working point.

    force (N, n): residual generalised force, averaged over the period after each row, without its
    mean over the record, faded at both ends; valid up to the frequency at which twice
    differentiated sensor noise is larger. reading (N, S): non-rigid part of the readings. drive
    (N,): drive force without its regression on accelerations, speed and tilt; None if not measured.
    """

    here: Along
    force: Array
    reading: Array
    drive: Array | None


@dataclass(frozen=True)
class Share:
    """The contribution of one effect to each field of Missing; None if there is none."""

    force: Array | None
    reading: Array | None
    drive: Array | None


def missing(point: WorkingPoint, record: TraceRecord) -> Missing:
    """Return the residual of the model with its effects in a record."""
    here = along(point, record)
    e, driven = corrected_experiment(point, record, here.at, here.added)
    force = _residual_force(driven, e.y)
    gap = record.gap if here.added.gap is None else record.gap - here.added.gap
    drive = drive_errors(here)
    if drive is not None:
        drive = beside_motion(here, drive)
        drive = np.where(calm(drive), drive, 0.0)
    return Missing(here, force, beyond_rigid(record, gap), drive)


def share(point: WorkingPoint, here: Along, placed: Placed) -> Share:
    """Return the contribution of one effect to a record."""
    term = placed.term(here.signals)
    record = here.record
    gap = None if term.gap is None else beyond_rigid(record, term.gap)
    drive = None if term.drive is None else beside_motion(here, term.drive)
    return Share(_force_of(point, here, term), gap, drive)


def beyond_rigid(record: TraceRecord, gap: Array) -> Array:
    """Return the non-rigid part (N, S) of readings: without their best-fitting rigid pose."""
    shape = record.places.sensor_shape
    return np.asarray(gap - (gap @ np.linalg.pinv(shape).T) @ shape.T)


def noise_density(point: WorkingPoint, here: Along, freq_hz: Array) -> Array:
    """Return the one-sided density (F, n) of noise alone in Missing.force."""
    at, noise = here.at, point.disturbance.noise
    seen = powers_of(_impedance(here, freq_hz), noise.output_covariance)
    return np.asarray(2 * at.Ts_s * seen + 2 * noise.force_psd)


def false_density(point: WorkingPoint, here: Along, reading: Array) -> Array:
    """Return the density (F, n) of excess sensor noise in Missing.force, at the bins of `density`.

    The readings' non-rigid part (N, S) gives each sensor's noise above the estimate, averaged over
    a third of an octave; the noise of one sensor is a force on every DOF.
    """
    shape, Ts_s = here.record.places.sensor_shape, here.at.Ts_s
    freq_hz, psd = density(reading, Ts_s)
    left = np.eye(len(shape)) - shape @ np.linalg.pinv(shape)
    # For independent sensor errors, of which the pose absorbs a part.
    own = third_octaves(psd, freq_hz) @ np.linalg.pinv(left**2).T
    excess = np.maximum(own - 2 * Ts_s * point.disturbance.sensor_sd**2, 0.0)
    by_sensor = _impedance(here, freq_hz) @ here.record.places.decoupling
    return np.asarray(np.einsum("fis,fs->fi", np.abs(by_sensor) ** 2, excess))


def standing_out(psd: Array, noise: Array, freq_hz: Array) -> Array:
    """Return the gain (F, .) of a filter that passes what exceeds the noise; psd, noise (F, .).

    The force-equivalent sensor noise grows with the square of the frequency: where its amplitude is
    ten times its minimum, only lines pass.
    """
    ratio = psd / np.maximum(noise, TINY)
    smooth = third_octaves(ratio, freq_hz)
    gain = np.clip(1 - _PASSED / np.maximum(smooth, TINY), 0.0, 1.0)
    gain[noise > WORST * noise.min(axis=0)] = 0.0
    gain[ratio > _LINE] = 1.0
    gain[freq_hz <= 0.0] = 0.0
    return np.asarray(gain)


def third_octaves(values: Array, freq_hz: Array) -> Array:
    """Return means (F, .) over a third of an octave, which scatter less than single lines."""
    edges = np.searchsorted(freq_hz, np.outer(freq_hz, [_THIRD**-0.5, _THIRD**0.5]))
    sums = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    low, high = edges[:, 0], np.maximum(edges[:, 1], edges[:, 0] + 1)
    return np.asarray((sums[high] - sums[low]) / (high - low)[:, None])


def denoised(values: Array, gain: Array, freq_hz: Array, Ts_s: float) -> Array:
    """Filter samples (N,) without phase shift, by a gain (F,) at freq_hz (F,).

    The ends are reflected, so that the filter does not ring there.
    """
    edge = min(len(values) - 1, round(SearchOptions.block_s / Ts_s))
    long = np.concatenate([values[edge:0:-1], values, values[-2 : -edge - 2 : -1]])
    spectrum = np.fft.rfft(long)
    spectrum *= np.interp(np.fft.rfftfreq(len(long), Ts_s), freq_hz, gain)
    return np.fft.irfft(spectrum, len(long))[edge : edge + len(values)]


def density(values: Array, Ts_s: float) -> tuple[Array, Array]:
    """Return frequencies (F,) in Hz and the one-sided density (F, .) of samples (N, .)."""
    segment = min(round(SearchOptions.block_s / Ts_s), len(values))
    freq_hz, psd = welch(values, 1 / Ts_s, nperseg=segment, axis=0)
    return freq_hz, psd


def _residual_force(driven: Motion, y: Array) -> Array:
    """Return M q'' + D q' + K q - B u (N, n), averaged over each period, without its mean."""
    Ts_s = driven.Ts_s
    qd = rate(y, Ts_s, _EDGE_ROWS)
    acceleration, velocity = (np.diff(x, axis=0) / Ts_s for x in (qd, y))
    place = 0.5 * (y[1:] + y[:-1]) - (ROUNDED_SD * Ts_s) ** 2 * acceleration
    rows = len(velocity)
    residual = acceleration + _times(driven.D, velocity) + _times(driven.K, place)
    residual -= _times(driven.B, driven.inputs[:rows, 0]) / Ts_s
    residual -= (
        driven.drift[:rows, 0] / Ts_s if len(driven.drift) > 1 else driven.drift[0, 0] / Ts_s
    )
    force = _times(_inverse(driven.mobility), residual)
    # In blind rows, unknown inputs from before the record act.
    known = slice(max(driven.blind, _EDGE_ROWS), rows - _EDGE_ROWS)
    around_mean = np.zeros_like(y)
    around_mean[known] = force[known] - force[known].mean(axis=0)
    # Without a fade, twice differentiated noise would give a pulse at either end.
    ramp = min(max(round(FADE_S / Ts_s), 1), rows // SearchOptions.resolved)
    fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(ramp) + 0.5) / ramp)
    around_mean[known.start : known.start + ramp] *= fade[:, None]
    around_mean[known.stop - ramp : known.stop] *= fade[::-1, None]
    return around_mean


def _force_of(point: WorkingPoint, here: Along, term: Term) -> Array | None:
    """Return the generalised force (N, n) of a term, averaged over the period after each row."""
    if term.force is None and term.held is None:
        return None
    force = np.zeros_like(here.signals.q)
    if term.force is not None:
        force += force_moments(term.force, here.at.Ts_s, 1, point.hold)[:, 0] / here.at.Ts_s
    if term.held is not None:
        e = replace(here.record.experiment, u=term.held)
        acting = input_moments(point.model, e, point.hold, 1)[:, 0] / e.Ts_s
        force += _times(_inverse(here.at.mobility) @ here.at.B, acting)
    return force


def _inverse(matrices: Array) -> Array:
    return np.asarray(np.linalg.inv(matrices), np.float64)


def _times(matrices: Array, values: Array) -> Array:
    """Multiply each row's vector by its matrix, or by the one for all rows."""
    if len(matrices) == 1:
        return np.asarray(values @ matrices[0].T)
    return np.asarray(np.einsum("nij,nj->ni", matrices[: len(values)], values))


def _impedance(here: Along, freq_hz: Array) -> NDArray[np.complex128]:
    """Return the dynamic stiffness (F, n, n) of the linear model: force over pose."""
    at = here.at
    M = np.linalg.inv(at.mobility.mean(axis=0))
    s = 2j * np.pi * freq_hz[:, None, None]
    return np.asarray(M @ (s * s * np.eye(len(M)) + s * at.D.mean(axis=0) + at.K.mean(axis=0)))
