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

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import detrend, welch

from ...model.declared_model import DeclaredModel
from ..records.record import IdentificationError
from ..subspace.response_uncertainty import SURE_95
from .experiment_from_log import Experiment
from .intersample_input import Hold

Array = NDArray[np.float64]

_STEEPNESS = 8
"""Exponent of the low-pass 1 / (1 + (f/fc)^8): a Butterworth filter of fourth order both ways."""
_ABOVE_NOISE = 10.0
"""Ratio of an output's power density to its noise at the upper end of the band."""
_MOST_OF_RATE: dict[Hold, float] = {"zoh": 0.177, "foh": 0.24, "band_limited": 0.35}
"""Highest limit over the rate. At f the alias of a mass is (f / (rate - f))^3 with a zero-order
hold, which is 1 % at 0.177, and ^4 with a first-order hold. A band-limited input has none."""
_BAND_STEPS = (2.4, 1.55, 1.0)
"""The upper limits of the bands, as divisors of the highest."""
_EDGE = 2.0
"""Rows left out at each end of a record, in periods of the upper limit."""
_MOST_EDGE = 0.1
_BLOCKS = 25
_STEPS = 25
_CONVERGED = 1e-5
"""Largest step, relative to a parameter's scale, that ends a search."""
_DELAYS = (-2.0, -1.0, 1.0, 2.0, 4.0)
"""Delays in rows, beside the model's own, from which a search starts."""
_HALF_STEP = 1e-4
"""Half step of the central differences, as a share of a parameter's scale."""
_SHORTEST_ROWS = 50


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


