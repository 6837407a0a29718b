"""Solve the normal equations of a convolution by FFT, without forming the matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..records.record import IdentificationError, Record

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

TOLERANCE = 1e-10  # errors from noise are 1e-3 and more
ACCEPTED = 1e-8
MAX_ITERATIONS = 400


@dataclass(frozen=True)
class _Edge:
    """Rows of the full convolution outside the data, to be subtracted from the Gram matrix.

    `spectrum` (F,): of the samples that affect these rows, for every input that moves there. The
    rows are `first` to `last` of their convolution.
    """

    spectrum: dict[int, Complex]
    first: int
    last: int

    @classmethod
    def of(cls, v: Array, size: int, first: int, last: int) -> _Edge:
        """Return the edge of samples v (p, n)."""
        moving = np.flatnonzero(np.any(v, axis=1))
        return cls({int(j): fft.rfft(v[j], size) for j in moving}, first, last)


@dataclass(frozen=True)
class _Blocks:
    """A matrix (p, p) at each of F frequencies, stored by its non-zero entries.

    If every record excites one input, only the diagonal is stored.
    """

    entries: dict[tuple[int, int], Complex]

    @classmethod
    def of(cls, matrices: Complex) -> _Blocks:
        """Return the non-zero entries of matrices (F, p, p)."""
        nonzero = np.argwhere(np.any(matrices, axis=0))
        return cls({(int(i), int(j)): matrices[:, i, j].copy() for i, j in nonzero})

    def __matmul__(self, spectrum: Complex) -> Complex:
        """Return the product with spectrum (m, p, F)."""
        out = np.zeros_like(spectrum)
        for (i, j), entry in self.entries.items():
            out[:, i] += entry * spectrum[:, j]
        return out


@dataclass(frozen=True)
class ToeplitzGram:
    """The Gram matrix T^T T of y = T g + offset over all records, for g of `length` taps, p inputs.

    The full convolution of each record gives a block Toeplitz matrix of autocorrelation lags. The
    rows before the first usable row and after the end of the record are subtracted, and the
    constant offsets are projected out. One product costs FFTs of twice `length`, for any number of
    rows.
    """

    length: int
    size: int
    symbol: _Blocks  # transform of the autocorrelation lags
    edges: tuple[_Edge, ...]
    ones: Array  # (R, p, L): T^T 1 of each record
    rows: tuple[tuple[int, int], ...]  # first and last row used of each record
    lags: Array  # (L, p, p): sum_k v_i(k) v_j(k + t)
    inputs: tuple[Array, ...]

    @classmethod
    def from_records(cls, records: Sequence[Record], length: int) -> ToeplitzGram:
        """Build the operator from the excitations v of the records."""
        p = records[0].v.shape[1]
        size = fft.next_fast_len(2 * length, real=True)
        lags = np.zeros((length, p, p))
        edges, ones, rows = [], [], []
        for record in records:
            v = record.v.T
            first = record.first_row(length)
            lags += _autocorrelation(v, length)
            if first:
                edges.append(_Edge.of(v[:, :first], size, 0, first))
            if length > 1:
                tail = v[:, len(record.v) - length + 1 :]
                edges.append(_Edge.of(tail, size, length - 1, 2 * length - 2))
            ones.append(_sums(v, first, length))
            rows.append((first, len(record.v)))
        circulant = np.zeros((size, p, p))
        circulant[:length] = lags
        circulant[size - length + 1 :] += lags[:0:-1].transpose(0, 2, 1)
        return cls(
            length,
            size,
            _Blocks.of(fft.rfft(circulant, axis=0)),
            tuple(edges),
            np.array(ones),
            tuple(rows),
            lags,
            tuple(r.v for r in records),
        )

    def __matmul__(self, g: Array) -> Array:
        """Return T^T T g for g of shape (m, p, L)."""
        spectrum = fft.rfft(g, self.size)
        total = self.symbol @ spectrum
        for edge in self.edges:
            reached = np.zeros_like(spectrum[:, 0])
            for j, driven in edge.spectrum.items():
                reached += driven * spectrum[:, j]
            h = fft.irfft(reached, self.size)
            h[:, : edge.first] = 0.0
            h[:, edge.last :] = 0.0
            back = fft.rfft(h)
            for j, driven in edge.spectrum.items():
                total[:, j] -= driven.conj() * back
        out = np.asarray(fft.irfft(total, self.size)[..., : self.length])
        for ones, (first, last) in zip(self.ones, self.rows, strict=True):
            weight = np.einsum("jl,mjl->m", ones, g) / (last - first)
            out -= weight[:, None, None] * ones
        return out

    def project(self, record: int, y: Array) -> Array:
        """Return the rows of y (N, m) used in the fit of this record, without their mean."""
        first, last = self.rows[record]
        return np.asarray(y[first:last] - y[first:last].mean(axis=0))

    def right_hand_side(self, outputs: Sequence[Array]) -> Array:
        """Return T^T y as (m, p, L) for the outputs (N, m) of every record."""
        m, p = outputs[0].shape[1], self.ones.shape[1]
        out = np.zeros((m, p, self.length))
        for r, (y, v) in enumerate(zip(outputs, self.inputs, strict=True)):
            first, last = self.rows[r]
            size = fft.next_fast_len(len(v) + self.length, real=True)
            centred = np.zeros((m, last))
            centred[:, first:] = self.project(r, y).T
            spectrum = fft.rfft(centred, size)
            for j in np.flatnonzero(np.any(v, axis=0)):
                across = fft.rfft(v[:, j], size).conj()
                out[:, j] += fft.irfft(spectrum * across, size)[:, : self.length]
        return out

    def preconditioner(self) -> Complex:
        """Return the inverse (F, p, p) of T. Chan's circulant approximation of the Toeplitz part.

        Raises IdentificationError if a frequency band is not excited.
        """
        L = self.length
        fade = (np.arange(L) / L)[:, None, None]
        wrapped = np.concatenate([self.lags[:1], self.lags[:0:-1]]).transpose(0, 2, 1)
        circulant = (1 - fade) * self.lags + fade * wrapped
        symbol = fft.rfft(circulant, axis=0)
        symbol = (symbol + symbol.conj().transpose(0, 2, 1)) / 2
        power = np.linalg.eigvalsh(symbol)
        if power[:, 0].min() <= 1e-12 * power[:, -1].max():
            raise IdentificationError(
                f"expected excitation at every frequency for {L} Markov parameters, found a band "
                f"with less than 1e-12 of the largest power (at {power[:, 0].argmin() / L:.4f} of "
                "the sampling rate)"
            )
        return np.asarray(np.linalg.inv(symbol))

    def inverse_scale(self) -> Array:
        """Return the root mean diagonal (p,) of (T^T T)^-1, from its circulant approximation.

        The circulant approximates the full convolution; the share of its rows that are in the data
        corrects it.
        """
        inverse = self.preconditioner()
        weight = np.full(len(inverse), 2.0)
        weight[0] = 1.0
        if self.length % 2 == 0:
            weight[-1] = 1.0
        diagonal = np.einsum("f,fjj->j", weight, inverse).real / self.length
        return np.asarray(np.sqrt(diagonal / self._share_of_rows()))

    def _share_of_rows(self) -> Array:
        """Return the trace of T^T T over that of the full convolution, by input (p,)."""
        kept = np.zeros(len(self.lags[0]))
        for v, (first, last) in zip(self.inputs, self.rows, strict=True):
            kept += _sums(v[:last].T ** 2, first, self.length).sum(axis=1)
        return np.asarray(kept / (self.length * np.diagonal(self.lags[0])))


def solve(gram: ToeplitzGram, right: Array) -> Array:
    """Solve gram g = right for g (L, m, p), by preconditioned conjugate gradients.

    Raises IdentificationError if the iteration does not converge: the excitation does not determine
    so many taps.
    """
    inverse = _Blocks.of(gram.preconditioner())

    def precondition(r: Array) -> Array:
        return np.asarray(fft.irfft(inverse @ fft.rfft(r, gram.length), gram.length))

    g = np.zeros_like(right)
    r = right.copy()
    z = precondition(r)
    d = z.copy()
    rho = _dots(r, z)
    target = TOLERANCE**2 * np.maximum(rho, np.finfo(float).tiny)
    for _ in range(MAX_ITERATIONS):
        if np.all(rho <= target):
            break
        q = gram @ d
        alpha = _ratio(rho, _dots(d, q))
        g += alpha * d
        r -= alpha * q
        z = precondition(r)
        rho, previous = _dots(r, z), rho
        d = z + _ratio(rho, previous) * d
    if np.any(rho > (ACCEPTED / TOLERANCE) ** 2 * target):
        residual = np.sqrt(np.max(rho / target)) * TOLERANCE
        raise IdentificationError(
            f"least squares for {gram.length} Markov parameters did not converge (relative "
            f"residual {residual:.1e}): the excitation does not determine so many; use white noise"
        )
    return np.ascontiguousarray(g.transpose(2, 0, 1))


def _dots(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("mjl,mjl->m", a, b))


def _ratio(a: Array, b: Array) -> Array:
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0)[:, None, None]


def _autocorrelation(v: Array, length: int) -> Array:
    """Return the autocorrelation (L, p, p) sum_k v_i(k) v_j(k + t) of the record v (p, N)."""
    size = fft.next_fast_len(v.shape[1] + length, real=True)
    out = np.zeros((length, len(v), len(v)))
    active = np.flatnonzero(np.any(v, axis=1))
    spectrum = fft.rfft(v[active], size)
    for a, i in enumerate(active):
        for b, j in enumerate(active):
            out[:, i, j] = fft.irfft(spectrum[a].conj() * spectrum[b], size)[:length]
    return out


def _sums(v: Array, first: int, length: int) -> Array:
    """Return the sums (p, L) of v(k - t) over k = first..N-1, for t = 0..L-1, with v = 0 before."""
    n = v.shape[1]
    total = np.concatenate([np.zeros((len(v), 1)), np.cumsum(v, axis=1)], axis=1)
    t = np.arange(length)
    return np.asarray(total[:, n - t] - total[:, np.maximum(first - t, 0)])
