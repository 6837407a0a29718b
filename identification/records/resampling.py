"""Resample a real-time log to one row a period, with the forces that acted and its readings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...log.reader import Log
from ...log.signals import Stale
from .command_alignment import AlignedCommands, align_commands
from .missing_samples import fill_missing, fillable
from .record import IdentificationError, NotARecordError

MAX_STALL_S = 0.01
"""Missing readings up to this duration are filled in (see `fill_missing`), with an error of one or
two times the sensor noise. Longer ones, whose error exceeds ten times the noise, cut the record."""
MAX_MISSING_SHARE = 0.1
"""Largest share of rows with missing readings."""
MIN_USED_SHARE = 0.1
"""Smallest share of a record that its longest usable part must hold."""
MAX_UNEXPLAINED_SHARE = 0.001
"""Largest share of rows whose readback fits no command: their force is unknown."""

_MIN_ROWS = 50

_POSE = ("psi_rad", "theta_rad", "z_m")
_HEIGHTS = ("gap_m", *_POSE)
_READBACK = ("coil_readback_n",)
_EXCITATION = ("v_psi_n_m", "v_theta_n_m", "v_z_n", "coil_excitation_n")
_MANIPULATOR = (
    *("beam_m", "beam_m_s", "beam_force_n"),
    *("rotor_rad", "rotor_rad_s", "rotor_torque_n_m"),
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def resample(log: Log) -> tuple[Log, tuple[str, ...]]:
    """Return a rig log with one row a period, and remarks on what was changed.

    - Readings are missing if they are stale (repeated from an earlier cycle), in skipped periods,
      and in cycles longer than a period, whose sampling time is unknown. They are filled in (see
      `fill_missing`). If too many in a row are missing, or if they cannot be filled in
      consistently, the record is cut there and its longest part is returned.
    - Commands and all other fields of a row are those that acted in its period (see
      `align_commands`): an earlier row's after a skipped period or a late command.
    - Rows from a fault on are left out: the coils have no force and the platform falls.

    Imported logs, and others with a signals.yaml, are returned unchanged.

    Raises IdentificationError if cycle numbers do not increase or too many rows are missing,
    NotARecordError if too few rows precede a fault.
    """
    names = log.rows.dtype.names or ()
    if "signals.yaml" in log.attachments or "cycle" not in names or len(log.rows) < 2:
        return log, ()
    log, cut = _before_fault(log)
    periods = _Periods.of(log)
    if not periods.imperfect:
        return log, cut
    periods = _with_stall_order_resolved(log, periods)
    command, alignment_remarks = _align(log, periods)
    acting = log.rows[periods.held[command]]
    first, end = _longest_usable_part(log, periods, _matrix(acting, "coil_n"))
    rows = acting
    rows["cycle"] = periods.cycle
    if "time_s" in names:
        rows["time_s"] = np.interp(periods.cycle, log.rows["cycle"], log.rows["time_s"])
    rows, force = rows[first:end], _matrix(rows, "coil_n")[first:end]
    measured = {
        name: _matrix(log.rows, name)[periods.held][first:end]
        for name in (*_HEIGHTS, *_READBACK, *_MANIPULATOR)
        if name in names
    }
    for missing, fields in (
        (periods.no_forces[first:end], _READBACK),
        (periods.no_drives[first:end], _MANIPULATOR),
    ):
        for name in measured.keys() & set(fields):
            measured[name] = _interpolated(measured[name], missing)
    _fill_heights(measured, periods.no_heights[first:end], force)
    for name, values in measured.items():
        rows[name] = values.reshape(rows[name].shape)
    remarks = (*cut, *periods.remarks(first, end), *alignment_remarks)
    return replace(log, rows=rows, log_time_ns=log.log_time_ns[periods.held][first:end]), remarks


def _before_fault(log: Log) -> tuple[Log, tuple[str, ...]]:
    if "fault" not in (log.rows.dtype.names or ()) or not np.any(log.rows["fault"]):
        return log, ()
    first = int(np.argmax(log.rows["fault"] != 0))
    if first < _MIN_ROWS:
        raise NotARecordError(
            f"{log.path.name}: expected at least {_MIN_ROWS} rows before a fault, found {first}"
        )
    remark = f"{len(log.rows) - first} rows from a fault on are left out"
    return replace(log, rows=log.rows[:first], log_time_ns=log.log_time_ns[:first]), (remark,)


@dataclass(frozen=True)
class _Periods:
    """All periods (N,) between a log's first and last row: the row held in each, missing data."""

    cycle: NDArray[np.int64]
    held: NDArray[np.int64]
    absent: Mask
    no_heights: Mask
    no_forces: Mask
    no_drives: Mask
    not_sent: Mask
    untimed: Mask
    started_late: Mask

    @classmethod
    def of(cls, log: Log) -> _Periods:
        cycle = log.rows["cycle"].astype(np.int64)
        if np.any(np.diff(cycle) < 1):
            row = int(np.argmax(np.diff(cycle) < 1)) + 1
            raise IdentificationError(
                f"{log.path}: cycle: expected increasing numbers, found {cycle[row]} after "
                f"{cycle[row - 1]} in row {row}"
            )
        if cycle[-1] - cycle[0] > len(cycle) / MIN_USED_SHARE:
            raise _too_little_data(log, f"{len(cycle)} rows in {cycle[-1] - cycle[0] + 1} periods")
        every = np.arange(cycle[0], cycle[-1] + 1)
        held = np.searchsorted(cycle, every, side="right") - 1
        absent = cycle[held] != every
        names = log.rows.dtype.names or ()
        stale = log.rows["stale"][held] if "stale" in names else np.zeros(len(every), np.uint8)
        untimed, no_reading = _untimed(log)[held], (stale & Stale.SENSORS) > 0
        return cls(
            every,
            held,
            absent,
            absent | untimed | no_reading,
            absent | ((stale & Stale.AMPLIFIERS) > 0),
            absent | ((stale & Stale.DRIVES) > 0),
            (stale & Stale.SETPOINTS) > 0,
            untimed,
            # Stale readings: the stall came before this cycle's requests, not after them.
            untimed & no_reading & ~absent,
        )

    @property
    def imperfect(self) -> bool:
        lacks = self.no_heights | self.no_forces | self.no_drives | self.not_sent
        return bool(lacks.any())

    def remarks(self, first: int, end: int) -> list[str]:
        """Return remarks on missing data in periods first to end (exclusive)."""
        found, n = [], end - first
        if n < len(self.cycle):
            found.append(
                f"cut to {n} of {len(self.cycle)} rows, from row {first} on: before or after them "
                f"readings are missing for more than {1e3 * MAX_STALL_S:g} ms or contradict the "
                "known forces"
            )
        for missing, what in (
            (self.absent, "periods were skipped"),
            (self.no_heights, "rows had no valid heights, which were interpolated"),
        ):
            count = int(np.count_nonzero(missing[first:end]))
            if count:
                found.append(f"{count} of {n} {what} ({count / n:.2%})")
        return found


