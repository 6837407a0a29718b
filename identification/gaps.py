"""A real-time log made even: a row for every period, forces that acted, readings that were taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..log.reader import Log
from ..log.signals import Stale
from .acted import acted
from .data import IdentificationError
from .filling import filled

MOST_MISSING = 0.1
"""Share of the rows whose readings may be missing."""
LONGEST_GAP = 100
"""Periods in a row that may be missing."""
MOST_UNEXPLAINED = 0.005
"""Share of the rows whose readback may fit no command: each is a force that nobody knows."""

_HEIGHTS = ("gap_m", "psi_rad", "theta_rad", "z_m")
_READBACK = ("coil_readback_n",)
_MANIPULATOR = (
    *("beam_m", "beam_m_s", "beam_force_n"),
    *("rotor_rad", "rotor_rad_s", "rotor_torque_n_m"),
)

Mask = NDArray[np.bool_]


def without_gaps(log: Log) -> tuple[Log, tuple[str, ...]]:
    """Return the log of a flight with a row for every period, and remarks on what was made good.

    - Readings that are an earlier cycle's (`stale`), those of skipped periods, and those of cycles
      that took longer than a period, of which nobody knows when they were taken, are filled in
      from those around (see `filled`).
    - Commands (and everything else) of a row are those that acted when its own should have, as the
      amplifiers' readback tells: where a period was skipped or a command came too late, it is an
      earlier row's. Without a readback, that of the last row before.

    Imported logs have no cycles and are returned as they are.

    Raises IdentificationError for cycle numbers that do not rise, or too much that is missing.
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
    skipped = periods - len(cycle)
    if skipped > MOST_MISSING * periods:
        raise _too_much(log, f"{skipped} of {periods} periods ({skipped / periods:.2%}) skipped")
    every = np.arange(cycle[0], cycle[-1] + 1)
    held = np.searchsorted(cycle, every, side="right") - 1
    absent = cycle[held] != every
    stale = log.rows["stale"][held] if "stale" in names else np.zeros(periods, np.uint8)
    untimed = _untimed(log)[held]
    heights = absent | untimed | ((stale & Stale.SENSORS) > 0)
    forces = absent | ((stale & Stale.AMPLIFIERS) > 0)
    drives = absent | ((stale & Stale.DRIVES) > 0)
    _check(log, heights)

    command, told = held, []
    if {"coil_n", "coil_readback_n"} <= set(names):
        command, told = _acting(log, held, forces, absent)
    if np.array_equal(command, np.arange(periods)) and not (heights | forces | drives).any():
        return log, ()
    rows = log.rows[command]
    rows["cycle"] = every
    if "time_s" in names:
        rows["time_s"] = np.interp(every, cycle, log.rows["time_s"])
    push = _matrix(rows, "coil_n")
    for missing, fields, force in (
        (heights, _HEIGHTS, push),
        (forces, _READBACK, None),
        (drives, _MANIPULATOR, None),
    ):
        _fill(log, rows, held, missing, [f for f in fields if f in names], force)
    if skipped:
        told.insert(0, f"{skipped} of {periods} periods ({skipped / periods:.2%}) were skipped")
    count = int(np.count_nonzero(heights))
    if count:
        told.append(f"the heights of {count} rows ({count / periods:.2%}) were filled in")
    return replace(log, rows=rows, log_time_ns=log.log_time_ns[held]), tuple(told)


def _acting(
    log: Log, held: NDArray[np.int64], unknown: Mask, absent: Mask
) -> tuple[NDArray[np.int64], list[str]]:
    """Return the row of the log whose commands acted, for each period, and what to say of it."""
    rows = log.rows[held]
    found = acted(_matrix(rows, "coil_n"), _matrix(rows, "coil_readback_n"), ~unknown, absent)
    if found.unexplained > max(MOST_UNEXPLAINED * len(held), 1):
        raise _too_much(
            log, f"{found.unexplained} rows whose readback fits no command of theirs or before"
        )
    told = []
    if found.late:
        told.append(f"{found.late} commands acted late, as the amplifiers' readback tells")
    if found.unexplained:
        told.append(f"the readback of {found.unexplained} rows fits no command")
    return held[found.row], told


def _untimed(log: Log) -> Mask:
    """Return the rows (N,) whose cycle took so long that it is not known when it read."""
    names = log.rows.dtype.names or ()
    if not {"lateness_s", "execution_s"} <= set(names):
        return np.zeros(len(log.rows), bool)
    # Lateness of a whole period and more was skipped over; what is left of it counts.
    took_s = log.rows["lateness_s"] % (1.0 / log.rate_hz) + log.rows["execution_s"]
    return np.asarray(took_s > 1.0 / log.rate_hz)


def _check(log: Log, missing: Mask) -> None:
    share = float(np.mean(missing))
    if share > MOST_MISSING:
        raise _too_much(log, f"{np.count_nonzero(missing)} of {len(missing)} rows ({share:.2%})")
    edges = np.flatnonzero(np.diff(np.concatenate([[0], missing.astype(np.int8), [0]])))
    longest = int(np.max(np.diff(edges)[::2], initial=0))
    if longest > LONGEST_GAP:
        raise _too_much(log, f"{longest} periods in a row")


def _too_much(log: Log, found: str) -> IdentificationError:
    return IdentificationError(
        f"{log.path}: expected readings and forces of nearly every period (at most "
        f"{MOST_MISSING:.0%} missing, {LONGEST_GAP} in a row, {MOST_UNEXPLAINED:.1%} unexplained): "
        f"{found} is more than an honest estimate allows"
    )


def _fill(
    log: Log,
    rows: NDArray[np.void],
    held: NDArray[np.int64],
    missing: Mask,
    fields: Sequence[str],
    force: NDArray[np.float64] | None,
) -> None:
    """Write measured fields of every period into `rows`, those missing from what is around."""
    if not fields:
        return
    columns = [_matrix(log.rows, name)[held] for name in fields]
    widths = [column.shape[1] for column in columns]
    values = np.concatenate(columns, axis=1)
    if force is not None:
        values = filled(values, missing, force)
    elif missing.any():
        at, known = np.flatnonzero(missing), np.flatnonzero(~missing)
        values[at] = np.stack([np.interp(at, known, v[known]) for v in values.T], axis=1)
    for name, part in zip(fields, np.split(values, np.cumsum(widths)[:-1], axis=1), strict=True):
        rows[name] = part.reshape(rows[name].shape)


def _matrix(rows: NDArray[np.void], name: str) -> NDArray[np.float64]:
    """Return a field as (N, columns), of no columns where there is none."""
    if name not in (rows.dtype.names or ()):
        return np.zeros((len(rows), 0))
    return np.asarray(rows[name].reshape(len(rows), -1).astype(float))
