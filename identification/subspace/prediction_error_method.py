"""Refine state-space models by the prediction-error method, with the covariance of the result.

Ljung, *System Identification*, 1999, ch. 7: the parameters minimise the determinant of the
covariance of the errors. An output-error model simulates. Its errors may be coloured: the estimate
is consistent all the same, and its covariance is that for errors with the spectrum of an
autoregression fitted to each output's. An innovation model predicts one step ahead from inputs and
outputs; its prediction is the output of the stable system A - K C with the inputs [u, y], so both
are fitted by one search.

The search takes only directions that change the response (`local_coordinates`). Offsets of the
outputs and initial states are eliminated from each record by QR (variable projection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from ...model.second_order import StateSpace
from ..nonparametric.block_qr import triangle
from ..records.record import Record
from .local_coordinates import moved, normalised, response_directions
from .simulation import InnovationModel, free_response, simulate, spectral_radius

Array = NDArray[np.float64]

_MOST_STEPS = 30
_TRIAL_STEPS = 6
"""Steps of a trial, which compares starts or orders: the first few gain nearly all."""
_ROUNDS = 4
"""Refinements of the weights of the outputs: the inverse covariance of the errors."""
_CONVERGED = 0.01
"""Decrease of the sum of squares, in noise variances, below which a search ends: a step of a tenth
of a standard error."""
_NOISE_SETTLED = 0.01
"""Change of the log determinant of the error covariance, per output, below which rounds end."""
_DAMPINGS = (0.0, 1e-6, 1e-4, 1e-2, 1.0, 1e2)
"""Levenberg-Marquardt damping of the trials of a step, relative to the columns' squares."""
_LONGEST_FILTER = 20
_EXACT = 1e-14
"""Least error variance relative to the output's: below, the errors are rounding."""
_CHUNK = 512


@dataclass(frozen=True)
class RefinedModel:
    """A model at the minimum of the criterion.

    `covariance` (n + m, n + p, n + m, n + p) is the error covariance of [A B; C D], of rank
    n (m + p) + m p: changes of coordinates are no errors. `error_covariance` (m, m) is that of the
    errors. `criterion` is the log determinant of the latter, over all `rows`. `steps` were taken;
    `converged` is False if the search ended before the minimum.
    """

    model: StateSpace
    covariance: Array
    error_covariance: Array
    criterion: float
    rows: int
    steps: int
    converged: bool


@dataclass(frozen=True)
class _Data:
    """Scaled records: inputs (N, p) and outputs (N, m) of each, and the scales."""

    inputs: tuple[Array, ...]
    outputs: tuple[Array, ...]
    input_scale: Array
    output_scale: Array
    direct: NDArray[np.bool_]
    """Inputs (p,) that may act on the outputs without a delay."""


@dataclass(frozen=True)
class _Noise:
    """Covariance of the errors: `whitener` (m, m) mixes the outputs to unit covariance."""

    whitener: Array
    log_determinant: float

    def whitened(self, columns: Array) -> Array:
        """Return columns (N, m, c) mixed to unit covariance."""
        return np.asarray(self.whitener @ columns)


def refine_output_error(
    start: StateSpace, records: Sequence[Record], trial: bool = False
) -> RefinedModel | None:
    """Return the model of start's order that simulates the records best, from their inputs alone.

    The start is stable, and so is the result. A `trial` takes a few steps, and its covariance is
    zero. None: the search fails.
    """
    data = _scaled([r.v for r in records], [r.y for r in records], records[0].v.shape[1])
    result = _search(start, data, coloured=True, trial=trial)
    return None if result is None else _with_covariance(*result)


def refine_innovations(
    start: InnovationModel, records: Sequence[Record], trial: bool = False
) -> tuple[InnovationModel, RefinedModel] | None:
    """Return the model of start's order that predicts the records best one step ahead.

    The second value describes its A, B, C, D. It is consistent for records of an unknown feedback
    loop and for unstable systems, if the noise is as the model says. A `trial` takes a few steps,
    and its covariance is zero. None: the search fails.
    """
    inputs = [np.hstack([r.v, r.y]) for r in records]
    p = records[0].v.shape[1]
    at_once = p if all(r.direct for r in records) else 0
    data = _scaled(inputs, [r.y for r in records], at_once)
    result = _search(start.predictor(), data, coloured=False, trial=trial)
    if result is None:
        return None
    found, directions, covariance = result
    predictor = found.model
    n, m = len(predictor.A), len(predictor.C)
    B, K, D = predictor.B[:, :p], predictor.B[:, p:], predictor.D[:, :p]
    C = predictor.C
    model = StateSpace(predictor.A + K @ C, B + K @ D, C, D, predictor.Ts_s)
    # The same map to first order, for each direction.
    dA, dB, dK = directions[:, :n, :n], directions[:, :n, n : n + p], directions[:, :n, n + p :]
    dC, dD = directions[:, n:, :n], directions[:, n:, n : n + p]
    mapped = np.zeros((len(directions), n + m, n + p))
    mapped[:, :n, :n] = dA + dK @ C + K @ dC
    mapped[:, :n, n:] = dB + dK @ D + K @ dD
    mapped[:, n:, :n], mapped[:, n:, n:] = dC, dD
    refined = _with_covariance(replace(found, model=model), mapped, covariance)
    return InnovationModel(model, K, found.error_covariance), refined


