"""Frequency responses by correlating spectra (Welch), and the plant from the sensitivity (15)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from ..records.record import IdentificationError, PiController, Record

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

OVERLAP = 1.0 / 6.0
"""Correlation of what noise gives to two Hann segments that overlap by half (Welch 1967)."""
LEAST_FREEDOM = 0.5
"""Degrees of freedom that a record has at least; with fewer its circle is wider than any figure."""


@dataclass(frozen=True)
class ResponseEstimate:
    """Frequency response H (F, m, p) at freq_hz (F,), with its uncertainty.

    `coherence` (F, m, p): share of output i that the inputs explain (multiple coherence), in the
    records that excite input j. `covariance` (F, m, p, m, p): of the errors, E dH[i,j] dH[k,l]^*,
    enlarged so that sqrt(-ln 0.05) deviations hold 95 %, as they do with variances that are known,
    however few segments or periods it was estimated from. (The local polynomial method's is not: it
    always has its degrees of freedom.)
    """

    freq_hz: Array
    H: Complex
    coherence: Array
    covariance: Complex
    Ts_s: float

    @property
    def standard_deviation(self) -> Array:
        """Standard deviation (F, m, p) of the complex entries; 95 % lie within 1.73 of it."""
        return np.asarray(np.sqrt(np.abs(np.einsum("fijij->fij", self.covariance))))


def circle(confidence: float, freedom: Array | float) -> Array:
    """Return the radius, in estimated deviations, that holds a complex error with this confidence.

    Its square over the variance, estimated with `freedom` degrees of freedom, is distributed as F
    with 2 and 2 `freedom` (Pintelon and Schoukens 2012, chapter 2); the quantile has a closed form.
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
    bins (multiples of 1 / segment_s) nearest to freq_hz. The covariance follows from what H V
    leaves of Y in each record: noise, and the leakage of transients. Neighbouring segments share
    some of their noise: of inputs that repeat, whose segments are all alike, that is felt sixfold.

    Raises IdentificationError for records shorter than two segments, no more segments than inputs,
    and inputs that cannot be told apart.
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
            "expected inputs that can be told apart in these records, found two that move as one"
        )
    inverse = np.linalg.inv(normal) / (scale[:, :, None] * scale[:, None, :])
    H = across @ inverse
    m = H.shape[1]
    covariance = np.zeros((len(index), m, p, m, p), complex)
    left, all_of_it, variance, scatter = np.zeros((4, len(index), m, p))
    for x, y, phi, both in zip(V, Y, power, shared, strict=True):
        error = y - np.einsum("fij,kfj->kfi", H, x)
        excited = np.einsum("fii->i", phi).real > 0
        # Sum over segments k and l of x(k) x(l)^H times how their noise is correlated.
        effective = phi + both + both.conj().transpose(0, 2, 1)
        # Of its segments the fit has used up as many as it has followed this record alone.
        followed = np.einsum("fij,fji->f", inverse, effective).real
        squares = np.einsum("kfi,kfj->fij", error, error.conj())
        noise = squares / np.maximum(len(x) - followed, LEAST_FREEDOM)[:, None, None]
        weight = inverse @ effective @ inverse
        covariance += np.einsum("fik,flj->fijkl", noise, weight)
        part = np.einsum("fii,fjj->fij", noise, weight).real
        freedom = np.maximum(len(x) / (1.0 + 2.0 * OVERLAP**2) - followed, LEAST_FREEDOM)
        variance += part
        scatter += part**2 / freedom[:, None, None]
        left[:, :, excited] += (np.abs(error) ** 2).sum(axis=0)[:, :, None]
        all_of_it[:, :, excited] += (np.abs(y) ** 2).sum(axis=0)[:, :, None]
    # The freedom of a sum of estimated variances (Satterthwaite 1946); without noise any will do.
    freedom = np.divide(variance**2, scatter, out=np.ones_like(scatter), where=scatter > 0)
    wider = circle(0.95, freedom) / np.sqrt(-np.log(0.05))
    covariance *= wider[:, :, :, None, None] * wider[:, None, None]
    share = np.divide(left, all_of_it, out=np.ones_like(left), where=all_of_it > 0)
    coherence = np.clip(1.0 - share, 0.0, 1.0)
    return ResponseEstimate(index / (length * Ts_s), H, coherence, covariance, Ts_s)


def sensitivity(records: Sequence[Record], freq_hz: Array, segment_s: float) -> ResponseEstimate:
    """Return the input sensitivity S from excitation v to the input that is asked for.

    It is estimated as I plus the response to asked - v = -C y, the same number without its
    rounding: what limits take off a wrench is no answer of the controller. Raises
    IdentificationError when a record lacks the plant input.
    """
    feedback = [(_plant_input(r) if r.asked is None else r.asked) - r.v for r in records]
    estimate = frequency_response(
        [r.v for r in records], feedback, records[0].Ts_s, freq_hz, segment_s
    )
    eye = np.eye(estimate.H.shape[1])
    return ResponseEstimate(
        estimate.freq_hz, eye + estimate.H, estimate.coherence, estimate.covariance, estimate.Ts_s
    )


def plant_from_sensitivity(S: ResponseEstimate, controller: PiController) -> ResponseEstimate:
    """Return P = C^-1 (S^-1 - I), (15) corrected, with first-order covariance.

    Written as C^-1 S^-1 (I - S), which keeps its digits where S is close to I; C is the exact
    discrete controller. From dP = -C^-1 S^-1 dS S^-1 follows the covariance. The coherence is that
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
    """Return P = (Y / V) (U / V)^-1, the joint input-output estimate, which needs no controller."""
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
    """Return P = G (I - C G)^-1 (14) point by point, for G of shape (F, p, p)."""
    C = controller.response(freq_hz, Ts_s)
    return np.asarray(G @ np.linalg.inv(np.eye(G.shape[1]) - C[:, :, None] * G))


def _plant_input(record: Record) -> Array:
    if record.u is None:
        raise IdentificationError(
            f"record '{record.name}': expected the plant input u beside the excitation, found none"
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
    active = np.flatnonzero(np.ptp(x, axis=0) > 0)
    for k, start in enumerate(starts):
        part = x[start : start + length, active]
        spectrum = fft.rfft((part - part.mean(axis=0)).T * window)
        out[k][:, active] = spectrum[:, index].T
    return out
