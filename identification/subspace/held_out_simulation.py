"""Simulate held-out rows with an identified loop, from the excitation alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...model.second_order import StateSpace
from ..records.record import Record
from .fit_percent import nrmse_fit_percent
from .simulation import simulate, spectral_radius

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HoldOut:
    """Held-out rows of a record: measured (N, m), simulated from the input alone, predicted.

    Fits are in percent, one for each output (m,). `predicted` (one step ahead) is None without an
    identified predictor. `driven` (m,): outputs that are excited at their own input; None if
    outputs have no inputs of their own.
    """

    record: str
    time_s: Array
    measured: Array
    simulated: Array
    simulated_fit_percent: Array
    predicted: Array | None = None
    predicted_fit_percent: Array | None = None
    driven: NDArray[np.bool_] | None = None


def settled_row(record: Record, settled_s: float) -> int:
    """Return the first row after the initial transient, at most a quarter into the record."""
    return 0 if record.at_rest else min(round(settled_s / record.Ts_s), len(record.y) // 4)


def hold_out(record: Record, loop: StateSpace, rows: int, settled: int) -> HoldOut:
    """Simulate the last `rows` rows of the record with the loop from v to y.

    The model has no constant offset: it is the mean error from row `settled` to the held-out rows.
    An unstable loop gives nan.
    """
    stable = spectral_radius(loop.A) < 1.0
    simulated = simulate(loop, record.v) if stable else np.full_like(record.y, np.nan)
    start = len(record.y) - rows
    offset = (record.y - simulated)[settled:start].mean(axis=0)
    measured, modelled = record.y[start:], np.asarray(simulated[start:] + offset)
    time_s = np.arange(start, len(record.y), dtype=np.float64) * record.Ts_s
    fit = nrmse_fit_percent(measured, modelled)
    return HoldOut(record.name, time_s, measured, modelled, fit, driven=record.excited)
