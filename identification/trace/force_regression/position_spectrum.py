"""Find the periods over a position that the missing force has: start values of a cogging's pitch.

A cogging force is a line in the spectrum over the position, as a vibration is one over time. Over a
travel of many periods a search would need two start values for each: the spectrum tells the few to
begin from. Rows in which the force turns faster than the band's limit do not count.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .force_record import ForceModel, ForceRecord

Array = NDArray[np.float64]

_APART = 0.5
"""Cycles over the travel between neighbouring periods: of a line, half of its width."""
_MOST_CYCLES = 1000.0
_ROWS_PER_CYCLE = 4.0
_MOST_LINES = 3


def position_periods(
    point: ForceModel, records: Sequence[ForceRecord], limit_hz: float
) -> tuple[tuple[float, ...], ...]:
    """Return for each DOF the periods of the strongest lines of its missing force, in its unit.

    The force is that of a fitted model below limit_hz.
    """
    missing = np.concatenate([r.varying(r.missing_force(point)) for r in records])
    q, qd = (np.concatenate([r.kept[k] for r in records]) for k in (0, 1))
    return tuple(_lines(q[:, i], qd[:, i], missing[:, i], limit_hz) for i in range(q.shape[1]))


def _lines(q: Array, qd: Array, missing: Array, limit_hz: float) -> tuple[float, ...]:
    travel = float(np.ptp(q))
    cycles = np.arange(1.0, min(_MOST_CYCLES, len(q) / _ROWS_PER_CYCLE), _APART)
    if travel <= 0.0 or len(cycles) < 3:
        return ()
    power = np.array([_power(q, qd, missing, travel / n, limit_hz) for n in cycles.tolist()])
    inner = power[1:-1]
    peaks = np.flatnonzero((inner > power[:-2]) & (inner >= power[2:])) + 1
    strongest = peaks[np.argsort(power[peaks])[::-1]][:_MOST_LINES]
    return tuple((travel / cycles[strongest]).tolist())


def _power(q: Array, qd: Array, missing: Array, period: float, limit_hz: float) -> float:
    """Return the squared force that a line takes where it is slower than the limit."""
    slow = np.abs(qd) < limit_hz * period
    if np.count_nonzero(slow) < _ROWS_PER_CYCLE * 2.0:
        return 0.0
    turn = np.exp(2j * np.pi / period * q[slow])
    line = np.stack([turn.real, turn.imag], axis=1)
    line -= line.mean(axis=0)
    force = missing[slow] - missing[slow].mean()
    taken = line @ np.linalg.lstsq(line, force, rcond=None)[0]
    return float(taken @ taken)
