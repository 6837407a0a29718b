"""Hold the control loop of a record, and check an imported record's controller against its data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import f as f_distribution
from scipy.stats import norm

from ....log.importing.signals_yaml import SignalsFile
from ....log.reader import Log
from ....model.controller import Controller
from ...records.from_log import columns, require_finite
from ...records.record import Record
from .controller_file import controller_of_config

Array = NDArray[np.float64]

_REPRODUCED = 0.01
"""Share of the command's rms below which what a controller leaves counts as rounding."""
_CHANCE = 1e-6
"""Probability by chance below which the rest depends on the outputs."""
_EXPLAINED = 0.005
"""Least share of the rest's variance that outputs and references explain if the controller is
wrong: an excitation with a long memory has a smaller one by itself."""
_CONSTANT = 1e-3
"""Varying part of a response to a unit reference below which it counts as constant."""
_LAGS = 20
_TEST_ROWS = 20_000


@dataclass(frozen=True)
class ControlLoop:
    """The control loop: u = feedforward + C(reference, y + seen, v).

    v (N, p): excitation inside the controller's limits, reference (N, r), feedforward (N, p), seen
    (N, n): what the controller measures beyond the outputs. v includes what the controller leaves
    of a recorded command, as an excitation that was not recorded.
    """

    v: Array
    reference: Array
    feedforward: Array
    seen: Array
    controller: Controller

    def rows(self, cut: slice) -> ControlLoop:
        """Return the rows of a slice."""
        return replace(
            self,
            v=self.v[cut],
            reference=self.reference[cut],
            feedforward=self.feedforward[cut],
            seen=self.seen[cut],
        )


def imported_loop(
    log: Log, signals: SignalsFile, record: Record
) -> tuple[ControlLoop | None, tuple[str, ...]]:
    """Return the loop of an imported record, and remarks; None without a known controller.

    If controller and excitation reproduce the command, the loop is fully known. Otherwise the rest
    of the command counts as an excitation that was not recorded: a simulation then has the input
    u + C(y) - C(y simulated), and no error with the true plant and no noise, whatever C is. If
    outputs or references explain a part of the rest, it is no excitation, and a remark says that
    the controller is not the record's.
    """
    law = signals.loop and signals.loop.law
    if not law:
        return None, ()
    controller, sources = controller_of_config(
        law, record.input_names, record.output_names, record.Ts_s
    )
    reference = _references(log, sources, len(record.y))
    v = _excitation(log, signals, record)
    driven = [record.input_names.index(name) for name in law.drives]
    free = np.setdiff1d(np.arange(record.v.shape[1]), driven)
    v[:, free] = record.v[:, free]
    for column, source in enumerate(sources):
        if source is None:
            reference[:, column] = _set_point(controller, column, record, v)
    start = controller.state_from(reference, record.y, v, record.v)
    explained = controller.output(reference, record.y, v, start)[0]
    rest = record.v - explained
    loop = ControlLoop(v, reference, np.zeros_like(record.v), np.zeros_like(record.y), controller)
    spread = np.maximum(record.v.std(axis=0), np.finfo(float).tiny)
    shares = 100.0 * (rest.std(axis=0) / spread)[driven]
    if np.all(shares <= 100.0 * _REPRODUCED):
        return loop, ()
    completed = replace(loop, v=v + rest)
    seen = np.hstack([record.y, reference[:, np.flatnonzero(np.ptp(reference, axis=0))]])
    for i, name, share in zip(driven, law.drives, shares, strict=True):
        part, chance = explained_by(rest[:, i], seen)
        scale, z = scale_of(explained[:, i] - v[:, i], record.v[:, i] - v[:, i])
        by_scale = 2.0 * norm.sf(abs(z))
        if by_scale < _CHANCE or (chance < _CHANCE and part > _EXPLAINED):
            return completed, (
                f"loop: the stated controller did not command this record. It leaves {share:.3g} % "
                f"of {name} (RMS), and outputs and references explain {100 * part:.3g} % of what "
                "is new in that; an excitation would not depend on them. The command fits "
                f"{scale:.3g} times the stated controller better. Check gains, sign, units, rate "
                "and references. A simulation still uses the stated controller, on the difference "
                "between measured and simulated outputs",
            )
    return completed, (
        f"loop: the controller leaves {shares.max():.3g} % of the command (RMS), which counts as "
        "excitation that was not recorded",
    )


