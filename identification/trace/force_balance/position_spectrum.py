"""Find periods over a position in the missing force: start values of a pitch.

A cogging force is a line in the spectrum over the position, as a vibration is one over time. So is
the size of a friction that is uneven, if the missing force is multiplied by the direction, and that
of a motor's ripple, by its command. An encoder that errs in each line of its scale reads an
acceleration in proportion to the squared speed. Over a travel of many periods a search would need
two start values for each: the spectrum tells the few to begin from. Rows in which the force turns
faster than the band's limit do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from ...rounding import ROUNDING
from ..search_options import SearchOptions
from .force_record import ForceModel, ForceRecord

Array = NDArray[np.float64]

_APART = 0.5
"""Cycles over the travel between neighbouring periods: of a line, half of its width."""
_MOST_CYCLES = SearchOptions.at_a_time * SearchOptions.resolved
_ROWS_PER_CYCLE = SearchOptions.resolved


@dataclass(frozen=True)
class Periods:
    """Periods of the strongest lines over the position, in its unit, strongest first.

    cogging: for each DOF, of the missing force; rubbing: of its part that has the direction's sign.
    ripples: for each actuator, of the part that is in proportion to its force. scales: for each
    DOF, of the part that is in proportion to the squared speed.
    """

    cogging: tuple[tuple[float, ...], ...]
    rubbing: tuple[tuple[float, ...], ...]
    ripples: tuple[tuple[float, ...], ...]
    scales: tuple[tuple[float, ...], ...]


def position_periods(point: ForceModel, records: Sequence[ForceRecord], limit_hz: float) -> Periods:
    """Return the periods in the missing force of a fitted model below limit_hz."""
    missing = np.concatenate([r.varying(r.missing_force(point)) for r in records])
    q, qd = (np.concatenate([r.kept[k] for r in records]) for k in (0, 1))
    n = q.shape[1]

    def lines(motion: Array, pushed: int, size: Array) -> tuple[float, ...]:
        x, speed = q @ motion, qd @ motion
        return _lines(x, speed, missing[:, pushed], size, limit_hz)

    axes = [(np.eye(n)[i], i) for i in range(n)]
    whole = np.ones(len(q))
    ripples = []
    for c, motion in enumerate(records[0].signals.places.actuator_motion):
        force = np.concatenate([_force_of(r, point, c) for r in records])
        pushed = int(np.argmax(force.std(axis=0)))
        ripples.append(lines(motion, pushed, force[:, pushed]))
    return Periods(
        tuple(lines(*axis, whole) for axis in axes),
        tuple(lines(*axis, np.sign(qd[:, axis[1]])) for axis in axes),
        tuple(ripples),
        tuple(lines(*axis, qd[:, axis[1]] ** 2) for axis in axes),
    )


def _force_of(record: ForceRecord, point: ForceModel, actuator: int) -> Array:
    """Return the force of one actuator's command (rows, n)."""
    places, coil = record.signals.places, record.signals.coil[:, [actuator]]
    return record.force_of_command(point.model, coil @ places.coil_shape[[actuator]])


def _lines(q: Array, qd: Array, missing: Array, size: Array, limit_hz: float) -> tuple[float, ...]:
    travel = float(np.ptp(q))
    cycles = np.arange(_APART, min(_MOST_CYCLES, len(q) / _ROWS_PER_CYCLE), _APART)
    if travel <= 0.0 or len(cycles) <= 2:
        return ()
    power = np.array([_power(q, qd, missing, size, travel / n, limit_hz) for n in cycles.tolist()])
    # A period longer than the travel has its peak at the begin.
    inner, before = power[:-1], np.concatenate([[0.0], power[:-2]])
    peaks = np.flatnonzero((inner > before) & (inner >= power[1:]))
    strongest = peaks[np.argsort(power[peaks])[::-1]][: SearchOptions.patience]
    return tuple((travel / cycles[strongest]).tolist())


def _power(
    q: Array, qd: Array, missing: Array, size: Array, period: float, limit_hz: float
) -> float:
    """Return the squared force that a line takes where it is slower than the limit, beside what is
    in proportion to `size` (rows,), of which it is a share."""
    slow = np.abs(qd) < limit_hz * period
    if np.count_nonzero(slow) < 2 * _ROWS_PER_CYCLE:
        return 0.0
    x, force, size = 2.0 * np.pi / period * q[slow], missing[slow], size[slow]
    basis: list[Array] = []  # orthonormal: what is even along the position, then the line
    for column in (np.ones(len(x)), size, np.cos(x) * size, np.sin(x) * size):
        rest, length = column, column @ column
        for one in basis:
            rest = rest - (one @ rest) * one
        left = rest @ rest
        basis.append(rest / sqrt(left) if left > ROUNDING**2 * length else np.zeros(len(x)))
    return float(sum((one @ force) ** 2 for one in basis[2:]))
