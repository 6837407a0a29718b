"""A real-time log made even: a row for every period, forces that acted, readings of its time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...log.reader import Log
from ...log.signals import Stale
from .command_alignment import Acted, acted
from .missing_samples import bridged, filled
from .record import IdentificationError, NotARecordError

LONGEST_S = 0.01
"""Gaps in the readings up to this are filled in; a record with longer ones is cut there. Filled by
`filled`, rows are off by the sensors' noise or two; beyond, by ten times that and more."""
MOST_MISSING = 0.1
"""Share of the rows whose readings may be missing."""
LEAST_LEFT = 0.1
"""Share of a record that the longest part of it must have that is not cut."""
MOST_UNEXPLAINED = 0.001
"""Share of the rows whose readback may fit no command: each is a force that nobody knows."""

_FEWEST = 50

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


def without_gaps(log: Log) -> tuple[Log, tuple[str, ...]]:
    """Return the log of a flight with a row for every period, and remarks on what was made good.

    - Readings that are an earlier cycle's (`stale`), those of skipped periods, and those of cycles
      that took longer than a period, of which nobody knows when they were taken, are missing. They
      are filled in from those around (see `filled`); where too many in a row are missing, or both
      sides contradict each other, the record is cut, and its longest part returned.
    - Commands (and everything else) of a row are those that acted when its own should have (see
      `acted`): where a period was skipped or a command came too late, an earlier row's.

    - From a fault on the coils have no force and the platform falls: these rows are left out.

    Imported logs, and others with a signals.yaml, have no such cycles and are returned as they are.

    Raises IdentificationError for cycle numbers that do not rise, or too much that is missing,
    NotARecordError where a fault left next to nothing.
    """
    names = log.rows.dtype.names or ()
    if "signals.yaml" in log.attachments or "cycle" not in names or len(log.rows) < 2:
        return log, ()
    log, cut = _before_fault(log)
    periods = _Periods.of(log)
    if not periods.imperfect:
        return log, cut
    periods = _with_stalls_told_apart(log, periods)
    command, told = _acting(log, periods)
    acting = log.rows[periods.held[command]]
    first, end = _longest_part(log, periods, _matrix(acting, "coil_n"))
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
    remarks = (*cut, *periods.remarks(first, end), *told)
    return replace(log, rows=rows, log_time_ns=log.log_time_ns[periods.held][first:end]), remarks


def _before_fault(log: Log) -> tuple[Log, tuple[str, ...]]:
    if "fault" not in (log.rows.dtype.names or ()) or not np.any(log.rows["fault"]):
        return log, ()
    first = int(np.argmax(log.rows["fault"] != 0))
    if first < _FEWEST:
        raise NotARecordError(f"{log.path.name}: a fault after {first} rows, which are too few")
    remark = f"{len(log.rows) - first} rows from a fault on are left out"
    return replace(log, rows=log.rows[:first], log_time_ns=log.log_time_ns[:first]), (remark,)