def explained_by(rest: Array, signals: Array) -> tuple[float, float]:
    """Return the share of a signal's innovation that other signals explain, and its chance.

    rest (N,), signals (N, s): the rest is predicted from its own last rows, with and without the
    signals' current and last rows. The chance is that of the F test of both sums of squares.
    """
    rest, signals = rest[:_TEST_ROWS], signals[:_TEST_ROWS]
    lags = min(_LAGS, len(rest) // (4 * (signals.shape[1] + 1)))
    rows = len(rest) - lags
    own = [rest[lags - k : len(rest) - k] for k in range(1, lags + 1)]
    others = [signals[lags - k : len(signals) - k] for k in range(lags + 1)]
    X = np.column_stack([np.ones(rows), *own, *others])
    size = np.linalg.norm(X, axis=0)
    stacked = np.column_stack([X / np.where(size > 0.0, size, 1.0), rest[lags:]])
    R: Array = np.asarray(np.linalg.qr(stacked, mode="r"))
    # Squares of the last column of R, from a row on: what the columns before that row leave.
    left = R[:, -1] ** 2
    narrow, wide = 1 + lags, X.shape[1]
    without, with_signals = float(left[narrow:].sum()), float(left[wide:].sum())
    if without <= 0.0:
        return 0.0, 1.0
    freedom = (wide - narrow, rows - wide)
    statistic = (without - with_signals) / freedom[0] / max(with_signals / freedom[1], 1e-300)
    return 1.0 - with_signals / without, float(f_distribution.sf(statistic, *freedom))


def scale_of(explained: Array, command: Array) -> tuple[float, float]:
    """Return the factor on the controller's output (N,) that fits the command, and z of "it is 1".

    What the controller leaves is whitened by its own autoregression, and so is the output: the new
    part of an excitation is independent of the output of the same row. z is the deviation from 1 in
    standard deviations. The best factor leaves the least to predict.
    """
    explained, command = explained[:_TEST_ROWS], command[:_TEST_ROWS]
    change, z, _ = _scale_change(command - explained, explained)

    def left(factor: float) -> float:
        return float(np.log(_scale_change(command - factor * explained, explained)[2]))

    found = minimize_scalar(left, bracket=(1.0, 1.0 + change), options={"xtol": 1e-3})
    return float(found.x), z


def _scale_change(rest: Array, explained: Array) -> tuple[float, float, float]:
    """Return a change of the factor, z of "it is 0", and the new part's mean square without it."""
    lags = min(_LAGS, len(rest) // 8)
    before = np.column_stack(
        [np.ones(len(rest) - lags), *(rest[lags - k : len(rest) - k] for k in range(1, lags + 1))]
    )
    size = np.maximum(np.linalg.norm(before, axis=0), np.finfo(float).tiny)
    taps = np.linalg.lstsq(before / size, rest[lags:], rcond=1e-10)[0] / size
    whitener = np.concatenate([[1.0], -taps[1:]])
    new_rest, new = (np.convolve(x, whitener, mode="valid") for x in (rest, explained))
    new_rest, new = new_rest - new_rest.mean(), new - new.mean()
    power = max(float(new @ new), np.finfo(float).tiny)
    change = float(new @ new_rest) / power
    left = new_rest - change * new
    error = np.sqrt(max(float(left @ left), np.finfo(float).tiny) / (len(left) - lags) / power)
    square = max(float(np.mean(new_rest**2)), np.finfo(float).tiny)
    return change, float(change / error), square


def _set_point(controller: Controller, column: int, record: Record, v: Array) -> float:
    """Estimate a constant reference that is not stated, from the commands.

    With an integral its effect grows with time; without, it cannot be told from a constant
    excitation, and takes all of it.
    """
    zero = np.zeros((len(record.y), controller.references))
    plain = controller.unlimited()
    rest = record.v - plain.output(zero, record.y, v)[0]
    unit = zero.copy()
    unit[:, column] = 1.0
    by_unit = plain.output(unit, np.zeros_like(record.y), np.zeros_like(record.v))[0]
    acting = np.any(by_unit, axis=0)
    x, target = by_unit[:, acting], rest[:, acting]
    varying = x - x.mean(axis=0)
    if np.linalg.norm(varying) > _CONSTANT * np.linalg.norm(x):
        x, target = varying, target - target.mean(axis=0)
    return float(np.sum(x * target) / np.sum(x**2))


def _references(log: Log, sources: Sequence[str | float | None], rows: int) -> Array:
    names = [name for name in sources if isinstance(name, str)]
    require_finite(log, names)
    found = [
        columns(log, [s])[:, 0] if isinstance(s, str) else np.full(rows, s or 0.0) for s in sources
    ]
    return np.column_stack(found) if found else np.zeros((rows, 0))


def _excitation(log: Log, signals: SignalsFile, record: Record) -> Array:
    """Return the recorded excitations (N, p), added up for each input."""
    v = np.zeros_like(record.v)
    for column in signals.with_role("excitation"):
        require_finite(log, [column.name])
        of = column.of or record.input_names[0]
        v[:, record.input_names.index(of)] += columns(log, [column.name])[:, 0]
    return v
