"""Which command acted in which period, as the amplifiers' readback tells: some come too late."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .missing_samples import runs

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

_AGE = 2
"""A command of row k acts from row k + 1 on: the readback of row k + 2 is what it led to."""
_ROUNDS = 4
_TRIM = 5.0
"""Rows beyond so many standard deviations are no part of the next round of the regression."""
_STRANGE = 25.0
"""Mean square over the coils, in the readback's own variance, from which it contradicts a command:
noise alone never gets there, and what is smaller is a force of a few times the readback's noise."""
_OLDEST = 4
_FOLLOWS = 0.05
"""Spread of the readback around what commands explain, as a share of the commands' own changes:
above, it is no witness of single commands."""
_FEWEST = 50


@dataclass(frozen=True)
class Acted:
    """`row` (N,): index of the row whose command acted when that of each row should have.

    `late`: rows whose command, as the readback says, did not act when it should have.
    `unexplained`: rows whose readback fits neither their command nor an earlier one.
    """

    row: Rows
    late: int
    unexplained: int


def acted(command: Array, readback: Array, known: Mask, absent: Mask, begun_late: Mask) -> Acted:
    """Return which commands acted, of evenly spaced rows.

    command (N, C) N as sent, readback (N, C) N of rows that are `known` (N,); rows that are
    `absent` (N,) are periods that were skipped: they have neither. An amplifier takes a command
    over as the next cycle begins, so that before skipped periods the command before it acts on; one
    with a clock of its own takes it over in time. What the readback behind them shows decides. Else
    a command acted in time unless the readback shows an earlier one. Rows that were `begun_late`
    (N,) stand before skipped periods, but their cycle really began at the end of these.

    The readback follows a command by a first-order lag, with a gain and an offset for each coil;
    where it does not, it decides nothing.
    """
    n = len(command)
    row = np.maximum.accumulate(np.where(absent, -1, np.arange(n)))
    row = np.maximum(row, 0)
    taken = row.copy()
    gaps = runs(absent)
    for first, end in gaps:
        taken[first - 1 : end - 1] = max(first - 2, 0)
        if begun_late[first - 1] and first > 2:
            taken[first - 2 : end - 2] = first - 3
    lag = _Lag.fit(command, readback, known, absent)
    if lag is None:
        return Acted(taken, 0, 0)

    def misfit(k: int, source: int) -> float:
        """Mean square of what is left of the readback of row k + 2 if `source` acted for row k."""
        before = readback[k + 1] if known[k + 1] else lag.settled(command[taken[k - 1]])
        return float(lag.misfit(command[source], before, readback[k + _AGE]))

    for first, end in gaps:
        # The last period of the gap is what the readback behind it is of.
        k = end - 2
        if first < 2 or k + _AGE >= n or not known[k + _AGE]:
            continue
        if misfit(k, first - 1) < misfit(k, first - 2):
            taken[first - 2] = row[first - 2]
            taken[first - 1 : end - 1] = first - 1
    late = unexplained = 0
    strange = np.zeros(n, bool)
    strange[: n - _AGE] = lag.misfits(command[taken], readback)
    for k in np.flatnonzero(strange & ~absent).tolist():
        if not known[k + _AGE] or misfit(k, int(taken[k])) <= _STRANGE:
            continue
        for source in range(k - 1, max(k - 1 - _OLDEST, -1), -1):
            if misfit(k, source) <= _STRANGE:
                taken[k] = source
                late += 1
                break
        else:
            unexplained += 1
    return Acted(row[taken], late, unexplained)


@dataclass(frozen=True)
class _Lag:
    """now = gain command + rest before + offset for each coil; `spread` is that of what is left."""

    gain: Array
    rest: Array
    offset: Array
    spread: Array

    @classmethod
    def fit(cls, command: Array, readback: Array, known: Mask, absent: Mask) -> _Lag | None:
        """Return what the readback follows by, None where it follows by nothing."""
        n = len(command) - _AGE
        if n < _FEWEST or not command.shape[1] or readback.shape != command.shape:
            return None
        clear = ~absent
        usable = known[_AGE:] & known[1 : 1 + n] & clear[:n] & clear[1 : 1 + n]
        if np.count_nonzero(usable) < _FEWEST:
            return None
        command, before, now = command[:n], readback[1 : 1 + n], readback[_AGE:]
        coils = command.shape[1]
        fitted, spread = np.zeros((3, coils)), np.zeros(coils)
        for i in range(coils):
            x = np.column_stack([command[:, i], before[:, i], np.ones(n)])
            good = usable
            for _ in range(_ROUNDS):
                fitted[:, i] = np.linalg.lstsq(x[good], now[good, i], rcond=None)[0]
                left = now[:, i] - x @ fitted[:, i]
                spread[i] = 1.4826 * np.median(np.abs(left[usable]))
                good = usable & (np.abs(left) <= _TRIM * max(spread[i], 1e-12))
        changes = np.std(np.diff(command, axis=0)[usable[1:]], axis=0)
        if np.median(spread / np.maximum(changes, 1e-12)) > _FOLLOWS:
            return None
        # A readback without any noise would make rounding strange.
        floor = 1e-6 * np.std(command, axis=0) + 1e-9
        return cls(fitted[0], fitted[1], fitted[2], np.maximum(spread, floor))

    def misfit(self, command: Array, before: Array, now: Array) -> Array:
        """Return the mean square over the coils of what is left, in its variance."""
        left = now - (self.gain * command + self.rest * before + self.offset)
        return np.asarray(np.mean(np.square(left / self.spread), axis=-1))

    def misfits(self, command: Array, readback: Array) -> Mask:
        """Return which of the rows (N - 2,) contradict their command, or have no row to say so."""
        n = len(command) - _AGE
        return np.asarray(self.misfit(command[:n], readback[1 : 1 + n], readback[_AGE:]) > _STRANGE)

    def settled(self, command: Array) -> Array:
        """Return the readback that a command leads to in the end."""
        return np.asarray((self.gain * command + self.offset) / np.maximum(1.0 - self.rest, 1e-3))
