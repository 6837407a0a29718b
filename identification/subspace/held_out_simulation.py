"""Rows that were kept back, simulated by an identified loop from its excitation alone."""

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
    """Rows that no estimate has seen: measured (N, m), simulated from the input alone, predicted.

    Fits are in percent, one for each output (m,). `predicted` (one step ahead) is None where no
    predictor was identified. `driven` (m,) says which outputs the record moves by excitation at
    their own inputs; None where outputs have no inputs of their own.
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
    """Return the row from which on nothing rings from before; in a short record, a quarter in."""
    return 0 if record.at_rest else min(round(settled_s / record.Ts_s), len(record.y) // 4)


def hold_out(record: Record, loop: StateSpace, rows: int, settled: int) -> HoldOut:
    """Return the last `rows` of the record beside what the loop from v to y makes of v.

    The level is not the model's to know, as the loop rests at whatever offset the record has: it is
    taken from row `settled` up to the rows kept back. An unstable loop simulates nothing (nan).
    """
    stable = spectral_radius(loop.A) < 1.0
    simulated = simulate(loop, record.v) if stable else np.full_like(record.y, np.nan)
    start = len(record.y) - rows
    offset = (record.y - simulated)[settled:start].mean(axis=0)
    measured, modelled = record.y[start:], np.asarray(simulated[start:] + offset)
    time_s = np.arange(start, len(record.y), dtype=np.float64) * record.Ts_s
    fit = nrmse_fit_percent(measured, modelled)
    return HoldOut(record.name, time_s, measured, modelled, fit, driven=record.excited)
