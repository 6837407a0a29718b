"""Fit the equation of motion itself: the force balance of band-limited derivatives of the records.

M q'' + D q' + K q + constant = B u is a regression in the signals and their derivatives, without an
initial state or a model of the noise. A zero-phase low-pass limits noise, which the derivatives
amplify. Noise in the regressors biases least squares; instrumental variables remove that bias: the
same regressors of simulated or predicted outputs (Janot, Vandanjon and Gautier, *A generic
instrumental variable approach for industrial robot identification*, IEEE Trans. Control Syst.
Technol. 22, 2014). A plant may be unstable, and its controller unknown. If the model lacks
something, the estimate depends on the band and on the order of the equation: the intervals cover
both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import DeclaredModel
from ...records.record import IdentificationError
from ...subspace.response_uncertainty import SURE_95
from ..experiment.experiment_from_log import Experiment
from ..experiment.intersample_input import Hold
from .band_limited_signals import (
    BAND_STEPS,
    SHORTEST_ROWS,
    BandLimited,
    middle_limit,
    upper_limit,
)

Array = NDArray[np.float64]

_BLOCKS = 25
_STEPS = 25
_CONVERGED = 1e-5
"""Largest step, relative to a parameter's scale, that ends a search."""
_DELAYS = (-2.0, -1.0, 1.0, 2.0, 4.0)
"""Delays in rows, beside the model's own, from which a search starts."""
_HALF_STEP = 1e-4
"""Half step of the central differences, as a share of a parameter's scale."""


@dataclass(frozen=True)
class ForceBalance:
    """Parameters fitted to the force balance, and the force that it leaves.

    values (F,) are those of the middle band, half_width (F,) half of the 95 % interval. The
    interval covers chance (se, from blocks of the records) and the largest change by another band
    (by_band (3, F), upper limits band_hz (3,)) or by an equation of one order more (by_order (F,)).
    percent (n,): residual force over input force, RMS without the mean, of each DOF.
    """

    names: tuple[str, ...]
    values: Array
    half_width: Array
    se: Array
    band_hz: Array
    by_band: Array
    by_order: Array
    percent: Array

    def as_values(self) -> dict[str, float]:
        """Return the parameters by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))


@dataclass(frozen=True)
class _Bounds:
    low: Array
    high: Array
    scale: Array


def fit_force_balance(
    model: DeclaredModel,
    experiments: Sequence[Experiment],
    hold: Hold,
    names: Sequence[str],
    bounds: tuple[Array, Array, Array],
    instruments: Sequence[Experiment],
) -> ForceBalance:
    """Fit the parameters `names` from the model's values; bounds are low, high and scale (F,).

    `instruments` are the experiments with outputs and inputs that do not contain the noise of the
    same rows. Raises IdentificationError for records that are too short for the band, or whose
    schedule moves.
    """
    limits = _Bounds(*bounds)
    highest = min(upper_limit(e, hold) for e in experiments)
    band_hz = np.array([highest / divisor for divisor in BAND_STEPS])
    middle = len(band_hz) // 2
    pairs = [
        (_signals(experiments, hold, fc), _signals(instruments, hold, fc))
        for fc in band_hz.tolist()
    ]
    fits = [_fit(model, *pair, names, limits) for pair in pairs]
    values, se = fits[middle]
    records = pairs[middle][0]
    at = model.with_values(dict(zip(names, values.tolist(), strict=True)))
    more, _ = _fit(at, *pairs[middle], names, limits, extra=True)
    by_band = np.array([found for found, _ in fits])
    spread = np.max(np.abs(np.vstack([by_band, more]) - values), axis=0)
    return ForceBalance(
        tuple(names), values, np.hypot(SURE_95 * se, spread), se, band_hz, by_band, more,
        _percent(at, records),
    )  # fmt: skip


def force_percent(model: DeclaredModel, experiments: Sequence[Experiment], hold: Hold) -> Array:
    """Return the residual force over the input force (n,) in per cent, in the middle band.

    It is nan for records that are too short, or whose schedule moves.
    """
    if any(e.moving or len(e.y) < SHORTEST_ROWS for e in experiments):
        return np.full(len(model.dof), np.nan)
    return _percent(model, _signals(experiments, hold, middle_limit(experiments, hold)))


def _signals(experiments: Sequence[Experiment], hold: Hold, cutoff_hz: float) -> list[BandLimited]:
    for e in experiments:
        if e.moving:
            raise IdentificationError(
                f"record '{e.name}': expected a constant schedule for the force balance, "
                "found motion"
            )
    return [BandLimited.of(e, hold, cutoff_hz) for e in experiments]


def _residuals(model: DeclaredModel, record: BandLimited) -> tuple[Array, Array]:
    """Return the residual force and the input force (rows, n), both without the mean."""
    at = model.at(record.schedule)
    q, qd, qdd, _ = record.kept_derivatives()
    force = record.input(max(at.delay_s, -record.own_delay_s), max(at.lag_s, 0.0)) @ at.B.T
    left = force - qdd @ at.M.T - qd @ at.D.T - q @ at.K.T
    return left - left.mean(axis=0), force - force.mean(axis=0)


def _percent(model: DeclaredModel, records: Sequence[BandLimited]) -> Array:
    pairs = [_residuals(model, record) for record in records]
    left, force = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(100.0 * left.std(axis=0) / force.std(axis=0))


def _fit(
    model: DeclaredModel,
    records: Sequence[BandLimited],
    instruments: Sequence[BandLimited],
    names: Sequence[str],
    bounds: _Bounds,
    extra: bool = False,
) -> tuple[Array, Array]:
    """Return values and standard errors (F,) by instrumental variables on the force residual.

    The instruments are its derivatives for the instruments' signals. The search starts from several
    delays, as the residual has local minima in a delay. `extra`: one derivative more of each
    output, with a free coefficient in each equation.
    """
    weight = 1.0 / np.maximum(_scale(model, records), np.finfo(float).tiny)

    def residual(at: Array, of: Sequence[BandLimited] = records) -> list[Array]:
        moved = model.with_values(dict(zip(names, at.tolist(), strict=True)))
        return [_residuals(moved, record)[0] * weight for record in of]

    nuisance = [_more(record) for record in records] if extra else None

    def jacobian(at: Array, of: Sequence[BandLimited]) -> Array:
        columns = [_column(partial(residual, of=of), at, i, bounds) for i in range(len(names))]
        return np.column_stack([_stacked(c, nuisance) for c in columns]) * bounds.scale

    best, least = np.zeros(0), np.inf
    for start in _starts(model, names, bounds, records[0].Ts_s):
        values = start
        for _ in range(_STEPS):
            r = _stacked(residual(values), nuisance)
            Q = np.linalg.qr(jacobian(values, instruments))[0]
            move = -np.linalg.lstsq(Q.T @ jacobian(values, records), Q.T @ r, rcond=1e-10)[0]
            before, values = values, np.clip(values + move * bounds.scale, bounds.low, bounds.high)
            if np.max(np.abs(values - before) / bounds.scale) < _CONVERGED:
                break
        left = _stacked(residual(values), nuisance)
        squares = float(left @ left)
        if squares < least:
            best, least = values, squares
    if not len(best):
        raise IdentificationError("its equations diverge for these records and start values")
    J, Z = jacobian(best, records), jacobian(best, instruments)
    return best, bounds.scale * _standard_errors(J, Z, _stacked(residual(best), nuisance))


def _starts(
    model: DeclaredModel, names: Sequence[str], bounds: _Bounds, Ts_s: float
) -> Iterator[Array]:
    """Yield starting values (F,): the model's, and those with other delays within the bounds."""
    values = np.array([model.values[name] for name in names])
    yield values
    for i, name in enumerate(names):
        if name in model.delay.names:
            for rows in _DELAYS:
                delay = values[i] + rows * Ts_s
                if bounds.low[i] <= delay <= bounds.high[i]:
                    moved = values.copy()
                    moved[i] = delay
                    yield moved


