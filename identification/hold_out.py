"""Rows that were kept back, simulated by an identified loop from its excitation alone."""

from __future__ import annotations

import numpy as np

from ..model.second_order import StateSpace
from .data import Record
from .fit import nrmse_fit_percent
from .results import HoldOut
from .simulate import simulate, spectral_radius


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
