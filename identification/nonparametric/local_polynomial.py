"""Estimate frequency responses by the local polynomial method, which removes leakage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..records.record import IdentificationError, Record
from ..records.varying_signals import varying
from .frequency_response import ResponseEstimate
from .joint_input_output import joint_signals, plant_from_joint_response

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

TERMS = 3
"""Polynomial terms, order 2: at the centre of a band, order 3 would add no accuracy."""
FREEDOM = 24
"""Complex degrees of freedom of the noise estimate; it widens the intervals by 3 %."""


def local_polynomial(
    inputs: Sequence[Array],
    outputs: Sequence[Array],
    Ts_s: float,
    freq_hz: Array,
    freedom: int = FREEDOM,
) -> ResponseEstimate:
    """Estimate H from inputs (N, p) to outputs (N, m) of several records, exactly at freq_hz (F,).

    The spectrum of a finite record is Y = H V + T + noise. T, as smooth as H, is the transient of
    the record's begin and end, which causes leakage in other methods. In a band around every
    frequency, the columns of H, common to all records, and the T of each record are polynomials of
    order 2, fitted by least squares (Pintelon and Schoukens 2012, 7.2). The band is the narrowest
    with `freedom` degrees of freedom for the noise, which gives the covariance.

    Raises IdentificationError for records too short for such a band, frequencies that they do not
    resolve, or linearly dependent inputs.
    """
    freq_hz = np.asarray(freq_hz, dtype=np.float64)
    F, p = len(freq_hz), inputs[0].shape[1]
    lengths = [len(v) for v in inputs]
    halves = _half_widths(lengths, p, freedom)
    _check_range(freq_hz, lengths, halves, Ts_s)
    regressors, targets = [], []
    for v, y, half in zip(inputs, outputs, halves, strict=True):
        band = _Band.around(freq_hz, len(v), Ts_s, half)
        powers = band.offset[:, :, None] ** np.arange(TERMS)
        local = powers[:, :, :, None] * band.spectrum(v)[:, :, None, :]
        regressors.append(band.without_transient(local.reshape(F, -1, TERMS * p)))
        targets.append(band.without_transient(band.spectrum(y)))
    X, Y = np.concatenate(regressors, axis=1), np.concatenate(targets, axis=1)
    theta, inverse = _least_squares(X, Y, freq_hz)
    H = theta[:, :p].transpose(0, 2, 1)
    residual = Y - X @ theta
    noise = np.einsum("fwi,fwk->fik", residual, residual.conj()) / _freedom(halves, p)
    spread = inverse[:, :p] @ inverse[:, :p].conj().transpose(0, 2, 1)
    return ResponseEstimate(
        freq_hz,
        H,
        _coherence(inputs, targets, residual),
        np.einsum("fik,fjl->fijkl", noise, spread),
        Ts_s,
    )


def plant_by_local_polynomial(
    records: Sequence[Record], freq_hz: Array, freedom: int = FREEDOM
) -> ResponseEstimate:
    """Return P from records of one operating point, in a loop or (without u) from v to y.

    In a loop it is the joint input-output estimate P = (Y / V) (U / V)^-1 with both responses by
    the local polynomial method: feedback does not bias it, and the controller may be unknown.
    Raises IdentificationError as local_polynomial does.
    """
    loop = local_polynomial(
        [r.v for r in records],
        [joint_signals(r) for r in records],
        records[0].Ts_s,
        freq_hz,
        freedom,
    )
    return plant_from_joint_response(loop, records[0].y.shape[1])


@dataclass(frozen=True)
class _Band:
    """The bins of a record around F frequencies: numbers (F, W), offset from the centre (F, W).

    `smooth` (F, W, TERMS): orthonormal polynomials over the band.
    """

    bins: NDArray[np.int_]
    offset: Array
    smooth: Array

    @classmethod
    def around(cls, freq_hz: Array, length: int, Ts_s: float, half: int) -> _Band:
        """Return the 2 half + 1 bins nearest to each frequency, without 0 Hz and half the rate."""
        centre = freq_hz * length * Ts_s
        middle = np.clip(np.rint(centre).astype(int), 1 + half, (length - 1) // 2 - half)
        bins = middle[:, None] + np.arange(-half, half + 1)
        offset = (bins - centre[:, None]) / half
        smooth = np.linalg.qr(offset[:, :, None] ** np.arange(TERMS))[0]
        return cls(bins, offset, np.asarray(smooth))

    def spectrum(self, x: Array) -> Complex:
        """Return the spectrum (F, W, n) of x (N, n) in the band."""
        out = np.zeros((*self.bins.shape, x.shape[1]), complex)
        for j in np.flatnonzero(varying(x)):
            out[:, :, j] = fft.rfft(x[:, j])[self.bins] / np.sqrt(len(x))
        return out

    def without_transient(self, x: Complex) -> Complex:
        """Return x (F, W, n) without its polynomial part."""
        return np.asarray(x - self.smooth @ (self.smooth.transpose(0, 2, 1) @ x))


def _least_squares(X: Complex, Y: Complex, freq_hz: Array) -> tuple[Complex, Complex]:
    """Return theta with X theta = Y, and L with L L^H = (X^H X)^-1."""
    scale = np.linalg.norm(X, axis=1)
    if np.any(scale == 0):
        raise IdentificationError("expected every input to be excited, found one that is not")
    Q, R = np.linalg.qr(X / scale[:, None, :])
    condition = np.linalg.cond(R)
    if condition.max() > 1e8:
        raise IdentificationError(
            f"expected independent inputs around {freq_hz[condition.argmax()]:.4g} Hz, "
            "found two that are proportional, or one without excitation"
        )
    inverse = np.linalg.inv(R) / scale[:, :, None]
    theta = inverse @ (Q.conj().transpose(0, 2, 1) @ Y)
    return np.asarray(theta), np.asarray(inverse)


def _coherence(inputs: Sequence[Array], targets: Sequence[Complex], residual: Complex) -> Array:
    """Return the explained share (F, m, p) of each output, in the records that excite input j."""
    shape = (len(residual), residual.shape[2], inputs[0].shape[1])
    unexplained, power, begin = np.zeros(shape), np.zeros(shape), 0
    for v, y in zip(inputs, targets, strict=True):
        excited = varying(v)
        error = residual[:, begin : begin + y.shape[1]]
        unexplained[:, :, excited] += np.sum(np.abs(error) ** 2, axis=1)[:, :, None]
        power[:, :, excited] += np.sum(np.abs(y) ** 2, axis=1)[:, :, None]
        begin += y.shape[1]
    share = np.divide(unexplained, power, out=np.ones_like(power), where=power > 0)
    return np.asarray(np.clip(1.0 - share, 0.0, 1.0))


def _half_widths(lengths: Sequence[int], p: int, freedom: int) -> list[int]:
    """Return n for the 2 n + 1 bins of each record: the narrowest band in Hz, the same for all."""
    shortest = min(lengths)
    half = TERMS  # fewer bins than terms on a side fit any transient
    while True:
        halves = [-(-half * length // shortest) for length in lengths]
        if _freedom(halves, p) >= freedom:
            return halves
        half += 1


def _freedom(halves: Sequence[int], p: int) -> int:
    """Return bins minus unknowns: one transient for each record and p columns of H, TERMS each."""
    return sum(2 * half + 1 - TERMS for half in halves) - TERMS * p


def _check_range(
    freq_hz: Array, lengths: Sequence[int], halves: Sequence[int], Ts_s: float
) -> None:
    for length, half in zip(lengths, halves, strict=True):
        if 2 * half + 1 > (length - 1) // 2:
            raise IdentificationError(
                f"expected records of at least {2 * (2 * half + 1) + 1} samples, found a record "
                f"of {length}"
            )
        low, high = 1 / (length * Ts_s), ((length - 1) // 2) / (length * Ts_s)
        if freq_hz.min() < low or freq_hz.max() > high:
            raise IdentificationError(
                f"expected frequencies from {low:.4g} to {high:.4g} Hz for a record of "
                f"{length * Ts_s:g} s, found {freq_hz.min():.4g} to {freq_hz.max():.4g} Hz"
            )
