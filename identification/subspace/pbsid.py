"""The plant straight from its input and output in the loop: predictor-based subspace (PBSID).

Chiuso, "The role of vector autoregressive modeling in predictor-based subspace identification",
Automatica 43 (2007) 1034. Feedback does no harm: the first step is a predictor, and the delay
keeps the innovation out of the input. The controller need not be known.
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
from .ho_kalman import SINGULAR_VALUES, OrderChoice, Scaling, order_from_gap
from .pbsid_covariance import States, covariance_of_equations
from .plant_from_loop import IdentifiedPlant

Array = NDArray[np.float64]

PAST_S, LEAST_PAST, MOST_PAST = 0.08, 24, 160
"""The predictor's past: so many seconds, but no fewer and no more than these samples.

20 to 40 ms suffice at 1 kHz, 16 ms at 10 kHz: longer pasts cost time and change nothing.
"""
ROUNDING = 1e-14
"""Added to the diagonal of scaled Gram matrices, so that data without noise can be solved too."""


@dataclass(frozen=True)
class ScaledEstimate:
    """An estimate in scaled signals: [A B; C D] in one, and the regressions it comes from.

    `signals` z = [u, y] (N, p + m) of each record, `gram` of [z(k), ..., z(k-s)] over all of them,
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

    `innovation_covariance` (m, m): of the one-step prediction error, in units of the outputs.
    `past`: the samples that the predictor looks back. `found` and `unit` are what the covariance is
    made from: the estimate in scaled signals, and what 1 there is of each entry of [A B; C D].
    """

    plant: IdentifiedPlant
    order: OrderChoice
    singular_values: Array
    innovation_covariance: Array
    past: int
    found: ScaledEstimate
    unit: Array

    @cached_property
    def covariance(self) -> Array:
        """Covariance (n + m, n + p, n + m, n + p) of [A B; C D] of the core, to first order.

        It goes with the states' basis; poles and responses, which do not depend on that, have their
        errors from it (model_response). Made when asked for: it takes as long as the estimate.
        """
        f = self.found
        with threadpool_limits(1, "blas"):
            scaled = covariance_of_equations(f.signals, f.gram, f.theta, f.states, f.ABCD)
        return np.asarray(scaled * self.unit[:, :, None, None] * self.unit)


def plant_by_subspace(
    records: Sequence[Record],
    order: int | None = None,
    lag_pole: float = 0.0,
    past: int | None = None,
    least_order: int = 1,
) -> SubspaceEstimate:
    """Identify P from plant input and output of all records at once.

    The known delay and lag are put before the data, so that only the states of the core Q are left
    to find: six for the rig. `order` None takes the largest gap of the singular values from
    `least_order` on; `past` None the samples of PAST_S.

    Every regression here is one between lags of the same signals. Their Gram matrix is all that is
    taken from the data, so the time hardly grows with the records.

    Raises IdentificationError for records in a loop without plant input or known delay, records too
    short, inputs that cannot be told apart, or an order that is not there.
    """
    past = past or min(max(round(PAST_S / records[0].Ts_s), LEAST_PAST), MOST_PAST)
    seen = [_as_core_sees_it(r, lag_pole) for r in records]
    scaling = Scaling.of(seen)
    z = [np.hstack([r.v / scaling.inputs, r.y / scaling.outputs]) for r in seen]
    # Matrices of some hundred rows: several threads of BLAS only wait for each other there.
    with threadpool_limits(1, "blas"):
        found = _identify(z, past, len(scaling.inputs), order, least_order)
    n = found.order.order
    # What 1 in scaled signals is of every entry of [A B; C D] in the signals' units.
    unit = np.append(np.ones(n), scaling.outputs)[:, None] / np.append(np.ones(n), scaling.inputs)
    ABCD = found.ABCD * unit
    core = StateSpace(ABCD[:n, :n], ABCD[:n, n:], ABCD[n:, :n], ABCD[n:, n:], records[0].Ts_s)
    return SubspaceEstimate(
        IdentifiedPlant(core, records[0].leading_zeros, lag_pole),
        found.order,
        found.singular_values,
        found.innovation * scaling.outputs[:, None] * scaling.outputs,
        past,
        found,
        unit,
    )


def _identify(
    z: Sequence[Array], past: int, p: int, order: int | None, least_order: int
) -> ScaledEstimate:
    """Identify the core from z (N, p + m), the scaled inputs and outputs of each record."""
    grams = grams_of_lags(z, past)
    gram = np.sum(grams, axis=0)
    predictor = _predictor(gram, p, z[0].shape[1])
    singular_values, to_states = _states(gram, predictor, p)
    choice = order_from_gap(singular_values, least_order)
    if order is not None:
        if not 1 <= order <= len(singular_values):
            raise IdentificationError(
                f"expected an order of 1 to {len(singular_values)}, found {order}"
            )
        gap = choice.gaps[order - 1] if order <= len(choice.gaps) else np.nan
        choice = OrderChoice(order, float(gap), choice.gaps)
    states = to_states.first(choice.order)
    ABCD = _state_equations(gram, states.of_past, p, len(predictor.theta))
    freedom = sum(len(part) - past - 1 for part in z) - predictor.theta.shape[1]
    innovation = predictor.squares / freedom
    return ScaledEstimate(
        tuple(z), gram, predictor.theta, states, ABCD, choice, singular_values, innovation
    )


def grams_of_lags(signals: Sequence[Array], lags: int) -> list[Array]:
    """Return sum_k f(k) f(k)^T of f(k) = [z(k), z(k-1), ..., z(k-lags)] for each record z (N, w).

    k runs over the rows whose past is known, and the mean of f over the record is taken out. Each
    is ((lags + 1) w) square. Raises IdentificationError for records with too few rows for that.
    """
    width = signals[0].shape[1]
    size = (lags + 1) * width
    if sum(len(z) - lags for z in signals) < 2 * size or min(map(len, signals)) <= 2 * lags:
        raise IdentificationError(
            f"expected records of at least {2 * size} rows in all and {2 * lags} each for a "
            f"predictor with a past of {lags}, found {', '.join(str(len(z)) for z in signals)}"
        )
    return [_gram(z, lags) for z in signals]


def _gram(z: Array, lags: int) -> Array:
    N, width = z.shape
    S = np.empty((lags + 1, lags + 1, width, width))
    S[0] = _lagged_products(z, lags)
    S[:, 0] = S[0].transpose(0, 2, 1)
    # One lag more on both sides: one row comes in at the front, one goes at the end.
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
        late = part.copy()
        late[:lags] = 0.0
        ours, theirs = fft.rfft(late, size, axis=0), fft.rfft(part, size, axis=0)
        total += ours[:, :, None] * theirs[:, None, :].conj()
    return np.asarray(fft.irfft(total, size, axis=0)[: lags + 1])


def _as_core_sees_it(record: Record, lag_pole: float) -> Record:
    """Return the record with v what enters the core Q: the input, lagged, at the row it acts on."""
    if record.controller is not None and (record.u is None or record.leading_zeros == 0):
        missing = "the plant input" if record.u is None else "a known delay"
        raise IdentificationError(f"record '{record.name}': expected {missing}, found none")
    u = record.v if record.u is None else record.u
    # What the lag was before the first row is forgotten within the predictor's past.
    lagged = signal.lfilter([1.0 - lag_pole], [1.0, -lag_pole], u - u[0], axis=0)
    delay = record.leading_zeros
    return replace(record, v=lagged[: len(u) - delay], y=record.y[delay:], u=None, asked=None)


@dataclass(frozen=True)
class _Predictor:
    """y(k) by theta (m, s (p + m) + p) from past inputs and outputs and the present input.

    `squares` (m, m) are those of the innovation, what it leaves; `weight` makes that white.
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
    """Return singular values (k,) of what the past says of the future, and the states it makes.

    The future's rows see ever less of the past, the predictor being zero beyond its length. States
    have the size sqrt(singular value).
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
    """Return [A B; C D]: x(k + 1) and y(k) regressed on x(k) and the input."""
    n, length = to_states.shape
    now, then = np.zeros((2, n, len(gram)))
    now[:, len(gram) - length :] = to_states
    then[:, :length] = to_states
    pick = np.eye(len(gram))
    right = np.vstack([now, pick[:p]])
    left = np.vstack([then, pick[p : p + m]])
    return _regression(right @ gram @ right.T, left @ gram @ right.T)


def _regression(normal: Array, across: Array) -> Array:
    """Return across normal^-1, scaled so that units do not matter."""
    size = np.sqrt(np.diag(normal))
    if np.any(size == 0):
        raise IdentificationError(
            "expected every input and output to move, found one that does not"
        )
    scaled = normal / size / size[:, None]
    scaled[np.diag_indices_from(scaled)] += len(scaled) * ROUNDING
    try:
        factor = cho_factor(scaled)
    except np.linalg.LinAlgError:
        raise IdentificationError(
            "expected inputs and outputs that are independent, found some that follow from others"
        ) from None
    return np.asarray(cho_solve(factor, (across / size).T).T / size)