def _with_stall_order_resolved(log: Log, periods: _Periods) -> _Periods:
    """Return the periods with `started_late` corrected by the motion around each stall.

    A long cycle before skipped periods either started late or stalled after its start; different
    commands acted in the two cases. Only the motion of the platform distinguishes them.
    """
    ambiguous = periods.untimed & ~periods.absent & np.append(periods.absent[1:], False)
    if not ambiguous.any() or "gap_m" not in (log.rows.dtype.names or ()):
        return periods
    swapped = replace(periods, started_late=periods.started_late ^ ambiguous)
    better = ambiguous & (_misfit(log, swapped) < _misfit(log, periods))
    return replace(periods, started_late=periods.started_late ^ better)


def _misfit(log: Log, periods: _Periods) -> Array:
    force = _matrix(log.rows[periods.held[_align(log, periods)[0]]], "coil_n")
    gap = _matrix(log.rows, "gap_m")[periods.held]
    return fill_missing(gap, periods.no_heights, force).misfit


def _longest_usable_part(log: Log, periods: _Periods, force: Array) -> tuple[int, int]:
    """Return begin and end of the longest part in which all missing rows can be filled in.

    Excited rows decide the length, if there are any: rows at rest show no response.
    """
    missing = periods.no_heights
    # One excited row outweighs all others together.
    weight = 1 + len(missing) * _excited(log)[periods.held]
    usable = fillable(missing, max(round(MAX_STALL_S * log.rate_hz), 1))
    first, end = _heaviest_part(missing & ~usable, weight)
    gap = _matrix(log.rows, "gap_m")[periods.held]
    while gap.shape[1] and end - first >= _MIN_ROWS:
        filled = fill_missing(gap[first:end], missing[first:end], force[first:end])
        if not filled.inconsistent.any():
            break
        usable[first:end] &= ~filled.inconsistent
        first, end = _heaviest_part(missing & ~usable, weight)
    n = len(missing)
    if end - first < MIN_USED_SHARE * n:
        raise _too_little_data(log, f"{end - first} of {n} rows between two stalls")
    count = int(np.count_nonzero(missing[first:end]))
    if count > MAX_MISSING_SHARE * (end - first):
        raise _too_little_data(log, f"no heights in {count} of {end - first} rows")
    return first, end


