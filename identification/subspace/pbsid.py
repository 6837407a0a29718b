"""Identify the plant from closed-loop data by predictor-based subspace identification (PBSID).

Chiuso, "The role of vector autoregressive modeling in predictor-based subspace identification",
Automatica 43 (2007) 1034. Feedback does not bias the estimate: the first step is a predictor, and
because of the delay the input is uncorrelated with the innovation. The controller may be unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal
from scipy.linalg import cho_factor, cho_solve, eigh
from threadpoolctl import threadpool_limits

from ...model.second_order import StateSpace
from ..records.record import IdentificationError, Record
from .ho_kalman import SINGULAR_VALUES, OrderChoice, Scaling, order_from_ratio
from .pbsid_covariance import States, covariance_of_equations
from .plant_from_loop import IdentifiedPlant

Array = NDArray[np.float64]

PAST_S, MIN_PAST, MAX_PAST = 0.08, 24, 160
"""The predictor's past in s, and its limits in samples.

20 to 40 ms suffice at 1 kHz, 16 ms at 10 kHz; longer pasts cost time and change nothing.
"""
ROUNDING = 1e-14
"""Added to the diagonal of scaled Gram matrices, so that noise-free data can be solved."""


@dataclass(frozen=True)
class ScaledEstimate:
    """An estimate in scaled signals: [A B; C D] as one matrix, and its regressions.

    `signals` z = [u, y] (N, p + m) of each record, `gram` of [z(k), ..., z(k-s)] over all records;
    `theta` (m, s (p + m) + p) predicts y(k) from the past and the present input.
    """

    signals: tuple[Array, ...]
    gram: Array
    theta: Array
    states: States
    ABCD: Array
    order: OrderChoice
    singular_values: Array
    innovation: Array


@dataclass(frozen=True)
class SubspaceEstimate:
    """The plant, and the choice of its core's order by the singular values (k,), descending.

    `innovation_covariance` (m, m): of the one-step prediction error, in output units. `past`: the
    predictor's past in samples. The covariance follows from `scaled`, the estimate in scaled
    signals, and `scale`, which converts its [A B; C D] to the signals' units.
    """

    plant: IdentifiedPlant
    order: OrderChoice
    singular_values: Array
    innovation_covariance: Array
    past: int
    scaled: ScaledEstimate
    scale: Array

    @cached_property
    def covariance(self) -> Array:
        """Covariance (n + m, n + p, n + m, n + p) of the core's [A B; C D], to first order.

        It depends on the basis of the states; the errors of poles and responses that follow from it
        (response_uncertainty) do not. Computed on first use: it takes as long as the estimate.
        """
        f = self.scaled
        with threadpool_limits(1, "blas"):
            scaled = covariance_of_equations(f.signals, f.gram, f.theta, f.states, f.ABCD)
        return np.asarray(scaled * self.scale[:, :, None, None] * self.scale)


def plant_by_subspace(
    records: Sequence[Record],
    order: int | None = None,
    lag_pole: float = 0.0,
    past: int | None = None,
    least_order: int = 1,
) -> SubspaceEstimate:
    """Identify P from plant input and output of all records together.

    The known delay and lag are applied to the input first, so that only the states of the core Q
    remain: six for the rig. `order` None chooses the largest ratio of singular values from
    `least_order` on; `past` None uses PAST_S.

    All regressions use lags of the same signals, so the data enter through one Gram matrix, and the
    computing time hardly grows with the records.

    Raises IdentificationError for closed-loop records without plant input or known delay, records
    that are too short, dependent inputs, or an order out of range.
    """
    past = past or min(max(round(PAST_S / records[0].Ts_s), MIN_PAST), MAX_PAST)
    core_records = [_core_signals(r, lag_pole) for r in records]
    scaling = Scaling.of(core_records)
    z = [np.hstack([r.v / scaling.inputs, r.y / scaling.outputs]) for r in core_records]
    # Matrices of a few hundred rows: several BLAS threads would only wait for each other.
    with threadpool_limits(1, "blas"):
        scaled = _identify(z, past, len(scaling.inputs), order, least_order)
    n = scaled.order.order
    # Converts [A B; C D] of scaled signals to the signals' units.
    scale = np.append(np.ones(n), scaling.outputs)[:, None] / np.append(np.ones(n), scaling.inputs)
    ABCD = scaled.ABCD * scale
    core = StateSpace(ABCD[:n, :n], ABCD[:n, n:], ABCD[n:, :n], ABCD[n:, n:], records[0].Ts_s)
    return SubspaceEstimate(
        IdentifiedPlant(core, records[0].leading_zeros, lag_pole),
        scaled.order,
        scaled.singular_values,
        scaled.innovation * scaling.outputs[:, None] * scaling.outputs,
        past,
        scaled,
        scale,
    )


def _identify(
    z: Sequence[Array], past: int, p: int, order: int | None, least_order: int
) -> ScaledEstimate:
    """Identify the core from scaled inputs and outputs z (N, p + m) of each record."""
    grams = grams_of_lags(z, past)
    gram = np.sum(grams, axis=0)
    predictor = _predictor(gram, p, z[0].shape[1])
    singular_values, to_states = _states(gram, predictor, p)
    choice = order_from_ratio(singular_values, least_order)
    if order is not None:
        if not 1 <= order <= len(singular_values):
            raise IdentificationError(
                f"expected an order of 1 to {len(singular_values)}, found {order}"
            )
        ratio = choice.ratios[order - 1] if order <= len(choice.ratios) else np.nan
        choice = OrderChoice(order, float(ratio), choice.ratios)
    states = to_states.first(choice.order)
    ABCD = _state_equations(gram, states.of_past, p, len(predictor.theta))
    freedom = sum(len(part) - past - 1 for part in z) - predictor.theta.shape[1]
    innovation = predictor.squares / freedom
    return ScaledEstimate(
        tuple(z), gram, predictor.theta, states, ABCD, choice, singular_values, innovation
    )


def grams_of_lags(signals: Sequence[Array], lags: int) -> list[Array]:
    """Return sum_k f(k) f(k)^T of f(k) = [z(k), z(k-1), ..., z(k-lags)] for each record z (N, w).

    k runs over the rows with a complete past; the mean of f over the record is subtracted. Each
    matrix has (lags + 1) w rows. Raises IdentificationError for records that are too short.
    """
    width = signals[0].shape[1]
    size = (lags + 1) * width
    if sum(len(z) - lags for z in signals) < 2 * size or min(map(len, signals)) <= 2 * lags:
        raise IdentificationError(
            f"a predictor with a past of {lags} samples: expected records of more than {2 * lags} "
            f"rows each and {2 * size} in all, found {', '.join(str(len(z)) for z in signals)}"
        )
    return [_gram(z, lags) for z in signals]


def _gram(z: Array, lags: int) -> Array:
    N, width = z.shape
    S = np.empty((lags + 1, lags + 1, width, width))
    S[0] = _lagged_products(z, lags)
    S[:, 0] = S[0].transpose(0, 2, 1)
    # With one more lag on both sides, one row enters at the front and one leaves at the end.
    head, tail = z[lags - 1 :: -1], z[N - 1 : N - lags - 1 : -1]
    for a in range(lags):
        S[a + 1, 1:] = S[a, :-1]
        S[a + 1, 1:] += head[a][:, None] * head[:, None, :] - tail[a][:, None] * tail[:, None, :]
    sums = np.concatenate([np.zeros((1, width)), np.cumsum(z, axis=0)])
    lag = np.arange(lags + 1)
    sum_of_f = (sums[N - lag] - sums[lags - lag]).ravel()
    products = S.transpose(0, 2, 1, 3).reshape(len(sum_of_f), -1)
    return np.asarray(products - np.outer(sum_of_f, sum_of_f) / (N - lags))


def _lagged_products(z: Array, lags: int) -> Array:
    """Return sum_k z(k) z(k-b)^T over k = lags..N-1 as (b = 0..lags, w, w), by FFT in blocks."""
    size = fft.next_fast_len(max(8 * lags, 1024), real=True)
    total = np.zeros((size // 2 + 1, z.shape[1], z.shape[1]), complex)
    for start in range(lags, len(z), size - lags):
        part = z[start - lags : start - lags + size]
        windowed = part.copy()
        windowed[:lags] = 0.0
        leading, full = fft.rfft(windowed, size, axis=0), fft.rfft(part, size, axis=0)
        total += leading[:, :, None] * full[:, None, :].conj()
    return np.asarray(fft.irfft(total, size, axis=0)[: lags + 1])


def _core_signals(record: Record, lag_pole: float) -> Record:
    """Return the record with the input of the core Q as v: lagged, and shifted by the delay."""
    if record.controller is not None and (record.u is None or record.leading_zeros == 0):
        missing = "the plant input" if record.u is None else "a known delay"
        raise IdentificationError(f"record '{record.name}': expected {missing}, found none")
    u = record.v if record.u is None else record.u
    # The lag's initial state decays within the predictor's past.
    lagged = signal.lfilter([1.0 - lag_pole], [1.0, -lag_pole], u - u[0], axis=0)
    delay = record.leading_zeros
    return replace(record, v=lagged[: len(u) - delay], y=record.y[delay:], u=None, u_unlimited=None)


@dataclass(frozen=True)
class _Predictor:
    """Predict y(k) by theta (m, s (p + m) + p) from past inputs and outputs and the present input.

    `squares` (m, m): sum of squares of the innovation; `weight` (m, m) whitens it.
    """

    theta: Array
    squares: Array
    weight: Array


def _predictor(gram: Array, p: int, width: int) -> _Predictor:
    inputs, outputs = np.arange(p), np.arange(p, width)
    regressors = np.concatenate([np.arange(width, len(gram)), inputs])
    theta = _regression(gram[np.ix_(regressors, regressors)], gram[np.ix_(outputs, regressors)])
    squares = gram[np.ix_(outputs, outputs)] - theta @ gram[np.ix_(regressors, outputs)]
    squares += ROUNDING * np.diag(gram[outputs, outputs])
    weight = np.linalg.inv(np.linalg.cholesky((squares + squares.T) / 2))
    return _Predictor(theta, squares, weight)


def _states(gram: Array, predictor: _Predictor, p: int) -> tuple[Array, States]:
    """Return singular values (k,) and states of the prediction of the future by the past.

    Later rows of the future use less of the past: the predictor is zero beyond its length. States
    have size sqrt(singular value).
    """
    m = len(predictor.theta)
    width = m + p
    past = len(gram) // width - 1
    weighted = (predictor.weight @ predictor.theta[:, : past * width]).reshape(m, past, width)
    future = np.zeros((past, m, past, width))
    for row in range(past):
        future[row, :, : past - row] = weighted[:, row:]
    H = future.reshape(past * m, past * width)
    count = min(SINGULAR_VALUES, len(H))
    squares, U = eigh(H @ gram[width:, width:] @ H.T, subset_by_index=(len(H) - count, len(H) - 1))
    squares, U = squares[::-1], U[:, ::-1]
    s = np.sqrt(np.maximum(squares, ROUNDING**2 * squares[0]))
    of_future = U / np.sqrt(s)
    weights = of_future.T.reshape(count, past, m) @ predictor.weight
    return s, States(of_future.T @ H, weights)


def _state_equations(gram: Array, to_states: Array, p: int, m: int) -> Array:
    """Return [A B; C D] by regression of x(k + 1) and y(k) on x(k) and the input."""
    n, length = to_states.shape
    now, shifted = np.zeros((2, n, len(gram)))
    now[:, len(gram) - length :] = to_states
    shifted[:, :length] = to_states
    pick = np.eye(len(gram))
    right = np.vstack([now, pick[:p]])
    left = np.vstack([shifted, pick[p : p + m]])
    return _regression(right @ gram @ right.T, left @ gram @ right.T)


def _regression(normal: Array, cross: Array) -> Array:
    """Return cross normal^-1, independent of units."""
    size = np.sqrt(np.diag(normal))
    if np.any(size == 0):
        raise IdentificationError("expected every input and output to vary, found a constant one")
    scaled = normal / size / size[:, None]
    scaled[np.diag_indices_from(scaled)] += len(scaled) * ROUNDING
    try:
        factor = cho_factor(scaled)
    except np.linalg.LinAlgError:
        raise IdentificationError(
            "expected linearly independent inputs and outputs, found some that depend on others"
        ) from None
    return np.asarray(cho_solve(factor, (cross / size).T).T / size)
