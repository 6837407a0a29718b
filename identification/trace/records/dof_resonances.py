"""Estimate frequency and damping of masses on springs on the DOFs, from forces and motion.

A rigid platform's force is a smooth function of frequency times its motion: mass, damping and
stiffness, and a delay. A mass on a spring adds a resonance to that. In each record the smooth part
is fitted to the commands, for all DOFs together, and what it leaves is searched for the resonance
that explains most. It is the initial guess of the fit: a grid would miss a narrow one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..search_options import SearchOptions
from .record_from_log import TraceRecord
from .resonances import Spectra, clearest

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_LOWEST_HZ, _HIGHEST = 2.0, 0.5 / SearchOptions.resolved
"""The highest one over the sampling rate: what a held force does is a smooth function below."""
_POWERS = (-2, -1, 0, 1, 2)
"""Powers of i omega of the force over the acceleration: stiffness, damping, mass; and a delay."""


@dataclass(frozen=True)
class DofResonance:
    """Number of a DOF, and frequency in Hz and damping ratio of a mass on a spring on it."""

    dof: int
    frequency_hz: float
    damping: float


def dof_resonances(records: Sequence[TraceRecord]) -> tuple[DofResonance, ...]:
    """Return at most one resonance for each DOF, rounded to three digits.

    Only records of the most frequent sampling rate at one operating point are used.
    """
    usable = [r for r in records if not r.experiment.moving and not r.still]
    if not usable:
        return ()
    rates = [r.experiment.Ts_s for r in usable]
    Ts_s = max(set(rates), key=lambda rate: (rates.count(rate), rate))
    parts = [p for r in usable if r.experiment.Ts_s == Ts_s if (p := _parts(r)) is not None]
    found = []
    for dof in range(records[0].experiment.y.shape[1]):
        spectra = _beside_smooth(parts, dof)
        best = None if spectra is None else clearest(spectra)
        if best is not None:
            found.append(DofResonance(dof, *(float(f"{value:.3g}") for value in best)))
    return tuple(found)


@dataclass(frozen=True)
class _Parts:
    """Spectra (K, F, n) of commanded force and of acceleration, of K segments of a record."""

    freq_hz: Array
    force: ComplexArray
    acceleration: ComplexArray


def _parts(record: TraceRecord) -> _Parts | None:
    e = record.experiment
    length = round(SearchOptions.block_s / e.Ts_s)
    late = e.delay_cycles
    if record.rows < length + late:
        return None
    window = np.hanning(length)[:, None]
    freq_hz = np.fft.rfftfreq(length, e.Ts_s)
    use = (freq_hz >= _LOWEST_HZ) & (freq_hz <= _HIGHEST / e.Ts_s)
    omega = 2.0 * np.pi * freq_hz[use][:, None]
    pushed = np.roll(record.coil @ record.places.coil_shape, late, axis=0)
    force, acceleration = [], []
    for start in range(late, record.rows - length + 1, length // 2):
        part = slice(start, start + length)
        F, Q = (
            np.fft.rfft(window * (v[part] - v[part].mean(axis=0)), axis=0)[use]
            for v in (pushed, e.y)
        )
        force.append(F)
        acceleration.append(-(omega**2) * Q)
    return _Parts(np.asarray(freq_hz[use]), np.array(force), np.array(acceleration))


def _beside_smooth(parts: Sequence[_Parts], dof: int) -> Spectra | None:
    """Return the spectra of acceleration and of the force that no smooth function of it gives."""
    if not parts:
        return None
    freq_hz = parts[0].freq_hz
    middle = 2j * np.pi * freq_hz / (2.0 * np.pi * np.exp(np.log(freq_hz).mean()))
    smooth = np.stack([middle**power for power in _POWERS], axis=1)
    yu: ComplexArray = np.zeros(len(freq_hz), complex)
    uu, yy, count = np.zeros(len(freq_hz)), np.zeros(len(freq_hz)), 0
    for p in parts:
        if p.force.shape[2] <= dof:
            return None
        K, F, n = p.acceleration.shape
        columns = p.acceleration[:, :, :, None] * smooth[None, :, None, :]
        X = columns.reshape(K * F, n * len(_POWERS))
        y = p.force[:, :, dof].reshape(-1)
        size = np.linalg.norm(X, axis=0)
        X = X / np.where(size > 0.0, size, 1.0)
        both = np.concatenate([X.real, X.imag]), np.concatenate([y.real, y.imag])
        found, *_ = np.linalg.lstsq(*both, rcond=None)
        left = (y - X @ found).reshape(K, F)
        u = p.acceleration[:, :, dof]
        yu += np.sum(left * u.conj(), axis=0)
        uu += np.sum(np.abs(u) ** 2, axis=0)
        yy += np.sum(np.abs(left) ** 2, axis=0)
        count += K
    return Spectra(freq_hz, np.asarray(yu / count, complex), uu / count, yy / count, count)
