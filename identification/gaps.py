"""Skipped periods of a real-time log: rows for the missing cycles, so that time runs evenly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..log.reader import Log
from .data import IdentificationError

MOST_SKIPPED = 0.02
"""Share of the periods that may be missing: an rms error of an eighth of a white command's."""

_MEASURED = frozenset(
    {
        *("time_s", "gap_m", "psi_rad", "theta_rad", "z_m", "coil_readback_n"),
        *("beam_m", "beam_m_s", "beam_force_n", "rotor_rad", "rotor_rad_s", "rotor_torque_n_m"),
    }
)


def without_gaps(log: Log) -> tuple[Log, tuple[str, ...]]:
    """Return the log of a flight with a row for every cycle, and remarks on those filled in.

    In a skipped period the coils hold their last command: commands (and everything else) repeat,
    what is measured is interpolated. Imported logs have no cycles and are returned as they are.

    Raises IdentificationError for cycle numbers that do not rise, or too many skipped.
    """
    names = log.rows.dtype.names or ()
    if log.metadata.get("kind") == "import" or "cycle" not in names or len(log.rows) < 2:
        return log, ()
    cycle = log.rows["cycle"].astype(np.int64)
    if np.any(np.diff(cycle) < 1):
        row = int(np.argmax(np.diff(cycle) < 1)) + 1
        raise IdentificationError(
            f"{log.path}: cycle: expected numbers that rise, found {cycle[row]} after "
            f"{cycle[row - 1]} in row {row}"
        )
    periods = int(cycle[-1] - cycle[0]) + 1
    missing = periods - len(cycle)
    if not missing:
        return log, ()
    share = missing / periods
    told = f"{missing} of {periods} periods ({share:.2%}) were skipped"
    if share > MOST_SKIPPED:
        raise IdentificationError(
            f"{log.path}: expected at most {MOST_SKIPPED:.0%} skipped periods, as rows must be "
            f"evenly spaced in time; {told}"
        )
    every = np.arange(cycle[0], cycle[-1] + 1)
    held = np.searchsorted(cycle, every, side="right") - 1
    rows = log.rows[held]
    rows["cycle"] = every
    filled = cycle[held] != every
    for name in _MEASURED.intersection(names):
        values = log.rows[name].reshape(len(cycle), -1)
        rows[name].reshape(periods, -1)[filled] = np.stack(
            [np.interp(every[filled], cycle, column) for column in values.T], axis=1
        )
    return (
        replace(log, rows=rows, log_time_ns=log.log_time_ns[held]),
        (f"{told}: commands repeated there, measurements interpolated",),
    )
