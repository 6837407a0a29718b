"""Markov parameters from excitation to output: by correlation, or by least squares."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal
from scipy.linalg import solve_triangular

from ..records.record import IdentificationError, Record
from .least_squares import independent, triangle
from .toeplitz_least_squares import ToeplitzGram, solve

Array = NDArray[np.float64]

DENSE_ELEMENTS = 15_000_000
"""Up to this size (120 MB) the matrix of a least-squares problem is formed."""

_NOTHING = 1e-12
"""Share of an excitation's power that rounding leaves where there is none."""
ROWS_A_TAP = 2
"""Least rows for each unknown of a least-squares problem: with fewer, errors grow like noise."""


@dataclass(frozen=True)
class MarkovEstimate:
    """Markov parameters g (L, m, p): y(k) = sum_t g(t) v(k - t), with their standard error.

    `standard_error` (m, p) is that of a tap on average, `residual_rms` (m,) in units of the output.
    """

    method: str
    g: Array
    standard_error: Array
    residual_rms: Array
    Ts_s: float


def estimate_markov(records: Sequence[Record], length: int, method: str) -> MarkovEstimate:
    """Estimate `length` Markov parameters from all records at once by the named method.

    Raises IdentificationError for a name that is not in ESTIMATORS, or records too short.
    """
    if method not in ESTIMATORS:
        raise IdentificationError(
            f"expected a Markov estimator out of {', '.join(sorted(ESTIMATORS))}, found '{method}'"
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


def most_taps(records: Sequence[Record]) -> int:
    """Return how many Markov parameters the rows of all records together allow at most."""
    rows, moving = sum(len(r.y) for r in records), sum(not r.at_rest for r in records)
    # Each has an offset; those that move have length - 1 rows before the first whose past is known.
    per_tap = ROWS_A_TAP * records[0].v.shape[1] + moving
    return int((rows - (len(records) - moving)) // per_tap)


def by_correlation(records: Sequence[Record], length: int) -> MarkovEstimate:
    """Cross-correlate output and excitation, as the paper does; right for white excitation only.

    g(t) = sum_k y(k + t) v(k) / sum_k v(k)^2, each input from the records that excite it; both sums
    are over the N - t rows whose answer is in the record. What the other taps add to y acts as
    noise here ("self-noise"), so the standard error is that of the whole output, rms(y) /
    sqrt(sum v^2), both of the same rows, its mean square over the taps, white excitation assumed.
    Of a tap that no excitation tells of, g is zero.
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
            told = np.cumsum(v**2)[-1 : -length - 1 : -1]
            power[:, j] += told
            variance[:, :, j] += told[:, None] * later
    residual = np.sqrt(np.mean([(r.y - r.y.mean(axis=0)).var(axis=0) for r in records], axis=0))
    power = np.where(power > _NOTHING * power[0], power, np.inf)[:, None]
    error = np.sqrt(np.mean(variance / power**2, axis=0))
    return MarkovEstimate("correlation", correlation / power, error, residual, records[0].Ts_s)


def by_least_squares(records: Sequence[Record], length: int) -> MarkovEstimate:
    """Solve min ||y - conv(v, g) - offset||, one constant offset for each record and output.

    Records at rest use every row (v = 0 before them); the others begin once the past that the taps
    reach into is known. No noise but the output's own is left, whatever the excitation's colour.
    Problems that fit into memory are solved by QR, which badly conditioned (coloured) excitation
    needs; large ones by FFT, with conjugate gradients.
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
    # A large problem is solved by iteration, which finds an answer whether there is one or many.
    unknown = length * records[0].v.shape[1]
    rows = sum(len(r.y) - r.first_row(length) - 1 for r in records)
    if rows < ROWS_A_TAP * unknown:
        raise IdentificationError(
            f"expected at least {ROWS_A_TAP * unknown} rows whose past is known, for {unknown} "
            f"Markov parameters an output, found {rows}: longer records, or a shorter impulse "
            "response"
        )


def solve_dense(records: Sequence[Record], length: int) -> tuple[Array, Array]:
    """Return g (L, m, p) by QR of the explicit matrix, and (p,) root mean diagonal of (T^T T)^-1.

    Raises IdentificationError when the excitation cannot tell the taps apart.
    """
    p, m = records[0].v.shape[1], records[0].y.shape[1]
    R = triangle(_dense_rows(records, length))
    taps = R[: p * length, : p * length]
    if not independent(taps, 1e-12):
        raise IdentificationError(
            f"expected excitation that tells {length} Markov parameters apart, found one that "
            "leaves a combination of them undetermined"
        )
    g = solve_triangular(taps, R[: p * length, -m:])
    inverse = solve_triangular(taps, np.eye(p * length))
    spread = np.sqrt((inverse**2).sum(axis=1).reshape(p, length).mean(axis=1))
    return np.ascontiguousarray(g.reshape(p, length, -1).transpose(1, 2, 0)), spread


def _dense_rows(records: Sequence[Record], length: int) -> Iterator[Array]:
    """Yield the rows [v of the last taps, y] of every record, each less its mean."""
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
    """Return y (N, m), the response of Markov parameters g (L, m, p) to v (N, p) from rest."""
    y = np.zeros((len(v), g.shape[1]))
    for j in range(g.shape[2]):
        if np.any(v[:, j]):
            y += signal.oaconvolve(v[:, j : j + 1], g[:, :, j], axes=0)[: len(v)]
    return y


def markov_response(g: Array, freq_hz: Array, Ts_s: float) -> NDArray[np.complex128]:
    """Return the transform sum_t g(t) z^-t of g (L, m, p) as (F, m, p) at any freq_hz (F,)."""
    flat = g.reshape(len(g), -1)
    out = np.empty((len(freq_hz), flat.shape[1]), complex)
    t = np.arange(len(g)) * Ts_s
    for f, freq in enumerate(freq_hz):
        out[f] = np.exp(-2j * np.pi * freq * t) @ flat
    return out.reshape(len(freq_hz), *g.shape[1:])


def _cross_correlation(y: Array, v: Array, length: int) -> Array:
    size = fft.next_fast_len(len(y) + length, real=True)
    return np.asarray(fft.irfft(fft.rfft(y, size) * fft.rfft(v, size).conj(), size)[:length])
