"""Split a residual spectrum into noise and model error, by local polynomials of the excitation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import gamma

from .spectral_lines import PointLines, RecordLines

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

HALF_WIDTH = 12
"""Lines on either side of a band's centre: 25 lines leave 23 degrees of freedom a record."""
_WEIGHS, _CLEAR_ERROR = 1e-3, 1e-6
"""Probability by chance below which a model error weighs, and below which it is said: some thousand
bands are looked at, and a weight by chance costs little."""
NOT_WHITE = 6.0
"""Standard deviations by chance of a band's excess from which the residual is not white. Some
thousand bands are looked at; 6 of a chi-square variable is one in 10^5 by chance."""
_CLEAR = 20.0
"""Power of the output over the noise from which it counts for the misfit."""


@dataclass(frozen=True)
class ResidualSpectrum:
    """The residual of one point in bands of 2 HALF_WIDTH + 1 lines, centred at freq_hz (B,).

    `noise` (F, n, n): covariance of what does not depend on the excitation, at every line; `levels`
    (R,): that of each record over it, as a factor.
    `excess` (B,): whitened power that depends on the excitation, over the records, less what
    chance leaves; its standard deviation by chance is `excess_sd`. `clear_error` (F, n): power
    of the model error over that of the output where it is beyond doubt, else 0; `relative_error`
    (F, n): the same where it is significant, as it weighs: an error is the same at all lines of a
    band, so it does not average out over them as noise does, and counts as often. `misfit` sums up
    over all bands: (model error power, bands) relative to the output.
    """

    freq_hz: Array
    noise: Complex
    levels: Array
    excess: Array
    excess_sd: float
    relative_error: Array
    clear_error: Array
    misfit: tuple[float, int]


def split_residual(
    point: PointLines, residuals: Sequence[Complex], shape: Complex | None = None
) -> ResidualSpectrum:
    """Split the residuals (F, n) of a point's records, without their transients.

    In each narrow band the residual of a record is E = dG V + noise, where the error dG of the
    loop's response is a line over the band: what regression on V takes depends on the excitation,
    the rest is noise, to which all records of the point contribute. A still record has noise only.

    `shape` (F, n, n): a first estimate of the noise's covariance, None for white. The measured
    noise over it is smooth, even at resonances of the loop that are narrower than a band.
    """
    F, n = residuals[0].shape
    shape = np.broadcast_to(np.eye(n), (F, n, n)) if shape is None else shape
    factor = np.linalg.cholesky(shape)
    whiten = np.linalg.inv(factor)
    bands = _bands(F)
    B, width = bands.shape
    offset = (np.arange(width) - 0.5 * (width - 1)) / max(0.5 * (width - 1), 1.0)
    parts = []
    for record, E in zip(point.records, residuals, strict=True):
        # Whitened first: within a band at a resonance the noise changes by decades.
        whitened = np.einsum("fij,fj->fi", whiten, E)[bands]
        Q = _regressors(record, bands, offset)
        fit = Q @ (Q.conj().transpose(0, 2, 1) @ whitened)
        parts.append((record, Q, fit, whitened - fit))
    levels = _levels([left for *_, left in parts], [width - Q.shape[2] for _, Q, *_ in parts])
    cross, freedom = np.zeros((B, n, n), complex), 0
    explained: list[Complex] = []
    error, output, unknowns = np.zeros((B, n)), np.zeros((B, n)), 0
    chance = np.zeros((B, width))
    for (record, Q, fit, left), level in zip(parts, levels.tolist(), strict=True):
        cross += left.transpose(0, 2, 1) @ left.conj() / level
        freedom += width - Q.shape[2]
        if Q.shape[2]:
            explained.append(np.asarray(fit / np.sqrt(level)))
            raw = np.einsum("blij,blj->bli", factor[bands], fit)
            error += np.sum(np.abs(raw) ** 2, axis=1)
            output += np.sum(np.abs(record.Y[bands]) ** 2, axis=1)
            unknowns += Q.shape[2]
            chance += np.sum(np.abs(Q) ** 2, axis=2) * level
    smooth = _smoothed(np.asarray(cross / freedom))
    inverse = np.linalg.inv(smooth)
    power = sum(
        (np.einsum("bli,bij,blj->b", fit.conj(), inverse, fit).real for fit in explained),
        start=np.zeros(B),
    )
    centres = 0.5 * (bands[:, 0] + bands[:, -1])
    lines = np.arange(F)
    entries = [
        np.interp(lines, centres, e.real) + 1j * np.interp(lines, centres, e.imag)
        for e in smooth.reshape(B, -1).T
    ]
    ratio = np.array(entries).T.reshape(F, n, n)
    noise = factor @ ratio @ factor.conj().transpose(0, 2, 1)
    at_lines = np.einsum("blii->bli", noise[bands]).real
    level = at_lines.mean(axis=1)
    by_chance = np.einsum("bl,bli->bi", chance, at_lines)
    # The power of k complex Gaussian numbers has a gamma distribution.
    limits = np.asarray(gamma.isf((_WEIGHS, _CLEAR_ERROR), max(unknowns, 1))) / max(unknowns, 1)
    total, error = error, error - by_chance
    moved = output > 0.0
    weighs, said = (
        np.divide(error, output, out=np.zeros_like(error), where=moved & (total > k * by_chance))
        for k in limits
    )
    clear = output > _CLEAR * freedom * level
    relative = np.divide(error, output, out=np.zeros_like(error), where=clear)
    return ResidualSpectrum(
        np.interp(centres, lines, point.freq_hz),
        np.asarray(noise),
        levels,
        power - n * unknowns,
        float(np.sqrt(max(n * unknowns, 1))),
        np.array([np.interp(lines, centres, x) for x in width * _widened(weighs).T]).T,
        np.array([np.interp(lines, centres, x) for x in said.T]).T,
        (float(relative[clear].sum()), int(clear.sum())),
    )


