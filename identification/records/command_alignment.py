"""Align coil commands with the periods they acted in, by the amplifiers' readback."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .missing_samples import runs

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

_READBACK_ROWS = 2
"""A command of row k acts from row k + 1 on, and shows in the readback of row k + 2."""
_ITERATIONS = 4
_MAX_RESIDUAL = 5.0
"""Rows with a residual above this many standard deviations leave the next regression."""
_MAX_MISFIT = 25.0
"""Mean square residual over the coils, in readback variances, above which the readback contradicts
a command. Noise alone does not reach it; a smaller error is a few times the readback's noise."""
_MAX_AGE = 4
_MAX_RESIDUAL_SHARE = 0.05
"""Residual of the readback over the commands' changes. Above, the readback does not identify single
commands and is not used."""
_MIN_ROWS = 50


@dataclass(frozen=True)
class AlignedCommands:
    """Which row's command acted in each period.

    `source_row` (N,): index of the row whose command acted. `late`: number of rows in which the
    readback shows an earlier command. `unexplained`: number of rows whose readback fits neither
    their command nor an earlier one.
    """

    source_row: Rows
    late: int
    unexplained: int


def align_commands(
    command: Array, readback: Array, known: Mask, absent: Mask, started_late: Mask
) -> AlignedCommands:
    """Find which command acted in each period; rows are evenly spaced.

    command (N, C) in N, as sent; readback (N, C) in N, valid in `known` rows (N,). `absent` rows
    (N,) are skipped periods, without command or readback. `started_late` rows (N,) precede skipped
    periods, but their cycle began at the end of these.

    Before skipped periods, an amplifier that applies commands at the start of the next cycle holds
    the earlier command; one with its own clock applies the new one. The readback decides. In all
    other rows the command acted in time, unless the readback shows an earlier one.

    The model of the readback is a first-order lag with gain and offset for each coil. If it does
    not fit, the readback is ignored; so are rows with a readback that is not finite.
    """
    n = len(command)
    known = known & np.isfinite(readback).all(axis=1)
    last_row = np.maximum.accumulate(np.where(absent, -1, np.arange(n)))
    last_row = np.maximum(last_row, 0)
    source = last_row.copy()
    skipped = runs(absent)
    for first, end in skipped:
        source[first - 1 : end - 1] = max(first - 2, 0)
        if started_late[first - 1] and first > 2:
            source[first - 2 : end - 2] = first - 3
    lag = _Lag.fit(command, readback, known, absent)
    if lag is None:
        return AlignedCommands(source, 0, 0)

    def misfit(k: int, earlier: int) -> float:
        """Return the mean square residual of row k + 2 if the command of `earlier` acted in k."""
        before = readback[k + 1] if known[k + 1] else lag.settled(command[source[k - 1]])
        return float(lag.misfit(command[earlier], before, readback[k + _READBACK_ROWS]))

    for first, end in skipped:
        # The first readback after skipped periods belongs to the last of them.
        k = end - 2
        if first < 2 or k + _READBACK_ROWS >= n or not known[k + _READBACK_ROWS]:
            continue
        if misfit(k, first - 1) < misfit(k, first - 2):
            source[first - 2] = last_row[first - 2]
            source[first - 1 : end - 1] = first - 1
    late = unexplained = 0
    contradicted = np.zeros(n, bool)
    contradicted[: n - _READBACK_ROWS] = lag.misfits(command[source], readback)
    for k in np.flatnonzero(contradicted & ~absent).tolist():
        if not known[k + _READBACK_ROWS] or misfit(k, int(source[k])) <= _MAX_MISFIT:
            continue
        for earlier in range(k - 1, max(k - 1 - _MAX_AGE, -1), -1):
            if misfit(k, earlier) <= _MAX_MISFIT:
                source[k] = earlier
                late += 1
                break
        else:
            unexplained += 1
    return AlignedCommands(last_row[source], late, unexplained)


@dataclass(frozen=True)
class _Lag:
    """after = gain command + decay before + offset, by coil; `spread` is the residual's (C,)."""

    gain: Array
    decay: Array
    offset: Array
    spread: Array

    @classmethod
    def fit(cls, command: Array, readback: Array, known: Mask, absent: Mask) -> _Lag | None:
        """Fit the lag by robust regression; return None if it does not fit."""
        n = len(command) - _READBACK_ROWS
        if n < _MIN_ROWS or not command.shape[1] or readback.shape != command.shape:
            return None
        clear = ~absent
        usable = known[_READBACK_ROWS:] & known[1 : 1 + n] & clear[:n] & clear[1 : 1 + n]
        if np.count_nonzero(usable) < _MIN_ROWS:
            return None
        command, before, after = command[:n], readback[1 : 1 + n], readback[_READBACK_ROWS:]
        coils = command.shape[1]
        fitted, spread = np.zeros((3, coils)), np.zeros(coils)
        for i in range(coils):
            x = np.column_stack([command[:, i], before[:, i], np.ones(n)])
            good = usable
            for _ in range(_ITERATIONS):
                fitted[:, i] = np.linalg.lstsq(x[good], after[good, i], rcond=None)[0]
                residual = after[:, i] - x @ fitted[:, i]
                spread[i] = 1.4826 * np.median(np.abs(residual[usable]))
                good = usable & (np.abs(residual) <= _MAX_RESIDUAL * max(spread[i], 1e-12))
        changes = np.std(np.diff(command, axis=0)[usable[1:]], axis=0)
        if np.median(spread / np.maximum(changes, 1e-12)) > _MAX_RESIDUAL_SHARE:
            return None
        # Without noise in the readback, rounding errors would count as contradictions.
        least = 1e-6 * np.std(command, axis=0) + 1e-9
        return cls(fitted[0], fitted[1], fitted[2], np.maximum(spread, least))

    def misfit(self, command: Array, before: Array, after: Array) -> Array:
        """Return the mean square residual over the coils, in residual variances."""
        residual = after - (self.gain * command + self.decay * before + self.offset)
        return np.asarray(np.mean(np.square(residual / self.spread), axis=-1))

    def misfits(self, command: Array, readback: Array) -> Mask:
        """Return which rows (N - 2,) have a readback that contradicts their command."""
        n = len(command) - _READBACK_ROWS
        return np.asarray(
            self.misfit(command[:n], readback[1 : 1 + n], readback[_READBACK_ROWS:]) > _MAX_MISFIT
        )

    def settled(self, command: Array) -> Array:
        """Return the readback in steady state under a constant command."""
        return np.asarray((self.gain * command + self.offset) / np.maximum(1.0 - self.decay, 1e-3))
