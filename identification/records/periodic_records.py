"""Records of orthogonal multisines: whole periods of a known length, cut out of a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...config.base import ConfigError, parse_text
from ...config.session import RecordStep, SessionConfig
from ...log.reader import Log
from .from_log import from_log
from .record import IdentificationError, NotARecordError, PiController
from .resampling import without_gaps

Array = NDArray[np.float64]

TRANSIENT_PERIODS = 1
"""Periods at the begin of every experiment that are left to the transient of the one before."""
REPEATS_WITHIN = 1e-2
"""Largest rms by which the excitation of two periods may differ, relative to its own."""


class NotPeriodicError(IdentificationError):
    """A record without orthogonal multisines: for other methods, no failure."""


class IncompleteError(NotARecordError):
    """A record of orthogonal multisines without one complete realisation; other records may do."""


@dataclass(frozen=True)
class PeriodicRecord:
    """E experiments of P whole periods of N samples in steady state at one operating point.

    Excitation v (E, P, N, p), plant input u of the same shape (None where v is the plant's input),
    output y (E, P, N, m). `realisations` says how many times phases were drawn anew.
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
    """Return the periods of a record that played orthogonal multisines.

    Their length and number come from session.yaml at the head of the log. Of every experiment the
    first period is left out. A log that was cut off gives its complete realisations, and one with
    skipped periods those in which none was skipped but in what is left out: the plan waits then.

    Raises:
        NotARecordError: the log holds no record (see from_log).
        NotPeriodicError: the record played something else, or on some of the inputs alone.
        IncompleteError: there is not one complete realisation.
        IdentificationError: a session.yaml that is none or lacks the record, or an excitation that
            does not repeat as the session says.
    """
    record = from_log(log)
    step, period_s = _orthogonal_step(log, record.name)
    if "part" in log.metadata:
        raise IncompleteError(
            f"{log.path.name}: part {log.metadata['part']} of record '{record.name}', of which "
            "nobody knows where its periods begin: only the first part is used"
        )
    plan = step.orthogonal
    assert plan is not None
    N, p, P = round(period_s / record.Ts_s), len(step.excite), plan.periods
    if p < record.v.shape[1]:
        raise NotPeriodicError(
            f"{log.path.name}: record '{record.name}' excites {', '.join(step.excite)} alone: "
            f"orthogonal multisines need all of {', '.join(record.input_names)}"
        )
    per_realisation = p * P * N
    settled, rows = round(step.settle_s / record.Ts_s), len(record.y)
    at = _flown_in(log, rows)
    begins = settled + per_realisation * np.arange(plan.realisations)
    within = N * (P * np.arange(p)[:, None] + np.arange(TRANSIENT_PERIODS, P))
    kept = [
        at[begin + within]
        for begin in begins[begins + per_realisation <= len(at)]
        if at[begin] >= 0 and _whole(at, begin + within, N, rows)
    ]
    if not kept:
        flown = np.count_nonzero((at[settled:] >= 0) & (at[settled:] < rows))
        raise IncompleteError(
            f"{log.path.name}: expected at least one complete realisation of "
            f"{per_realisation * record.Ts_s:g} s, found {flown * record.Ts_s:g} s"
            + (f", in which {_skipped(at)} periods were skipped" if _skipped(at) else "")
        )
    chosen = np.concatenate(kept)[:, :, None] + np.arange(N)

    def periods(x: Array) -> Array:
        return np.asarray(x[chosen])

    remarks = list(record.remarks)
    if len(kept) < plan.realisations:
        told = ", none of its periods skipped" if _skipped(at) else ""
        remarks.append(f"{len(kept)} of {plan.realisations} realisations are complete{told}")
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
    """Return the records of orthogonal multisines among the logs, and why the others are none."""
    records, skipped = [], []
    for log in logs:
        try:
            records.append(periodic_record(log))
        except (NotARecordError, NotPeriodicError) as reason:
            skipped.append(str(reason))
    return tuple(records), tuple(skipped)


def _flown_in(log: Log, rows: int) -> NDArray[np.int64]:
    """Return in which row of the record each row of the plan was flown (K,).

    The plan waits while periods are skipped: a row of it is a row of the log, at its cycle. Where
    stalls have cut the record it is before row 0 or behind the last.
    """
    if "cycle" not in (log.rows.dtype.names or ()):
        return np.arange(rows)
    first = int(without_gaps(log)[0].rows["cycle"][0])
    return np.asarray(log.rows["cycle"].astype(np.int64) - first)


def _whole(at: NDArray[np.int64], begins: NDArray[np.int64], N: int, rows: int) -> bool:
    """Return whether N rows of the plan from each of `begins` on were flown without a skip."""
    first, last = at[begins], at[begins + N - 1]
    return bool(np.all(last - first == N - 1) and np.all(last < rows))


def _skipped(at: NDArray[np.int64]) -> int:
    return int(np.sum(np.diff(at) - 1))


def _orthogonal_step(log: Log, name: str) -> tuple[RecordStep, float]:
    """Return the step of the session that flew the record, and the period of its multisines."""
    text = log.attachments.get("session.yaml")
    if text is None:
        raise NotPeriodicError(f"{log.path.name}: record '{name}' has no session.yaml with it")
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
            f"{log.path.name}: record '{name}' plays no orthogonal multisines (key 'orthogonal')"
        )
    period_s = session.excitations[steps[0].excite[0]].period_s
    assert period_s is not None  # the session's own check
    return steps[0], period_s


def _check_repeats(periodic: PeriodicRecord, log: Log) -> None:
    v = periodic.v
    # Each input by its own size: torques and forces have no common one.
    difference = np.sqrt(np.mean((v - v[:, :1]) ** 2, axis=(0, 1, 2)))
    share = difference / np.sqrt(np.mean(v**2, axis=(0, 1, 2)))
    if not np.all(share < REPEATS_WITHIN):
        raise IdentificationError(
            f"{log.path}: expected v to repeat every {v.shape[2] * periodic.Ts_s:g} s, found "
            f"periods that differ by {np.nanmax(share):.1%} of their rms"
        )
