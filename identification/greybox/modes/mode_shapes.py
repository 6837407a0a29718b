"""Estimate the shapes of modes over all sensors, and whether the coils reach them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ...loop_spectra.output_errors import residual
from ...loop_spectra.spectral_lines import PointLines
from ...records.record import IdentificationError
from ..experiment.experiment_from_log import Experiment
from ..experiment.sensor_readings import SensorReadings
from .identify_in_loop import LoopFit
from .lines_by_point import lines_by_point
from .mode import Mode
from .natural_modes import natural_poles
from .sampled_response import held

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_HALF_WIDTHS, _LEAST_LINES, _MOST_SHARE = 8.0, 60, 0.1
"""Band around a mode: this many half widths of its peak, at least so many lines on either side, and
at most this share of its frequency."""
_SAME_PLACE_M = 1e-3
"""Distance within which a coil and a sensor are at one place."""


@dataclass(frozen=True)
class ModeShape:
    """The shape of a mode over the sensors: motion at each of them over the largest.

    `shape`, `se` (S,): with standard errors; places (S, 2) in m. `single`: share of what the mode
    does to the readings that has one shape; the rest is chance or another mode. `rigid`: share of
    the squared shape that a rigid body could have; the outputs see that part only, and every wrench
    drives it. `reach` (C,): drive of the mode by a unit of force of each coil at coils_m (C, 2),
    over the largest, None where coils are not at the sensors' places; `agreement`: share of the
    drive by the wrench, as measured, that follows from it, which Maxwell's reciprocity demands.
    """

    shape: Array
    se: Array
    sensors_m: Array
    coils_m: Array
    single: float
    rigid: float
    reach: Array | None
    agreement: float

    @property
    def beyond_wrench(self) -> float:
        """Share of the squared drive that coils have without any wrench on the rigid platform."""
        return 1.0 - self.rigid


def mode_shapes(fit: LoopFit, experiments: Sequence[Experiment]) -> tuple[ModeShape | None, ...]:
    """Return the shape of each of the fit's modes; None where the records do not show it.

    The poles of all modes count as known. Around each, the spectra of all readings are a sum of its
    response, with real residues (S, p) in common, of the other modes', of the rigid body's, which
    is smooth there, and of what the record's begin and end leave. Residues of one mode have rank
    one: shape times drive. The input is that of the excitation through the fitted loop, so noise
    that is fed back does not bias them.
    """
    found = [e for e in experiments if e.loop is not None and e.readings is not None]
    return tuple(_shape(fit, mode, found) for mode in fit.modes)


@dataclass(frozen=True)
class _Residues:
    """Residues (S, p) at one point; `variance` (S,) and `information` (p, p): covariances of rows
    are variance times the inverse of the information."""

    values: Array
    variance: Array
    information: Array


def _shape(fit: LoopFit, mode: Mode, experiments: Sequence[Experiment]) -> ModeShape | None:
    if not experiments:
        return None
    half_hz = _HALF_WIDTHS * mode.damping * mode.freq_hz
    longest_s = max(len(e.y) * e.Ts_s for e in experiments)
    half_hz = min(max(half_hz, _LEAST_LINES / longest_s), _MOST_SHARE * mode.freq_hz)
    by_point: list[_Residues] = []
    for point in fit.points:
        names = {r.name for r in point.records}
        poles = _poles(fit, mode, point.schedule)
        middle_hz = abs(poles[0]) / (2.0 * np.pi)
        try:
            points = lines_by_point(
                [e for e in experiments if e.name in names],
                (middle_hz - half_hz, middle_hz + half_hz),
            )
        except (IdentificationError, ValueError):
            continue  # too few lines, or no record of this point has readings
        by_point += [r for p in points if (r := _residues(fit, poles, p, experiments)) is not None]
    if not by_point:
        return None
    if mode.kind == "attached":  # its shape depends on where the body is
        by_point = [max(by_point, key=lambda r: float(np.trace(r.information / r.variance.mean())))]
    return _of_residues(by_point, next(e.readings for e in experiments if e.readings is not None))


def _poles(fit: LoopFit, mode: Mode, schedule: Mapping[str, float]) -> list[complex]:
    """Return the poles of all modes in the structure, that of `mode` first.

    A body's is not that on a base at rest.
    """
    alike = sorted((m for m in fit.modes if m.kind == mode.kind), key=lambda m: m.omega)
    natural = [(s, o) for s, o in natural_poles(fit.plant, schedule) if o != "declared"]
    own = [s for s, origin in natural if origin == mode.kind]
    k = next(i for i, m in enumerate(alike) if m is mode)
    first = own[k] if len(own) == len(alike) else 1j * mode.omega
    return [first, *(s for s, _ in natural if s != first)]


def _residues(
    fit: LoopFit, poles: Sequence[complex], point: PointLines, experiments: Sequence[Experiment]
) -> _Residues | None:
    """Return the residues of the first pole at one point, from its records with an excitation."""
    by_name = {e.name: e for e in experiments}
    lines = point.excited
    if not len(lines):
        return None
    only = point.only(lines)
    _, S, P = residual(fit.plant, only)
    C_S_P = only.controller @ S @ P
    s, acts = held(fit.plant.model.at(point.schedule), only.freq_hz, point.Ts_s, point.delay_s)
    resonance, *others = (abs(x) ** 2 / ((s - x) * (s - np.conj(x))) for x in poles)
    apart = np.linspace(-1.0, 1.0, len(lines))
    rest = np.stack([*(apart**k for k in range(3)), *others], axis=1)
    left = np.concatenate([rest, resonance[:, None], (apart * resonance)[:, None]], axis=1)
    shared, background, own, right = [], [], [], []
    for record in only.records:
        if not record.excited:
            continue
        experiment = by_name[record.name]
        assert experiment.readings is not None
        U = acts[:, None] * (record.V - np.einsum("fij,fj->fi", C_S_P, record.V))
        shared.append(U * resonance[:, None])
        background.append((U[:, :, None] * rest[:, None, :]).reshape(len(lines), -1))
        own.append(left)
        right.append(_spectra(experiment.readings.readings, only.freq_hz, point.Ts_s))
    if not shared:
        return None
    p = shared[0].shape[1]
    beside = np.concatenate([np.concatenate(background), _diagonal(own)], axis=1)
    A = np.concatenate([_real(np.concatenate(shared)), _real(beside), _real(1j * beside)], axis=1)
    b = _real(np.concatenate(right))
    size = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    # The unknowns that are asked for last: their triangle is that of the normal equations left.
    order = [*range(p, A.shape[1]), *range(p)]
    R = np.asarray(np.linalg.qr(np.concatenate([(A / size)[:, order], b], axis=1), mode="r"))
    k, freedom = A.shape[1] - p, len(b) - A.shape[1]
    if freedom < p:
        return None
    triangle, right_side = R[k : k + p, k : k + p], R[k : k + p, k + p :]
    if np.linalg.cond(triangle) > 1.0 / np.finfo(float).eps:
        return None
    values = np.linalg.solve(triangle, right_side) / size[:p, None]
    information = (triangle * size[:p]).T @ (triangle * size[:p])
    return _Residues(values.T, np.sum(R[k + p :, k + p :] ** 2, axis=0) / freedom, information)


def _of_residues(found: Sequence[_Residues], sensors: SensorReadings) -> ModeShape | None:
    """Return the shape that the residues of all points have in common, weighted by variance."""
    variance = np.maximum(np.mean([r.variance for r in found], axis=0), 1e-300)
    weights = [r.information * float(np.mean(variance / r.variance)) for r in found]
    information = np.sum(weights, axis=0)
    together = np.sum([w @ r.values.T for w, r in zip(weights, found, strict=True)], axis=0)
    values = np.linalg.solve(information, together).T
    # Rank one, in units of chance on both sides.
    root = np.linalg.cholesky(information)
    _, sizes, directions = np.linalg.svd(values @ root / np.sqrt(variance)[:, None])
    drive = np.linalg.solve(root.T, directions[0])
    by_drive = information @ drive
    power = float(drive @ by_drive)
    shape, se = values @ by_drive / power, np.sqrt(variance / power)
    chance = float(np.sum(sizes**2)) - len(variance) * len(drive)
    if chance <= 0.0:
        return None
    largest = int(np.argmax(np.abs(shape)))
    shape, se, drive = shape / shape[largest], se / abs(shape[largest]), drive * shape[largest]
    rigid = sensors.rigid @ np.linalg.lstsq(sensors.rigid, shape, rcond=None)[0]
    reach, agreement = _reach(shape, drive, information, sensors)
    return ModeShape(
        shape,
        se,
        sensors.sensors_m,
        sensors.coils_m,
        float(np.clip((sizes[0] ** 2 - len(variance) - len(drive) + 1) / chance, 0.0, 1.0)),
        float(np.sum(rigid**2) / np.sum(shape**2)),
        reach,
        agreement,
    )


def _reach(
    shape: Array, drive: Array, information: Array, sensors: SensorReadings
) -> tuple[Array | None, float]:
    """Return the drive by each coil (C,), and the share of the measured drive that it explains."""
    apart = np.linalg.norm(sensors.coils_m[:, None] - sensors.sensors_m, axis=2)
    nearest = np.argmin(apart, axis=1)
    if np.any(apart[np.arange(len(nearest)), nearest] > _SAME_PLACE_M):
        return None, float("nan")
    reach = shape[nearest]
    # A wrench is shared out to the coils by least squares.
    expected = np.linalg.pinv(sensors.forces) @ reach
    across = float(expected @ information @ drive)
    both = float(expected @ information @ expected) * float(drive @ information @ drive)
    return reach / np.abs(reach).max(), across**2 / both if both > 0.0 else float("nan")


def _spectra(readings: NDArray[np.float32], freq_hz: Array, Ts_s: float) -> Complex:
    """Return the spectra (F, S) of readings (N, S) at lines of their length."""
    N = len(readings)
    lines = np.round(freq_hz * N * Ts_s).astype(int)
    columns = (readings[:, k].astype(float) for k in range(readings.shape[1]))
    found = [fft.rfft(x - x.mean())[lines] for x in columns]
    return np.asarray(np.stack(found, axis=1) / np.sqrt(N))


def _diagonal(blocks: Sequence[Complex]) -> Complex:
    """Return the blocks below each other, each in columns of its own."""
    rows, width = sum(len(b) for b in blocks), blocks[0].shape[1]
    out = np.zeros((rows, width * len(blocks)), complex)
    row = 0
    for k, b in enumerate(blocks):
        out[row : row + len(b), k * width : (k + 1) * width] = b
        row += len(b)
    return out


def _real(x: Complex) -> Array:
    """Return real and imaginary parts below each other."""
    return np.concatenate([x.real, x.imag])
