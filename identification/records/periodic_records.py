"""Extract the whole periods of orthogonal multisine records from logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...config.base import ConfigError, parse_text
from ...config.session import RecordStep, SessionConfig
from ...log.reader import Log
from .from_log import from_log, require_record
from .record import IdentificationError, NotARecordError, PiController
from .resampling import resample

Array = NDArray[np.float64]

TRANSIENT_PERIODS = 1
"""Periods left out at the start of every experiment: the transient after the one before."""
REPETITION_TOLERANCE = 1e-2
"""Largest rms difference between the excitation of two periods, over its rms."""


class NotPeriodicError(IdentificationError):
    """A record without orthogonal multisines: other methods use it. Not a failure."""


class IncompleteError(NotARecordError):
    """A record of orthogonal multisines without a complete realisation; other records may do."""


@dataclass(frozen=True)
class PeriodicRecord:
    """E experiments of P whole periods of N samples in steady state at one operating point.

    Excitation v (E, P, N, p), plant input u of the same shape (None where v is the plant's input),
    output y (E, P, N, m). `realisations` is the number of independent draws of the phases.
    """

    name: str
    Ts_s: float
    v: Array
    y: Array
    u: Array | None
    realisations: int
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    beam_m: float | None = None
    controller: PiController | None = None
    remarks: tuple[str, ...] = ()


def periodic_record(log: Log) -> PeriodicRecord:
    """Return the periods of a record of orthogonal multisines.

    Their length and number come from the log's session.yaml. The first period of every experiment
    is left out. Only complete realisations are returned: a truncated log has fewer, and so has one
    with control cycles skipped in the periods used.

    Raises:
        NotARecordError: the log holds no record (see from_log).
        NotPeriodicError: the record has another excitation, or excites some of the inputs only.
        IncompleteError: no realisation is complete.
        IdentificationError: session.yaml is invalid or lacks the record, or the excitation does
            not repeat with the session's period.
    """
    require_record(log)
    step, period_s = _orthogonal_step(log, log.metadata.get("name") or log.path.stem)
    record = from_log(log)
    if "part" in log.metadata:
        raise IncompleteError(
            f"{log.path.name}: part {log.metadata['part']} of record '{record.name}' skipped: the "
            "start of its periods is unknown, only the first part is used"
        )
    plan = step.orthogonal
    assert plan is not None
    N, p, P = round(period_s / record.Ts_s), len(step.excite), plan.periods
    if p < record.v.shape[1]:
        raise NotPeriodicError(
            f"{log.path.name}: record '{record.name}': expected orthogonal multisines at all of "
            f"{', '.join(record.input_names)}, found only {', '.join(step.excite)}"
        )
    per_realisation = p * P * N
    settled, rows = round(step.settle_s / record.Ts_s), len(record.y)
    row = _record_row(log, rows)
    starts = settled + per_realisation * np.arange(plan.realisations)
    within = N * (P * np.arange(p)[:, None] + np.arange(TRANSIENT_PERIODS, P))
    kept = [
        row[start + within]
        for start in starts[starts + per_realisation <= len(row)]
        if row[start] >= 0 and _complete(row, start + within, N, rows)
    ]
    if not kept:
        rows_found = np.count_nonzero((row[settled:] >= 0) & (row[settled:] < rows))
        raise IncompleteError(
            f"{log.path.name}: expected at least one complete realisation of "
            f"{per_realisation * record.Ts_s:g} s, found {rows_found * record.Ts_s:g} s"
            + (f", in which {_skipped(row)} periods were skipped" if _skipped(row) else "")
        )
    chosen = np.concatenate(kept)[:, :, None] + np.arange(N)

    def periods(x: Array) -> Array:
        return np.asarray(x[chosen])

    remarks = list(record.remarks)
    if len(kept) < plan.realisations:
        reason = ", none of its periods skipped" if _skipped(row) else ""
        remarks.append(f"{len(kept)} of {plan.realisations} realisations are complete{reason}")
    periodic = PeriodicRecord(
        name=record.name,
        Ts_s=record.Ts_s,
        v=periods(record.v),
        y=periods(record.y),
        u=None if record.u is None else periods(record.u),
        realisations=len(kept),
        input_names=record.input_names,
        input_units=record.input_units,
        output_names=record.output_names,
        output_units=record.output_units,
        beam_m=record.beam_m,
        controller=record.controller,
        remarks=tuple(remarks),
    )
    _check_repeats(periodic, log)
    return periodic


def periodic_records(logs: Sequence[Log]) -> tuple[tuple[PeriodicRecord, ...], tuple[str, ...]]:
    """Return the orthogonal multisine records among the logs, and why the others are skipped."""
    records, skipped = [], []
    for log in logs:
        try:
            records.append(periodic_record(log))
        except (NotARecordError, NotPeriodicError) as reason:
            skipped.append(str(reason))
    return tuple(records), tuple(skipped)


def _record_row(log: Log, rows: int) -> NDArray[np.int64]:
    """Return the record's row for each row of the planned excitation (K,).

    The plan waits while periods are skipped, so each of its rows is a row of the log. Rows that
    resampling cut off are below 0 or beyond the last row.
    """
    if "cycle" not in (log.rows.dtype.names or ()):
        return np.arange(rows)
    first = int(resample(log)[0].rows["cycle"][0])
    return np.asarray(log.rows["cycle"].astype(np.int64) - first)


def _complete(row: NDArray[np.int64], starts: NDArray[np.int64], N: int, rows: int) -> bool:
    """Return whether N rows of the plan from each start are in the record, without skips."""
    first, last = row[starts], row[starts + N - 1]
    return bool(np.all(last - first == N - 1) and np.all(last < rows))


def _skipped(row: NDArray[np.int64]) -> int:
    return int(np.sum(np.diff(row) - 1))


def _orthogonal_step(log: Log, name: str) -> tuple[RecordStep, float]:
    """Return the session step of the record, and the period of its multisines in s."""
    text = log.attachments.get("session.yaml")
    if text is None:
        raise NotPeriodicError(f"{log.path.name}: record '{name}' has no session.yaml")
    try:
        session = parse_text(text, SessionConfig, f"{log.path}: session.yaml")
    except ConfigError as error:
        raise IdentificationError(str(error)) from None
    steps = [s.record for s in session.steps if s.record is not None and s.record.name == name]
    if not steps:
        raise IdentificationError(
            f"{log.path}: session.yaml: expected a record named '{name}', found none"
        )
    if steps[0].orthogonal is None:
        raise NotPeriodicError(
            f"{log.path.name}: record '{name}' has no orthogonal multisines (key 'orthogonal')"
        )
    period_s = session.excitations[steps[0].excite[0]].period_s
    assert period_s is not None  # checked by the session schema
    return steps[0], period_s


def _check_repeats(periodic: PeriodicRecord, log: Log) -> None:
    v = periodic.v
    # Relative to each input's rms: torques and forces have different units.
    difference = np.sqrt(np.mean((v - v[:, :1]) ** 2, axis=(0, 1, 2)))
    share = difference / np.sqrt(np.mean(v**2, axis=(0, 1, 2)))
    if not np.all(share < REPETITION_TOLERANCE):
        raise IdentificationError(
            f"{log.path}: expected v to repeat every {v.shape[2] * periodic.Ts_s:g} s, found "
            f"periods that differ by {np.nanmax(share):.1%} of the rms"
        )