@dataclass(frozen=True)
class _Signals:
    """One record in a band: derivatives 0 .. 3 of the outputs (rows, n), spectrum of the input."""

    derivatives: tuple[Array, ...]
    spectrum: NDArray[np.complex128]
    freq_hz: Array
    line: tuple[Array, Array]
    rows: slice
    before: int
    length: int
    hold: Hold
    Ts_s: float
    own_delay_s: float
    schedule: Mapping[str, float]

    def input(self, delay_s: float, lag_s: float) -> Array:
        """Return the filtered input (rows, p) after delay and lag, as the plant sees it."""
        f = self.freq_hz
        total_s = delay_s + self.own_delay_s
        shape = np.exp(-2j * np.pi * f * total_s) / (1.0 + 2j * np.pi * f * lag_s)
        shift_s = total_s + lag_s
        if self.hold == "zoh":
            shape = shape * np.sinc(f * self.Ts_s) * np.exp(-1j * np.pi * f * self.Ts_s)
            shift_s += 0.5 * self.Ts_s
        elif self.hold == "foh":
            shape = shape * np.sinc(f * self.Ts_s) ** 2
        u = irfft(self.spectrum * shape[:, None], self.length, axis=0)
        value, slope = self.line
        t = np.arange(self.length) * self.Ts_s - shift_s
        whole = u + value + slope * t[:, None]
        return np.asarray(whole[self.before :][self.rows])


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
    band_hz = np.array([highest / divisor for divisor in _BAND_STEPS])
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
    if any(e.moving or len(e.y) < _SHORTEST_ROWS for e in experiments):
        return np.full(len(model.dof), np.nan)
    highest = min(upper_limit(e, hold) for e in experiments)
    middle = _BAND_STEPS[len(_BAND_STEPS) // 2]
    return _percent(model, _signals(experiments, hold, highest / middle))


def upper_limit(experiment: Experiment, hold: Hold) -> float:
    """Return the frequency in Hz up to which every output is ten times above its noise.

    The noise is the least power density of the output. The limit is lower if the steps of a held
    input reach it: above half the rate a held input has images, of which the sampled outputs of a
    mass contain an alias. Below the limit it is at most 1 % of the output.
    """
    Ts_s, rows = experiment.Ts_s, len(experiment.y)
    if rows < _SHORTEST_ROWS:
        raise IdentificationError(
            f"record '{experiment.name}': expected at least {_SHORTEST_ROWS} rows, found {rows}"
        )
    segment = max(rows // 12, min(rows, _SHORTEST_ROWS))
    freq_hz, psd = welch(detrend(experiment.y, axis=0), 1 / Ts_s, nperseg=segment, axis=0)
    width = max(len(freq_hz) // 32, 1)
    kernel = np.ones(width) / width
    limit = _MOST_OF_RATE[hold] / Ts_s
    for density in psd[1:].T:
        smooth = np.convolve(density, kernel, mode="same")
        inside = smooth[width : len(smooth) - width] if len(smooth) > 4 * width else smooth
        above = smooth > _ABOVE_NOISE * inside.min()
        last = len(above) if above.all() else max(int(np.argmin(above)), 1)
        limit = min(limit, float(freq_hz[1:][last - 1]))
    return max(limit, 4.0 / (rows * Ts_s))


def _signals(experiments: Sequence[Experiment], hold: Hold, cutoff_hz: float) -> list[_Signals]:
    return [_of_record(e, hold, cutoff_hz) for e in experiments]


def _of_record(e: Experiment, hold: Hold, cutoff_hz: float) -> _Signals:
    if e.moving:
        raise IdentificationError(
            f"record '{e.name}': expected a constant schedule for the force balance, found motion"
        )
    Ts_s, rows = e.Ts_s, len(e.y)
    before = min(rows - 1, math.ceil(4.0 / (cutoff_hz * Ts_s)))
    length = next_fast_len(rows + 2 * before, real=True)
    freq_hz = rfftfreq(length, Ts_s)
    low_pass = 1.0 / (1.0 + (freq_hz / cutoff_hz) ** _STEEPNESS)
    y, line_y = _spectrum(e.y, before, length, Ts_s)
    u, line_u = _spectrum(e.u, before, length, Ts_s)
    edge = min(math.ceil(_EDGE / (cutoff_hz * Ts_s)), int(_MOST_EDGE * rows))
    stride = max(int(1.0 / (8.0 * cutoff_hz * Ts_s)), 1)
    kept = slice(edge, rows - edge, stride)
    t = np.arange(length) * Ts_s
    derivatives = []
    for k in range(4):
        found = irfft(y * (low_pass * (2j * np.pi * freq_hz) ** k)[:, None], length, axis=0)
        if k == 0:
            found = found + line_y[0] + line_y[1] * t[:, None]
        elif k == 1:
            found = found + line_y[1]
        derivatives.append(np.asarray(found[before:][kept]))
    return _Signals(
        tuple(derivatives), u * low_pass[:, None], freq_hz, line_u, kept, before, length, hold,
        Ts_s, e.delay_cycles * Ts_s, {name: float(v.mean()) for name, v in e.schedule.items()},
    )  # fmt: skip


def _spectrum(
    x: Array, before: int, length: int, Ts_s: float
) -> tuple[NDArray[np.complex128], tuple[Array, Array]]:
    """Return the spectrum of the record, extended at both ends, without a line, and the line.

    The extension is odd, as in scipy's filtfilt; without the line the ends join.
    """
    after = length - len(x) - before
    head = 2.0 * x[0] - x[before:0:-1]
    reflected = x[-2 : -min(after, len(x) - 1) - 2 : -1]
    tail = 2.0 * x[-1] - reflected
    whole = np.concatenate([head, x, tail])
    whole = np.concatenate([whole, np.broadcast_to(whole[-1], (length - len(whole), x.shape[1]))])
    value, slope = whole[0], (whole[-1] - whole[0]) / ((length - 1) * Ts_s)
    t = np.arange(length) * Ts_s
    return rfft(whole - value - slope * t[:, None], axis=0), (value, slope)


def _residuals(model: DeclaredModel, record: _Signals) -> tuple[Array, Array]:
    """Return the residual force and the input force (rows, n), both without the mean."""
    at = model.at(record.schedule)
    q, qd, qdd, _ = record.derivatives
    force = record.input(max(at.delay_s, -record.own_delay_s), max(at.lag_s, 0.0)) @ at.B.T
    left = force - qdd @ at.M.T - qd @ at.D.T - q @ at.K.T
    return left - left.mean(axis=0), force - force.mean(axis=0)


def _percent(model: DeclaredModel, records: Sequence[_Signals]) -> Array:
    pairs = [_residuals(model, record) for record in records]
    left, force = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(100.0 * left.std(axis=0) / force.std(axis=0))


def _fit(
    model: DeclaredModel,
    records: Sequence[_Signals],
    instruments: Sequence[_Signals],
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

    def residual(at: Array, of: Sequence[_Signals] = records) -> list[Array]:
        moved = model.with_values(dict(zip(names, at.tolist(), strict=True)))
        return [_residuals(moved, record)[0] * weight for record in of]

    nuisance = [_more(record) for record in records] if extra else None

    def jacobian(at: Array, of: Sequence[_Signals]) -> Array:
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


def _more(record: _Signals) -> Array:
    """Return an orthonormal basis of the third derivatives, without the mean."""
    third = record.derivatives[3] - record.derivatives[3].mean(axis=0)
    return np.asarray(np.linalg.qr(third)[0])


def _stacked(parts: Sequence[Array], nuisance: Sequence[Array] | None) -> Array:
    """Return the records' columns (rows, n) below each other, flat, free of the nuisance."""
    if nuisance is not None:
        parts = [part - Q @ (Q.T @ part) for part, Q in zip(parts, nuisance, strict=True)]
    return np.concatenate([part.reshape(-1) for part in parts])


def _scale(model: DeclaredModel, records: Sequence[_Signals]) -> Array:
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