@dataclass(frozen=True)
class _Periods:
    """Every period from the first row of a log to the last (N,): the row held in it, what lacks."""

    cycle: NDArray[np.int64]
    held: NDArray[np.int64]
    absent: Mask
    no_heights: Mask
    no_forces: Mask
    no_drives: Mask
    not_sent: Mask
    untimed: Mask
    begun_late: Mask

    @classmethod
    def of(cls, log: Log) -> _Periods:
        cycle = log.rows["cycle"].astype(np.int64)
        if np.any(np.diff(cycle) < 1):
            row = int(np.argmax(np.diff(cycle) < 1)) + 1
            raise IdentificationError(
                f"{log.path}: cycle: expected numbers that rise, found {cycle[row]} after "
                f"{cycle[row - 1]} in row {row}"
            )
        if cycle[-1] - cycle[0] > len(cycle) / LEAST_LEFT:
            raise _too_much(log, f"{len(cycle)} rows of {cycle[-1] - cycle[0] + 1} periods")
        every = np.arange(cycle[0], cycle[-1] + 1)
        held = np.searchsorted(cycle, every, side="right") - 1
        absent = cycle[held] != every
        names = log.rows.dtype.names or ()
        stale = log.rows["stale"][held] if "stale" in names else np.zeros(len(every), np.uint8)
        untimed, no_gap = _untimed(log)[held], (stale & Stale.SENSORS) > 0
        return cls(
            every,
            held,
            absent,
            absent | untimed | no_gap,
            absent | ((stale & Stale.AMPLIFIERS) > 0),
            absent | ((stale & Stale.DRIVES) > 0),
            (stale & Stale.SETPOINTS) > 0,
            untimed,
            # Its answers came after a stall, not before it: so did its question.
            untimed & no_gap & ~absent,
        )

    @property
    def imperfect(self) -> bool:
        lacks = self.no_heights | self.no_forces | self.no_drives | self.not_sent
        return bool(lacks.any())

    def remarks(self, first: int, end: int) -> list[str]:
        """Return in words what rows first .. end of all periods lack."""
        found, n = [], end - first
        if n < len(self.cycle):
            found.append(
                f"cut to its {n} rows from {first} on, of {len(self.cycle)}: around them readings "
                f"are missing for longer than {1e3 * LONGEST_S:g} ms, or fit no known forces"
            )
        for missing, what in (
            (self.absent, "periods were skipped"),
            (self.no_heights, "rows had no heights of their time, filled in from those around"),
        ):
            count = int(np.count_nonzero(missing[first:end]))
            if count:
                found.append(f"{count} of {n} {what} ({count / n:.2%})")
        return found


def _with_stalls_told_apart(log: Log, periods: _Periods) -> _Periods:
    """Return the periods with `begun_late` as the motion around each gap says.

    Before a gap a cycle that took long either began late, or everything stood still behind its
    begin: then other commands acted. Nothing but what the platform did then tells which.
    """
    doubtful = periods.untimed & ~periods.absent & np.append(periods.absent[1:], False)
    if not doubtful.any() or "gap_m" not in (log.rows.dtype.names or ()):
        return periods
    other = replace(periods, begun_late=periods.begun_late ^ doubtful)
    better = doubtful & (_misfit(log, other) < _misfit(log, periods))
    return replace(periods, begun_late=periods.begun_late ^ better)


def _misfit(log: Log, periods: _Periods) -> Array:
    force = _matrix(log.rows[periods.held[_acting(log, periods)[0]]], "coil_n")
    gap = _matrix(log.rows, "gap_m")[periods.held]
    return filled(gap, periods.no_heights, force).misfit


def _longest_part(log: Log, periods: _Periods, force: Array) -> tuple[int, int]:
    """Return first and end of the longest stretch in which every gap can be filled in.

    Longest by its rows that excite something, where any do: seconds of rest before them tell of no
    response, however many they are.
    """
    missing = periods.no_heights
    # A row that excites outweighs all that do not.
    weight = 1 + len(missing) * _excited(log)[periods.held]
    possible = bridged(missing, max(round(LONGEST_S * log.rate_hz), 1))
    first, end = _longest_between(missing & ~possible, weight)
    gap = _matrix(log.rows, "gap_m")[periods.held]
    while gap.shape[1] and end - first >= _FEWEST:
        strained = filled(gap[first:end], missing[first:end], force[first:end]).strained
        if not strained.any():
            break
        possible[first:end] &= ~strained
        first, end = _longest_between(missing & ~possible, weight)
    n = len(missing)
    if end - first < LEAST_LEFT * n:
        raise _too_much(log, f"{end - first} of {n} rows between one stall and the next")
    count = int(np.count_nonzero(missing[first:end]))
    if count > MOST_MISSING * (end - first):
        raise _too_much(log, f"no heights in {count} of {end - first} rows")
    return first, end