def with_model_error(
    point: PointLines, found: ResidualSpectrum, share: Array
) -> tuple[Complex, ...]:
    """Return the covariance (F, n, n) of each record: noise, and `share` (F, n) of its output."""
    eye = np.eye(found.noise.shape[1])
    return tuple(
        np.asarray(level * found.noise + (share * record.power)[:, :, None] * eye)
        for record, level in zip(point.records, found.levels, strict=True)
    )


def excess_of_bands(residuals: Sequence[ResidualSpectrum]) -> tuple[Array, Array]:
    """Return the excess (B,) of bands in standard deviations of chance, and frequencies (B,).

    Points together, those of the longest records.
    """
    longest = max(len(r.freq_hz) for r in residuals)
    same = [r for r in residuals if len(r.freq_hz) == longest]
    excess = np.sum([r.excess for r in same], axis=0)
    return excess / np.sqrt(np.sum([r.excess_sd**2 for r in same])), same[0].freq_hz


def _bands(F: int) -> NDArray[np.int_]:
    """Return the lines (B, W) of bands that overlap by half."""
    width = min(2 * HALF_WIDTH + 1, F)
    starts = np.append(np.arange(0, F - width, HALF_WIDTH), F - width)
    return np.asarray(starts[:, None] + np.arange(width))


def _levels(left: Sequence[Complex], freedom: Sequence[int]) -> Array:
    """Return the noise power (R,) of records over their mean, with the same spectrum."""
    power = np.array(
        [np.sum(np.abs(x) ** 2, axis=(1, 2)) / k for x, k in zip(left, freedom, strict=True)]
    )
    mean = np.average(power, axis=0, weights=freedom)
    found = np.mean(power / np.maximum(mean, 1e-300), axis=1)
    return np.asarray(found / np.average(found, weights=freedom))


def _regressors(record: RecordLines, bands: NDArray[np.int_], offset: Array) -> Complex:
    """Return orthonormal columns (B, W, K): the excitation, and it times a line over the band."""
    V = record.V[:, list(record.excited)][bands]
    if not V.shape[2]:
        return np.zeros((*bands.shape, 0), complex)
    X = np.concatenate([V, offset[:, None] * V], axis=2)
    size = np.linalg.norm(X, axis=1, keepdims=True)
    return np.asarray(np.linalg.qr(X / np.maximum(size, 1e-300))[0])


def _smoothed(x: Complex) -> Complex:
    """Return the mean (B, n, n) of each band and its neighbours."""
    padded = np.concatenate([x[:1], x, x[-1:]])
    return np.asarray((padded[:-2] + padded[1:-1] + padded[2:]) / 3.0)


def _widened(x: Array) -> Array:
    """Return the largest value (B, n) of each band and its neighbours."""
    padded = np.concatenate([x[:1], x, x[-1:]])
    return np.asarray(np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:]))