def _column(
    residual: Callable[[Array], list[Array]], values: Array, index: int, bounds: _Bounds
) -> list[Array]:
    step = np.zeros(len(values))
    step[index] = _HALF_STEP * bounds.scale[index]
    pairs = zip(residual(values + step), residual(values - step), strict=True)
    return [(high - low) / (2.0 * step[index]) for high, low in pairs]


def _more(record: BandLimited) -> Array:
    """Return an orthonormal basis of the third derivatives, without the mean."""
    third = record.kept_derivatives()[3]
    return np.asarray(np.linalg.qr(third - third.mean(axis=0))[0])


def _stacked(parts: Sequence[Array], nuisance: Sequence[Array] | None) -> Array:
    """Return the records' columns (rows, n) below each other, flat, free of the nuisance."""
    if nuisance is not None:
        parts = [part - Q @ (Q.T @ part) for part, Q in zip(parts, nuisance, strict=True)]
    return np.concatenate([part.reshape(-1) for part in parts])


def _scale(model: DeclaredModel, records: Sequence[BandLimited]) -> Array:
    left = np.concatenate([_residuals(model, record)[0] for record in records])
    return np.asarray(left.std(axis=0))


def _standard_errors(J: Array, Z: Array, r: Array) -> Array:
    """Return standard errors (F,) from sums over blocks: the residuals within one are dependent.

    J are the derivatives of the residuals r, Z those of the instruments.
    """
    Q = np.linalg.qr(Z)[0]
    inverse = np.linalg.pinv(Q.T @ J, rcond=1e-10)
    pieces = zip(np.array_split(Q, _BLOCKS), np.array_split(r, _BLOCKS), strict=True)
    scores = np.array([part.T @ left for part, left in pieces])
    middle = scores.T @ scores * (_BLOCKS / (_BLOCKS - 1))
    return np.asarray(np.sqrt(np.diag(inverse @ middle @ inverse.T)))