def _with_covariance(found: RefinedModel, directions: Array, covariance: Array) -> RefinedModel:
    shape = directions.shape[1:]
    flat = directions.reshape(len(directions), shape[0] * shape[1])
    return replace(found, covariance=(flat.T @ covariance @ flat).reshape(*shape, *shape))


def _scaled(inputs: Sequence[Array], outputs: Sequence[Array], direct: int) -> _Data:
    """Divide signals by their standard deviation; the first `direct` inputs act at once."""
    scales = []
    for signals in (inputs, outputs):
        size = np.sqrt(np.mean([np.var(s, axis=0) for s in signals], axis=0))
        scales.append(np.where(size > 0.0, size, 1.0))
    return _Data(
        tuple(s / scales[0] for s in inputs),
        tuple(s / scales[1] for s in outputs),
        scales[0],
        scales[1],
        np.arange(inputs[0].shape[1]) < direct,
    )


def initial_state_and_offset(model: StateSpace, u: Array, y: Array) -> tuple[Array, Array]:
    """Return the initial state (n,) and output offset (m,) that simulate y (N, m) best.

    Least squares of the errors, each output divided by its standard deviation.
    """
    n, m = len(model.A), len(model.C)
    weight = 1.0 / np.maximum(y.std(axis=0), np.finfo(float).tiny)
    error = (y - simulate(model, u)) * weight
    unknown = np.concatenate(
        [free_response(model, len(u)), np.broadcast_to(np.eye(m), (len(u), m, m))], axis=2
    )
    flat = (unknown * weight[:, None]).reshape(-1, n + m)
    fitted = np.linalg.lstsq(flat, error.reshape(-1), rcond=None)[0]
    return fitted[:n], fitted[n:]


def _search(
    start: StateSpace, data: _Data, coloured: bool, trial: bool
) -> tuple[RefinedModel, Array, Array] | None:
    """Return the refined model in the data's units, its directions, and their covariance.

    directions (r, n + m, n + p) are changes of [A B; C D], covariance (r, r) of their factors.
    """
    if spectral_radius(start.A) >= 1.0:
        return None
    try:
        return _from_start(start, data, coloured, trial)
    except np.linalg.LinAlgError:  # data or a model of inf, nan or no rank
        return None


def _from_start(
    start: StateSpace, data: _Data, coloured: bool, trial: bool
) -> tuple[RefinedModel, Array, Array]:
    model = normalised(
        replace(
            start,
            B=start.B * data.input_scale,
            C=start.C / data.output_scale[:, None],
            D=start.D * data.input_scale / data.output_scale[:, None],
        )
    )
    errors = [_errors(model, u, y) for u, y in zip(data.inputs, data.outputs, strict=True)]
    noise = _noise(errors)
    steps, converged = 0, False
    for _ in range(1 if trial else _ROUNDS):
        model, taken, converged = _minimise(model, data, noise, trial)
        steps += taken
        errors = [_errors(model, u, y) for u, y in zip(data.inputs, data.outputs, strict=True)]
        before, noise = noise, _noise(errors)
        if abs(before.log_determinant - noise.log_determinant) < _NOISE_SETTLED * len(model.C):
            break
    model = normalised(model)
    rows = sum(len(y) for y in data.outputs)
    none = np.zeros((0, *np.add(model.D.shape, len(model.A))))
    directions = none if trial else response_directions(model, data.direct)
    covariance = np.zeros((0, 0))
    if not trial:
        filters = _whitening_filters(errors) if coloured else None
        covariance = _covariance(model, data, noise, directions, filters)
    unscaled_rows = np.concatenate([np.ones(len(model.A)), data.output_scale])
    unscaled_columns = np.concatenate([np.ones(len(model.A)), 1.0 / data.input_scale])
    directions = directions * unscaled_rows[:, None] * unscaled_columns
    error_scale = np.outer(data.output_scale, data.output_scale)
    whitened = np.linalg.inv(noise.whitener)
    found = RefinedModel(
        replace(
            model,
            B=model.B / data.input_scale,
            C=model.C * data.output_scale[:, None],
            D=model.D / data.input_scale * data.output_scale[:, None],
        ),
        np.zeros(0),
        whitened @ whitened.T * error_scale,
        noise.log_determinant + 2.0 * float(np.log(data.output_scale).sum()),
        rows,
        steps,
        converged,
    )
    return found, directions, covariance