def _longest_between(cut: Mask, weight: NDArray[np.int64]) -> tuple[int, int]:
    """Return begin and end of the rows between two `cut` ones (N,) that weigh most (N,)."""
    edges = np.concatenate([[-1], np.flatnonzero(cut), [len(cut)]])
    before = np.concatenate([[0], np.cumsum(weight)])
    at = int(np.argmax(before[edges[1:]] - before[edges[:-1] + 1]))
    return int(edges[at]) + 1, int(edges[at + 1])


def _excited(log: Log) -> NDArray[np.int64]:
    """Return 1 for each row (N,) whose wrench or coils are excited, else 0."""
    v = np.concatenate([_matrix(log.rows, name) for name in _EXCITATION], axis=1)
    return np.asarray(np.any(v, axis=1), np.int64)


def _acting(log: Log, periods: _Periods) -> tuple[NDArray[np.int64], list[str]]:
    """Return the period whose commands acted, for each period, and what to say of it."""
    rows = log.rows[periods.held]
    found: Acted = acted(
        _matrix(rows, "coil_n"),
        _matrix(rows, "coil_readback_n"),
        ~periods.no_forces,
        periods.absent,
        periods.begun_late,
    )
    if found.unexplained > max(MOST_UNEXPLAINED * len(rows), 1.0):
        raise _too_much(log, f"{found.unexplained} rows whose readback fits no command")
    told = []
    if found.late:
        told.append(f"{found.late} commands acted late, as the amplifiers' readback tells")
    if found.unexplained:
        told.append(f"the readback of {found.unexplained} rows fits no command")
    return found.row, told


def _untimed(log: Log) -> Mask:
    """Return the rows (N,) whose cycle took so long that it is not known when it read."""
    if not {"lateness_s", "execution_s"} <= set(log.rows.dtype.names or ()):
        return np.zeros(len(log.rows), bool)
    # Lateness of a whole period and more was skipped over; what is left of it counts.
    took_s = log.rows["lateness_s"] % (1.0 / log.rate_hz) + log.rows["execution_s"]
    return np.asarray(took_s > 1.0 / log.rate_hz)


def _too_much(log: Log, found: str) -> IdentificationError:
    return IdentificationError(
        f"{log.path}: expected readings and forces of nearly every period: stalls of at most "
        f"{1e3 * LONGEST_S:g} ms over {LEAST_LEFT:.0%} of the record in one piece, in it at most "
        f"{MOST_MISSING:.0%} without heights, and {MOST_UNEXPLAINED:.1%} with forces that nobody "
        f"commanded; found {found}: no honest estimate comes of that"
    )


def _fill_heights(measured: dict[str, Array], missing: Mask, force: Array) -> None:
    """Fill in the heights, and the pose as what it is of them in all other rows: T times them."""
    gap = measured.get("gap_m")
    if gap is not None:
        measured["gap_m"] = filled(gap, missing, force).values
    for name in measured.keys() & set(_POSE):
        if gap is None:
            measured[name] = filled(measured[name], missing, force).values
            continue
        T = np.linalg.lstsq(gap[~missing], measured[name][~missing], rcond=1e-6)[0]
        measured[name][missing] = measured["gap_m"][missing] @ T


def _interpolated(values: Array, missing: Mask) -> Array:
    """Return values (N, S) with straight lines through the missing rows."""
    if not missing.any() or missing.all():
        return values
    at, known = np.flatnonzero(missing), np.flatnonzero(~missing)
    values[at] = np.stack([np.interp(at, known, v[known]) for v in values.T], axis=1)
    return values


def _matrix(rows: NDArray[np.void], name: str) -> Array:
    """Return a field as (N, columns), of no columns where there is none."""
    if name not in (rows.dtype.names or ()):
        return np.zeros((len(rows), 0))
    return np.asarray(rows[name].reshape(len(rows), -1).astype(float))
