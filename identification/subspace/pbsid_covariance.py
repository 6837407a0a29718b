"""Compute the covariance of a subspace estimate by propagating the predictor's errors.

The predictor is a regression, whose errors follow from the records; the later steps are linearised.
Compare Chiuso and Picci, "The asymptotic variance of subspace estimates", Journal of Econometrics
118 (2004) 257.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal
from scipy.linalg import cho_factor, cho_solve

Array = NDArray[np.float64]

BLOCKS = 40
"""Blocks of a record, none shorter than the predictor's past."""
_REGULARISATION = 1e-13
"""Added to the diagonal of the scaled Gram matrix, so that noise-free data can be factorised."""


@dataclass(frozen=True)
class States:
    """States x(k) = of_past [z(k-1) ... z(k-s)], and how they follow from the predictor.

    `of_past` (n, s w) is sum_r of_predictor[:, r] B[r], where B[r] are the predictor's Markov
    parameters (m, w) of lags r + 1 to s, moved to the front; `of_predictor` is (n, s, m).
    """

    of_past: Array
    of_predictor: Array

    def first(self, count: int) -> States:
        """Return the first `count` states."""
        return States(self.of_past[:count], self.of_predictor[:count])


def covariance_of_equations(
    signals: Sequence[Array], gram: Array, theta: Array, states: States, ABCD: Array
) -> Array:
    """Return the covariance (n + m, n + p, n + m, n + p) of [A B; C D].

    `signals` z = [u, y] (N, w) of each record; `gram` of [z(k), ..., z(k-s)], summed over them;
    `theta` (m, s w + p) predicts y(k) from the past and u(k); `ABCD` is the regression of
    [x(k+1), y(k)] on [x(k), u(k)]. The basis of the states is fixed: errors that only rotate it are
    left out, as they do not affect responses and poles.

    The error of theta is S normal^-1, with S the sum over k of the innovation times the regressors.
    The scatter of S is estimated from its parts over blocks of rows, which are nearly independent
    (clustered covariance; Liang and Zeger, Biometrika 73 (1986) 13). So the innovation may be
    coloured (as with a short past) and its variance may change.
    """
    slope = _slope(gram, theta, states, ABCD)  # (n + m, n + p, m, s w + p)
    m = len(theta)
    p = theta.shape[1] - states.of_past.shape[1]
    width = m + p
    past = np.concatenate([np.arange(width, len(gram)), np.arange(p)])
    normal = gram[np.ix_(past, past)]
    size = np.sqrt(np.diag(normal))
    scaled = normal / size / size[:, None]
    scaled[np.diag_indices_from(scaled)] += len(scaled) * _REGULARISATION
    flat = (slope / size).reshape(-1, len(size))
    by_product = (cho_solve(cho_factor(scaled), flat.T).T / size).reshape(ABCD.size, -1)
    products = np.concatenate([_products_by_block(z, theta, p) for z in signals])
    errors = products.reshape(len(products), -1) @ by_product.T
    # The fit of many parameters makes the innovation too small. Without a block in the fit its
    # innovation would be as much larger, so the factor applies twice (jackknife, HC3; MacKinnon and
    # White, Journal of Econometrics 29 (1985) 305). Short records need both.
    rows = sum(len(z) - len(gram) // width + 1 for z in signals)
    correction = 1.0 / (1.0 - len(size) / rows) ** 2
    return np.asarray(correction * errors.T @ errors).reshape(*ABCD.shape, *ABCD.shape)


def _products_by_block(z: Array, theta: Array, p: int) -> Array:
    """Return the sums (blocks, m, s w + p) over k of e(k) [z(k-1), ..., z(k-s), u(k)]."""
    width = z.shape[1]
    m, steps = len(theta), (theta.shape[1] - p) // width
    z = z - z[steps:].mean(axis=0)
    taps = np.zeros((steps + 1, width, m))
    taps[0, :p] = -theta[:, steps * width :].T
    taps[0, p:] = np.eye(m)
    taps[1:] = -theta[:, : steps * width].reshape(m, steps, width).transpose(1, 2, 0)
    e = np.zeros((len(z) - steps, m))
    for j in range(width):
        e += signal.oaconvolve(z[:, j : j + 1], taps[:, j], axes=0)[steps : len(z)]
    e -= e.mean(axis=0)
    rows = max(len(e) // BLOCKS, steps)
    starts = range(0, len(e) - rows + 1, rows)
    length = fft.next_fast_len(rows + steps + (len(e) - rows * len(starts)), real=True)
    out = np.empty((len(starts), m, steps * width + p))
    for number, start in enumerate(starts):
        end = len(e) if number == len(starts) - 1 else start + rows
        e_spectrum = fft.rfft(e[start:end], length, axis=0)
        z_spectrum = fft.rfft(z[start : end + steps], length, axis=0)
        # Lag l is at index `steps - l`: z starts `steps` rows before e.
        cross = fft.irfft(e_spectrum.conj()[:, :, None] * z_spectrum[:, None, :], length, axis=0)
        lags = cross[steps::-1]
        out[number, :, : steps * width] = lags[1:].transpose(1, 0, 2).reshape(m, -1)
        out[number, :, steps * width :] = lags[0][:, :p]
    return out


def _slope(gram: Array, theta: Array, states: States, ABCD: Array) -> Array:
    """Return d[A B; C D] / d theta, (n + m, n + p, m, s w + p).

    d[A B; C D] R = (dM - [A; C] dT_1) G N^T + M_y d(y z^T) N^T, where N maps the lags to
    [x(k), u(k)], M maps them to [x(k+1), y(k)], R = N G N^T, and dT_1 is the change of the states
    at k. The residual of x(k+1) is the innovation, uncorrelated with the past: no further term.
    """
    n, steps, m = states.of_predictor.shape
    length = states.of_past.shape[1]
    p = theta.shape[1] - length
    width = m + p
    N = np.zeros((n + p, len(gram)))
    N[:n, width:] = states.of_past
    N[n:, :p] = np.eye(p)
    cross = gram @ N.T
    X = np.asarray(np.linalg.solve(N @ cross, cross.T).T, dtype=np.float64)  # (lags w, n + p)

    late = _by_predictor(states, X[:length].reshape(steps, width, -1))
    early = _by_predictor(states, X[width:].reshape(steps, width, -1))
    slope = np.zeros((n + m, n + p, m, length + p))
    slope[:n, :, :, :length] = late
    slope[:, :, :, :length] -= np.tensordot(ABCD[:, :n], early, axes=1)
    of_outputs = np.vstack([states.of_past[:, p:width], np.eye(m)])  # of y(k) on x(k+1) and y(k)
    regressors = np.vstack([X[width:], X[:p]])
    slope += np.einsum("ai,qb->abiq", of_outputs, regressors)
    return slope


def _by_predictor(states: States, X: Array) -> Array:
    """Return the slope (n, b, m, s w) of of_past X by the past of theta, for X (s, w, b)."""
    n, steps, m = states.of_predictor.shape
    width, b = X.shape[1:]
    moved = np.zeros((steps, steps, n, m))  # from theta's lag to the lag of the past
    for lag in range(steps):
        moved[lag:, lag] = states.of_predictor[:, : steps - lag].transpose(1, 0, 2)
    flat = moved.reshape(steps, steps, -1).transpose(0, 2, 1)
    out = flat @ X.reshape(steps, -1)
    return np.asarray(
        out.reshape(steps, n, m, width, b).transpose(1, 4, 2, 0, 3).reshape(n, b, m, -1)
    )