def _covariance(
    model: StateSpace,
    data: _Data,
    noise: _Noise,
    directions: Array,
    filters: Sequence[Array] | None,
) -> Array:
    """Return the error covariance (r, r) of the factors of the directions at a minimum.

    `filters` are autoregressions that whiten the errors of each output; None: they are white. For
    coloured errors with covariance S it is inv(J'J) J' S J inv(J'J).
    """
    R = _reduced(model, data, noise, directions)
    r = len(directions)
    samples = sum(len(y) for y in data.outputs) * len(model.C)
    eliminated = len(data.outputs) * (len(model.A) + len(model.C))
    freedom = max(samples - r - eliminated, 1)
    inverse = np.linalg.pinv(R[:r, :r], rcond=1e-10)
    if filters is None:
        return np.asarray(float(R[r, r] ** 2) / freedom * (inverse @ inverse.T))
    n, m = len(model.A), len(model.C)
    parts = []
    for u, y in zip(data.inputs, data.outputs, strict=True):
        columns = noise.whitened(_columns(model, u, y, directions))
        flat = columns.reshape(len(y) * m, -1)
        known = np.linalg.qr(flat[:, : n + m])[0]
        J = flat[:, n + m : n + m + r]
        J = (J - known @ (known.T @ J)).reshape(len(y), m, r)
        # With errors e = w / filter(q), J' S J is the square of J filtered backwards in time.
        weighted = noise.whitener.T @ J
        for i, taps in enumerate(filters):
            weighted[:, i] = lfilter([1.0], taps, weighted[::-1, i], axis=0)[::-1]
        parts.append(weighted)
    white = [
        np.column_stack([lfilter(t, [1.0], e[:, i]) for i, t in enumerate(filters)])
        for e in (_errors(model, u, y) for u, y in zip(data.inputs, data.outputs, strict=True))
    ]
    driving = np.concatenate(white)
    lower = np.linalg.cholesky(driving.T @ driving * (m / freedom) + _EXACT * np.eye(m))
    half = triangle([(lower.T @ part).reshape(-1, r) for part in parts])
    shaped = half @ inverse @ inverse.T
    return np.asarray(shaped.T @ shaped)


def _minimise(
    model: StateSpace, data: _Data, noise: _Noise, trial: bool
) -> tuple[StateSpace, int, bool]:
    """Take Gauss-Newton steps until one would be below a tenth of a standard error."""
    squares = _sum_of_squares(model, data, noise)
    most = _TRIAL_STEPS if trial else _MOST_STEPS
    for step in range(most):
        model = normalised(model)
        directions = response_directions(model, data.direct)
        R = _reduced(model, data, noise, directions)
        r = len(directions)
        if float(np.sum(R[:r, r] ** 2)) < _CONVERGED:
            return model, step, True
        size = np.maximum(np.linalg.norm(R[:r, :r], axis=0), np.finfo(float).tiny)
        for damping in _DAMPINGS:
            stacked = np.vstack([R[:r, :r] / size, np.sqrt(damping) * np.eye(r)])
            target = np.concatenate([R[:r, r], np.zeros(r)])
            # The errors fall along minus their derivative.
            move = -np.linalg.lstsq(stacked, target, rcond=1e-10)[0] / size
            candidate = moved(model, np.tensordot(move, directions, 1))
            if spectral_radius(candidate.A) >= 1.0:
                continue
            found = _sum_of_squares(candidate, data, noise)
            if found < squares:
                gained, model, squares = squares - found, candidate, found
                break
        else:
            return model, step, False
        if gained < _CONVERGED:  # a model of too high an order: directions that hardly matter
            return model, step + 1, True
    return model, most, False


def _errors(model: StateSpace, u: Array, y: Array) -> Array:
    """Return the errors (N, m) of a simulation with offset and initial state fitted."""
    start, offset = initial_state_and_offset(model, u, y)
    return np.asarray(y - simulate(model, u, start) - offset)


