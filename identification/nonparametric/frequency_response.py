"""Estimate frequency responses by Welch's method, and the plant from the sensitivity (15)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from ..records.record import IdentificationError, PiController, Record
from ..records.varying_signals import varying

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

OVERLAP = 1.0 / 6.0
"""Correlation of the noise in two Hann segments that overlap by half (Welch 1967)."""
LEAST_FREEDOM = 0.5
"""Least degrees of freedom of a record; with fewer, its confidence circle exceeds any figure."""


@dataclass(frozen=True)
class ResponseEstimate:
    """Frequency response H (F, m, p) at freq_hz (F,), with its uncertainty.

    `coherence` (F, m, p): multiple coherence, the share of output i that the inputs explain, in the
    records that excite input j. `covariance` (F, m, p, m, p): error covariance,
    E dH[i,j] dH[k,l]^*, enlarged for few segments or periods so that the 95 % circle is always
    sqrt(-ln 0.05) standard deviations, as with known variances. (The covariance of the local
    polynomial method is not enlarged: its degrees of freedom are fixed.)
    """

    freq_hz: Array
    H: Complex
    coherence: Array
    covariance: Complex
    Ts_s: float

    @property
    def standard_deviation(self) -> Array:
        """Standard deviation (F, m, p) of the complex entries; the 95 % circle is 1.73 times it."""
        return np.asarray(np.sqrt(np.abs(np.einsum("fijij->fij", self.covariance))))


def circle(confidence: float, freedom: Array | float) -> Array:
    """Return the radius of a complex error's confidence circle, in estimated standard deviations.

    The squared error over its variance, estimated with `freedom` degrees of freedom, follows an F
    distribution with 2 and 2 `freedom` (Pintelon and Schoukens 2012, chapter 2); its quantile has a
    closed form.
    """
    return np.asarray(np.sqrt(freedom * ((1.0 - confidence) ** (-1.0 / freedom) - 1.0)))


def frequency_response(
    inputs: Sequence[Array],
    outputs: Sequence[Array],
    Ts_s: float,
    freq_hz: Array,
    segment_s: float,
) -> ResponseEstimate:
    """Estimate H from inputs (N, p) to outputs (N, m) of several records, all inputs at once.

    H = (sum Y V^H) (sum V V^H)^-1 over Hann segments of `segment_s` that overlap by half, at the
    bins (multiples of 1 / segment_s) nearest to freq_hz (F,). The covariance follows from the
    residual Y - H V of each record: noise, and the leakage of transients. It includes the noise
    correlation of neighbouring segments, which matters most for periodic inputs.

    Raises IdentificationError for records shorter than two segments, too few segments for the
    inputs, or linearly dependent inputs.
    """
    length = round(segment_s / Ts_s)
    for v in inputs:
        if len(v) < 2 * length:
            raise IdentificationError(
                f"expected records of at least two segments of {segment_s:g} s, found a record of "
                f"{len(v) * Ts_s:g} s"
            )
    bins = np.unique(np.clip(np.rint(np.asarray(freq_hz) * length * Ts_s), 1, length // 2))
    index = bins.astype(int)
    V = [_segments(v, length, index) for v in inputs]
    segments, p = sum(map(len, V)), V[0].shape[2]
    if segments <= p:
        raise IdentificationError(
            f"expected more segments of {segment_s:g} s than the {p} inputs, found {segments}"
        )
    Y = [_segments(y, length, index) for y in outputs]
    turn = np.exp(-2j * np.pi * index * (length // 2) / length)
    power = [np.einsum("kfi,kfj->fij", x, x.conj()) for x in V]
    shared = [OVERLAP * np.einsum("f,kfi,kfj->fij", turn, x[1:], x[:-1].conj()) for x in V]
    total = np.sum(power, axis=0)
    across = sum(np.einsum("kfi,kfj->fij", y, x.conj()) for y, x in zip(Y, V, strict=True))
    scale = np.sqrt(np.einsum("fii->fi", total).real)
    if np.any(scale == 0):
        raise IdentificationError("expected every input to be excited, found one that is not")
    normal = total / (scale[:, :, None] * scale[:, None, :])
    if np.linalg.cond(normal).max() > 1e10:
        raise IdentificationError(
            "expected independent inputs in these records, found two that are proportional"
        )
    inverse = np.linalg.inv(normal) / (scale[:, :, None] * scale[:, None, :])
    H = across @ inverse
    m = H.shape[1]
    covariance = np.zeros((len(index), m, p, m, p), complex)
    residual_power, output_power, variance, variance_square = np.zeros((4, len(index), m, p))
    for x, y, phi, both in zip(V, Y, power, shared, strict=True):
        error = y - np.einsum("fij,kfj->kfi", H, x)
        excited = np.einsum("fii->i", phi).real > 0
        # Sum over segments k and l of x(k) x(l)^H times how their noise is correlated.
        effective = phi + both + both.conj().transpose(0, 2, 1)
        # Degrees of freedom that the fit takes from the segments of this record.
        used = np.einsum("fij,fji->f", inverse, effective).real
        squares = np.einsum("kfi,kfj->fij", error, error.conj())
        noise = squares / np.maximum(len(x) - used, LEAST_FREEDOM)[:, None, None]
        weight = inverse @ effective @ inverse
        covariance += np.einsum("fik,flj->fijkl", noise, weight)
        part = np.einsum("fii,fjj->fij", noise, weight).real
        freedom = np.maximum(len(x) / (1.0 + 2.0 * OVERLAP**2) - used, LEAST_FREEDOM)
        variance += part
        variance_square += part**2 / freedom[:, None, None]
        residual_power[:, :, excited] += (np.abs(error) ** 2).sum(axis=0)[:, :, None]
        output_power[:, :, excited] += (np.abs(y) ** 2).sum(axis=0)[:, :, None]
    # Degrees of freedom of a sum of estimated variances (Satterthwaite 1946); without noise, 1.
    freedom = np.divide(
        variance**2, variance_square, out=np.ones_like(variance_square), where=variance_square > 0
    )
    widening = circle(0.95, freedom) / np.sqrt(-np.log(0.05))
    covariance *= widening[:, :, :, None, None] * widening[:, None, None]
    share = np.divide(
        residual_power, output_power, out=np.ones_like(output_power), where=output_power > 0
    )
    coherence = np.clip(1.0 - share, 0.0, 1.0)
    return ResponseEstimate(index / (length * Ts_s), H, coherence, covariance, Ts_s)


def sensitivity(records: Sequence[Record], freq_hz: Array, segment_s: float) -> ResponseEstimate:
    """Estimate the input sensitivity S from excitation v to the input before the limits.

    The estimate is I plus the response from v to u_unlimited - v = -C y, which rounds less. The
    input before the limits is used because saturation is not a reaction of the controller.

    Raises IdentificationError if a record lacks the plant input.
    """
    feedback = [
        (_plant_input(r) if r.u_unlimited is None else r.u_unlimited) - r.v for r in records
    ]
    estimate = frequency_response(
        [r.v for r in records], feedback, records[0].Ts_s, freq_hz, segment_s
    )
    eye = np.eye(estimate.H.shape[1])
    return ResponseEstimate(
        estimate.freq_hz, eye + estimate.H, estimate.coherence, estimate.covariance, estimate.Ts_s
    )


def plant_from_sensitivity(S: ResponseEstimate, controller: PiController) -> ResponseEstimate:
    """Return P = C^-1 (S^-1 - I), (15) corrected, with first-order covariance.

    It is computed as C^-1 S^-1 (I - S), which is accurate where S is close to I; C is the exact
    discrete controller. The covariance follows from dP = -C^-1 S^-1 dS S^-1. The coherence is that
    of u - v = -C y with v: the share of the feedback that the excitation explains.
    """
    eye = np.eye(S.H.shape[1])
    C = controller.response(S.freq_hz, S.Ts_s)
    inverse = np.asarray(np.linalg.inv(S.H), dtype=np.complex128)
    left = inverse / C[:, :, None]
    P = left @ (eye - S.H)
    covariance = _propagate(left, S.covariance, inverse)
    return ResponseEstimate(S.freq_hz, P, S.coherence, covariance, S.Ts_s)


def plant_from_joint(
    records: Sequence[Record], freq_hz: Array, segment_s: float
) -> ResponseEstimate:
    """Return the joint input-output estimate P = (Y / V) (U / V)^-1, which needs no controller."""
    signals = [np.hstack([r.y, _plant_input(r) - r.v]) for r in records]
    both = frequency_response([r.v for r in records], signals, records[0].Ts_s, freq_hz, segment_s)
    m = records[0].y.shape[1]
    p = both.H.shape[2]
    inverse = np.asarray(np.linalg.inv(np.eye(p) + both.H[:, m:]), dtype=np.complex128)
    P = both.H[:, :m] @ inverse
    left = np.concatenate([np.broadcast_to(np.eye(m), (len(P), m, m)), -P], axis=2)
    covariance = _propagate(left, both.covariance, inverse)
    return ResponseEstimate(both.freq_hz, P, both.coherence[:, :m], covariance, both.Ts_s)


def plant_from_loop_response(
    G: Complex, controller: PiController, freq_hz: Array, Ts_s: float
) -> Complex:
    """Return P = G (I - C G)^-1 (14) at each frequency, for G of shape (F, p, p)."""
    C = controller.response(freq_hz, Ts_s)
    return np.asarray(G @ np.linalg.inv(np.eye(G.shape[1]) - C[:, :, None] * G))


def _plant_input(record: Record) -> Array:
    if record.u is None:
        raise IdentificationError(
            f"record '{record.name}': expected the plant input u and the excitation, found no u"
        )
    return record.u


def _propagate(left: Complex, covariance: Complex, right: Complex) -> Complex:
    """Return the covariance of left dH right."""
    half = np.einsum("fai,fijkl,fjb->fabkl", left, covariance, right, optimize=True)
    return np.asarray(
        np.einsum("fabkl,fck,fld->fabcd", half, left.conj(), right.conj(), optimize=True)
    )


def _segments(x: Array, length: int, index: NDArray[np.int_]) -> Complex:
    """Return spectra (K, F, n) of half-overlapping Hann segments, each less its mean."""
    window = signal.windows.hann(length, sym=False)
    hop = length // 2
    starts = range(0, len(x) - length + 1, hop)
    out = np.zeros((len(starts), len(index), x.shape[1]), complex)
    active = np.flatnonzero(varying(x))
    for k, start in enumerate(starts):
        part = x[start : start + length, active]
        spectrum = fft.rfft((part - part.mean(axis=0)).T * window)
        out[k][:, active] = spectrum[:, index].T
    return out