def _heaviest_part(cut: Mask, weight: NDArray[np.int64]) -> tuple[int, int]:
    """Return begin and end of the part between `cut` rows (N,) with the largest sum of weights."""
    edges = np.concatenate([[-1], np.flatnonzero(cut), [len(cut)]])
    before = np.concatenate([[0], np.cumsum(weight)])
    at = int(np.argmax(before[edges[1:]] - before[edges[:-1] + 1]))
    return int(edges[at]) + 1, int(edges[at + 1])


def _excited(log: Log) -> NDArray[np.int64]:
    """Return 1 for each row (N,) whose wrench or coils are excited, else 0."""
    v = np.concatenate([_matrix(log.rows, name) for name in _EXCITATION], axis=1)
    return np.asarray(np.any(v, axis=1), np.int64)


def _align(log: Log, periods: _Periods) -> tuple[NDArray[np.int64], list[str]]:
    """Return for each period the period whose commands acted, and remarks."""
    rows = log.rows[periods.held]
    found: AlignedCommands = align_commands(
        _matrix(rows, "coil_n"),
        _matrix(rows, "coil_readback_n"),
        ~periods.no_forces,
        periods.absent,
        periods.started_late,
    )
    if found.unexplained > max(MAX_UNEXPLAINED_SHARE * len(rows), 1.0):
        raise _too_little_data(log, f"{found.unexplained} rows whose readback fits no command")
    remarks = []
    if found.late:
        remarks.append(f"{found.late} commands acted late, by the amplifiers' readback")
    if found.unexplained:
        remarks.append(f"the readback of {found.unexplained} rows fits no command")
    return found.source_row, remarks


def _untimed(log: Log) -> Mask:
    """Return the rows (N,) whose cycle exceeded a period, so that its sampling time is unknown."""
    if not {"lateness_s", "execution_s"} <= set(log.rows.dtype.names or ()):
        return np.zeros(len(log.rows), bool)
    # A late cycle skips whole periods; only the remainder delays the reading.
    took_s = log.rows["lateness_s"] % (1.0 / log.rate_hz) + log.rows["execution_s"]
    return np.asarray(took_s > 1.0 / log.rate_hz)


def _too_little_data(log: Log, found: str) -> IdentificationError:
    return IdentificationError(
        f"{log.path}: too many missing samples: expected {MIN_USED_SHARE:.0%} of the record in one "
        f"part without stalls above {1e3 * MAX_STALL_S:g} ms, with heights missing in at most "
        f"{MAX_MISSING_SHARE:.0%} and unknown forces in at most {MAX_UNEXPLAINED_SHARE:.1%} of the "
        f"rows; found {found}; repeat the record on an idle machine"
    )


def _fill_heights(measured: dict[str, Array], missing: Mask, force: Array) -> None:
    """Fill in missing heights, and the pose as T times the heights (T fitted to the other rows)."""
    gap = measured.get("gap_m")
    if gap is not None:
        measured["gap_m"] = fill_missing(gap, missing, force).values
    for name in measured.keys() & set(_POSE):
        if gap is None:
            measured[name] = fill_missing(measured[name], missing, force).values
            continue
        T = np.linalg.lstsq(gap[~missing], measured[name][~missing], rcond=1e-6)[0]
        measured[name][missing] = measured["gap_m"][missing] @ T


def _interpolated(values: Array, missing: Mask) -> Array:
    """Return values (N, S) with missing rows interpolated linearly."""
    if not missing.any() or missing.all():
        return values
    at, known = np.flatnonzero(missing), np.flatnonzero(~missing)
    values[at] = np.stack([np.interp(at, known, v[known]) for v in values.T], axis=1)
    return values


def _matrix(rows: NDArray[np.void], name: str) -> Array:
    """Return a field as (N, columns); (N, 0) if the log lacks it."""
    if name not in (rows.dtype.names or ()):
        return np.zeros((len(rows), 0))
    return np.asarray(rows[name].reshape(len(rows), -1).astype(float))