def _noise(errors: Sequence[Array]) -> _Noise:
    """Estimate the covariance of the errors (N, m) of all records."""
    stacked = np.concatenate(errors)
    m = stacked.shape[1]
    lower = np.linalg.cholesky(stacked.T @ stacked / len(stacked) + _EXACT * np.eye(m))
    return _Noise(np.linalg.inv(lower), 2.0 * float(np.log(np.diag(lower)).sum()))


def _whitening_filters(errors: Sequence[Array]) -> list[Array]:
    """Return the filter of each output's errors."""
    return [_whitening_filter([e[:, i] for e in errors]) for i in range(errors[0].shape[1])]


def _whitening_filter(errors: Sequence[Array]) -> Array:
    """Return taps 1, a1, a2, ... that whiten the errors: an autoregression, of least AIC."""
    longest = min(_LONGEST_FILTER, min(map(len, errors)) // 20)
    rows = sum(map(len, errors))
    lags = np.zeros(longest + 1)
    for e in errors:
        centred = e - e.mean()
        lags += [centred[k:] @ centred[: len(e) - k] for k in range(longest + 1)]
    if lags[0] <= _EXACT * rows:
        return np.ones(1)
    best, taps = np.log(lags[0]), np.ones(1)
    for order in range(1, longest + 1):
        a = solve_toeplitz(lags[:order], lags[1 : order + 1])
        left = lags[0] - a @ lags[1 : order + 1]
        if left <= 0.0:
            break
        criterion = np.log(left) + 2.0 * order / rows
        if criterion < best:
            best, taps = criterion, np.concatenate([[1.0], -a])
    return taps


def _sum_of_squares(model: StateSpace, data: _Data, noise: _Noise) -> float:
    none = np.zeros((0, *np.add(model.D.shape, len(model.A))))
    with np.errstate(over="ignore", invalid="ignore"):
        R = _reduced(model, data, noise, none)
    last = float(R[0, 0] ** 2)
    return last if np.isfinite(last) else np.inf


def _reduced(model: StateSpace, data: _Data, noise: _Noise, directions: Array) -> Array:
    """Return the triangle (r + 1, r + 1) of the derivatives of the errors and the errors.

    Derivatives (r) are those along the directions; initial states and offsets are eliminated.
    """
    n, m = len(model.A), len(model.C)
    parts = []
    for u, y in zip(data.inputs, data.outputs, strict=True):
        columns = noise.whitened(_columns(model, u, y, directions))
        R = triangle([columns.reshape(len(y) * m, -1)])
        parts.append(R[n + m :, n + m :])
    return triangle(parts)


def _columns(model: StateSpace, u: Array, y: Array, directions: Array) -> Array:
    """Return (N, m, n + m + r + 1): minus the outputs' derivatives, and the errors.

    The derivatives are those by the initial state, by the offset, and along the directions.
    """
    n, m, r = len(model.A), len(model.C), len(directions)
    identity = replace(model, C=np.eye(n), D=np.zeros((n, u.shape[1])))
    x = simulate(identity, u)
    out = np.zeros((len(y), m, n + m + r + 1))
    out[:, :, :n] = -free_response(model, len(y))
    out[:, :, n : n + m] = -np.eye(m)
    out[:, :, -1] = y - x @ model.C.T - u @ model.D.T
    if r:
        z = np.hstack([x, u])
        force = np.ascontiguousarray(directions[:, :n].transpose(1, 0, 2).reshape(n * r, -1).T)
        direct = directions[:, n:].transpose(1, 0, 2).reshape(m * r, -1).T
        state = np.zeros((n, r))
        for k in range(0, len(y), _CHUNK):
            rows = slice(k, min(k + _CHUNK, len(y)))
            forced = (z[rows] @ force).reshape(-1, n, r)
            at_once = (z[rows] @ direct).reshape(-1, m, r)
            _propagate(model.A, model.C, forced, at_once, state, out[rows, :, n + m : n + m + r])
    return out


@njit(cache=True, nogil=True)
def _propagate(A, C, forced, at_once, state, out):  # type: ignore[no-untyped-def]
    """Fill out (rows, m, r) with minus C S + at_once, where S(k+1) = A S + forced; update S."""
    n, r = state.shape
    m = len(C)
    following = np.empty((n, r))
    for k in range(len(forced)):
        for i in range(m):
            for d in range(r):
                out[k, i, d] = -at_once[k, i, d]
            for j in range(n):
                c = C[i, j]
                for d in range(r):
                    out[k, i, d] -= c * state[j, d]
        for i in range(n):
            for d in range(r):
                following[i, d] = forced[k, i, d]
            for j in range(n):
                a = A[i, j]
                for d in range(r):
                    following[i, d] += a * state[j, d]
        state[:] = following
