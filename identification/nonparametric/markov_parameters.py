"""Estimate Markov parameters from excitation to output, by correlation or by least squares."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal
from scipy.linalg import solve_triangular

from ..records.record import IdentificationError, Record
from .block_qr import independent, triangle
from .toeplitz_least_squares import ToeplitzGram, solve

Array = NDArray[np.float64]

DENSE_ELEMENTS = 15_000_000
"""Largest least-squares matrix (120 MB) that is formed explicitly, in elements."""

_NOTHING = 1e-12
"""Relative excitation power below which it is rounding."""
ROWS_A_TAP = 2
"""Least number of rows for each unknown: with fewer, the noise is amplified."""


@dataclass(frozen=True)
class MarkovEstimate:
    """Markov parameters g (L, m, p): y(k) = sum_t g(t) v(k - t), with their standard error.

    `standard_error` (m, p) is the average over the taps; `residual_rms` (m,) is in output units.
    """

    method: str
    g: Array
    standard_error: Array
    residual_rms: Array
    Ts_s: float


def estimate_markov(records: Sequence[Record], length: int, method: str) -> MarkovEstimate:
    """Estimate `length` Markov parameters from all records together, by a method in ESTIMATORS.

    Raises IdentificationError for an unknown method or records that are too short.
    """
    if method not in ESTIMATORS:
        raise IdentificationError(
            f"expected one of the Markov estimators {', '.join(sorted(ESTIMATORS))}, "
            f"found '{method}'"
        )
    for record in records:
        needed = length if record.at_rest else 2 * length
        if len(record.y) < needed:
            raise IdentificationError(
                f"record '{record.name}': expected at least {needed} rows for {length} Markov "
                f"parameters, found {len(record.y)}"
            )
    if method == "least_squares":
        _check_rows(records, length)
    return ESTIMATORS[method](records, length)


def nested_estimates(
    records: Sequence[Record], lengths: Sequence[int], method: str
) -> dict[int, Array]:
    """Return the Markov parameters (L, m, p) for each length L that the excitation determines.

    Least squares of all lengths use the rows of the longest one and follow from one QR. Raises
    IdentificationError as estimate_markov does for the longest length.
    """
    longest = max(lengths)
    p, m = records[0].v.shape[1], records[0].y.shape[1]
    if method != "least_squares":
        g = estimate_markov(records, longest, method).g
        return {length: g[:length] for length in lengths}
    _check_rows(records, longest)
    if sum(len(r.y) for r in records) * p * longest > DENSE_ELEMENTS:
        return {length: by_least_squares(records, length).g for length in lengths}
    R = triangle(_dense_rows(records, longest))
    found = {}
    for length in lengths:
        taps = (longest * np.arange(p)[:, None] + np.arange(length)).ravel()
        with_y = np.append(taps, p * longest + np.arange(m))
        part = np.asarray(np.linalg.qr(R[:, with_y], mode="r"))
        with suppress(IdentificationError):
            found[length] = _solved(part, length, p)[0]
    return found


def most_taps(records: Sequence[Record]) -> int:
    """Return the largest number of Markov parameters that the rows of all records determine."""
    rows, moving = sum(len(r.y) for r in records), sum(not r.at_rest for r in records)
    # Each record has an offset; one that is not at rest loses its first length - 1 rows.
    per_tap = ROWS_A_TAP * records[0].v.shape[1] + moving
    return int((rows - (len(records) - moving)) // per_tap)


def by_correlation(records: Sequence[Record], length: int) -> MarkovEstimate:
    """Estimate Markov parameters by cross-correlation, as the paper does; needs white excitation.

    g(t) = sum_k y(k + t) v(k) / sum_k v(k)^2, each input from the records that excite it; both sums
    are over the N - t rows with k + t in the record. The contributions of other taps to y act as
    noise ("self-noise"): the standard error is rms(y) / sqrt(sum v^2) of the same rows, as a root
    mean square over the taps; `correlation_standard_deviation` gives each tap's. g is zero for taps
    without excitation.
    """
    m, p = records[0].y.shape[1], records[0].v.shape[1]
    correlation = np.zeros((length, m, p))
    power, variance = np.zeros((length, p)), np.zeros((length, m, p))
    for record in records:
        y = record.y - record.y.mean(axis=0)
        rows = np.arange(1, len(y) + 1)
        later = (np.cumsum(y[::-1] ** 2, axis=0) / rows[:, None])[: -length - 1 : -1]
        for j in np.flatnonzero(record.excited):
            v = record.v[:, j]
            for i in range(m):
                correlation[:, i, j] += _cross_correlation(y[:, i], v, length)
            excitation = np.cumsum(v**2)[-1 : -length - 1 : -1]
            power[:, j] += excitation
            variance[:, :, j] += excitation[:, None] * later
    residual = np.sqrt(np.mean([(r.y - r.y.mean(axis=0)).var(axis=0) for r in records], axis=0))
    power = np.where(power > _NOTHING * power[0], power, np.inf)[:, None]
    error = np.sqrt(np.mean(variance / power**2, axis=0))
    return MarkovEstimate("correlation", correlation / power, error, residual, records[0].Ts_s)


def correlation_standard_deviation(
    g: Array, output_rms: Array, input_rms: Array, rows: int
) -> Array:
    """Return the standard deviation (L, m, p) of each tap of `by_correlation`.

    For stationary white Gaussian excitation, independent between inputs, with rms `input_rms` (p,),
    in records of `rows` rows for each input. `g` (L, m, p) are the true Markov parameters, decayed
    at their end. `output_rms` (m, p) is the rms of each output, noise included, in the records that
    excite the input. Units: those of g.

    The variance at delay t, in units of 1 / (N - t), is
    (rms(y) / rms(v))^2 - 2 g(t)^2 + sum_i g(i) g(2 t - i).
    The sum arises because the sample autocorrelation of v is symmetric. Source: Isserlis' theorem
    for the moments of Gaussian signals, as in Bartlett's formula. Noise that is correlated with v
    is not included.
    """
    length = len(g)
    size = fft.next_fast_len(2 * length, real=True)
    mirrored = fft.irfft(fft.rfft(g, size, axis=0) ** 2, size, axis=0)[: 2 * length : 2]
    variance = (output_rms / input_rms) ** 2 - 2.0 * g**2 + mirrored
    used = rows - np.arange(length)[:, None, None]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0) / used))


def by_least_squares(records: Sequence[Record], length: int) -> MarkovEstimate:
    """Estimate Markov parameters by least squares: min ||y - conv(v, g) - offset||.

    Each record and output has a constant offset. Records that start at rest use every row (v = 0
    before them); the others start at the first row whose last `length` inputs are known. The
    residual is the output noise, for any colour of the excitation. Problems that fit into memory
    are solved by QR, which ill-conditioned (coloured) excitation needs; larger ones by conjugate
    gradients with FFT.
    """
    rows = sum(len(r.y) for r in records)
    p = records[0].v.shape[1]
    if rows * p * length <= DENSE_ELEMENTS:
        g, spread = solve_dense(records, length)
    else:
        gram = ToeplitzGram.from_records(records, length)
        g = solve(gram, gram.right_hand_side([r.y for r in records]))
        spread = gram.inverse_scale()
    squares, freedom = 0.0, -length * p
    for record in records:
        error = (record.y - convolve(record.v, g))[record.first_row(length) :]
        squares = squares + ((error - error.mean(axis=0)) ** 2).sum(axis=0)
        freedom += len(error) - 1
    rms = np.sqrt(squares / max(freedom, 1))
    return MarkovEstimate("least_squares", g, np.outer(rms, spread), rms, records[0].Ts_s)


def _check_rows(records: Sequence[Record], length: int) -> None:
    # Conjugate gradients converge even if the problem is underdetermined.
    unknown = length * records[0].v.shape[1]
    rows = sum(len(r.y) - r.first_row(length) - 1 for r in records)
    if rows < ROWS_A_TAP * unknown:
        raise IdentificationError(
            f"expected at least {ROWS_A_TAP * unknown} usable rows for {unknown} Markov parameters "
            f"of each output, found {rows}; make longer records or choose a shorter impulse "
            "response"
        )


def solve_dense(records: Sequence[Record], length: int) -> tuple[Array, Array]:
    """Return g (L, m, p) by QR of the explicit matrix, and (p,) root mean diagonal of (T^T T)^-1.

    Raises IdentificationError if the excitation does not determine all taps.
    """
    return _solved(triangle(_dense_rows(records, length)), length, records[0].v.shape[1])


def _solved(R: Array, length: int, p: int) -> tuple[Array, Array]:
    m = R.shape[1] - p * length
    taps = R[: p * length, : p * length]
    if not independent(taps, 1e-12):
        raise IdentificationError(
            f"expected excitation that determines {length} Markov parameters, found one that "
            "leaves a combination of them undetermined"
        )
    g = solve_triangular(taps, R[: p * length, -m:])
    inverse = solve_triangular(taps, np.eye(p * length))
    spread = np.sqrt((inverse**2).sum(axis=1).reshape(p, length).mean(axis=1))
    return np.ascontiguousarray(g.reshape(p, length, -1).transpose(1, 2, 0)), spread


def _dense_rows(records: Sequence[Record], length: int) -> Iterator[Array]:
    """Yield the rows [v of the last taps, y] of every record, without their means."""
    for record in records:
        first = record.first_row(length)
        p = record.v.shape[1]
        padded = np.concatenate([np.zeros((length - 1, p)), record.v])
        windows = np.lib.stride_tricks.sliding_window_view(padded, length, axis=0)[first:, :, ::-1]
        T = windows.reshape(len(windows), p * length)
        y = record.y[first:]
        yield np.hstack([T - T.mean(axis=0), y - y.mean(axis=0)])


ESTIMATORS: Mapping[str, Callable[[Sequence[Record], int], MarkovEstimate]] = MappingProxyType(
    {"correlation": by_correlation, "least_squares": by_least_squares}
)


def convolve(v: Array, g: Array) -> Array:
    """Return the response y (N, m) of Markov parameters g (L, m, p) to v (N, p), from rest."""
    y = np.zeros((len(v), g.shape[1]))
    for j in range(g.shape[2]):
        if np.any(v[:, j]):
            y += signal.oaconvolve(v[:, j : j + 1], g[:, :, j], axes=0)[: len(v)]
    return y


def markov_response(g: Array, freq_hz: Array, Ts_s: float) -> NDArray[np.complex128]:
    """Return the frequency response sum_t g(t) z^-t (F, m, p) of g (L, m, p) at freq_hz (F,)."""
    flat = g.reshape(len(g), -1)
    out = np.empty((len(freq_hz), flat.shape[1]), complex)
    t = np.arange(len(g)) * Ts_s
    for f, freq in enumerate(freq_hz):
        out[f] = np.exp(-2j * np.pi * freq * t) @ flat
    return out.reshape(len(freq_hz), *g.shape[1:])


def _cross_correlation(y: Array, v: Array, length: int) -> Array:
    size = fft.next_fast_len(len(y) + length, real=True)
    return np.asarray(fft.irfft(fft.rfft(y, size) * fft.rfft(v, size).conj(), size)[:length])
