"""Read the records of a trace from logs."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ....config.model import ModelConfig
from ....log.reader import read_log
from ...records.duplicate_logs import DuplicateCheck, identity
from ...records.record import IdentificationError, NotARecordError
from .record_from_log import IMPORTED, SHORTEST_S, TraceRecord, trace_record


def read_records(
    logs: Sequence[Path], config: ModelConfig, shortest_s: float = SHORTEST_S
) -> tuple[dict[Path, TraceRecord], tuple[str, ...]]:
    """Return the records of the logs by path, with unique names, and notes.

    Duplicate logs are used once. Records under `shortest_s` are skipped, and those with a frozen
    sensor: the loop acted on a constant reading, and the error is meaningless. Notes list skipped
    logs with the reason, and the remarks of records.

    Raises IdentificationError without records, and as trace_record does.
    """
    records: dict[Path, TraceRecord] = {}
    notes, duplicates = [], DuplicateCheck()
    for path in logs:
        duplicate = duplicates.repeated_path(path)
        if duplicate is not None:
            notes.append(duplicate)
            continue
        log = read_log(path)
        try:
            record = trace_record(log, config)
            _require_long(record, path, shortest_s)
            require_live(record, path)
        except NotARecordError as reason:
            notes.append(str(reason))
            continue
        copy = duplicates.copy_of(path, identity(log))
        if copy is not None:
            notes.append(copy)
            continue
        records[path] = record
    if not records:
        raise IdentificationError(
            f"expected records among the {len(logs)} logs, found none: {'; '.join(notes)}"
        )
    records = _with_unique_names(records)
    return records, (*notes, *_remarks(list(records.values())))


def _remarks(records: Sequence[TraceRecord]) -> list[str]:
    """Return the remarks of the records with their names; one that all share is given once."""
    shared = [
        remark
        for remark in records[0].remarks
        if len(records) > 1 and all(remark in r.remarks for r in records)
    ]
    return [f"all records: {remark}" for remark in shared] + [
        f"{r.name}: {remark}" for r in records for remark in r.remarks if remark not in shared
    ]


def _with_unique_names(records: dict[Path, TraceRecord]) -> dict[Path, TraceRecord]:
    """Return the records with unique names: the path of the log is appended to repeated ones."""
    count = Counter(record.name for record in records.values())
    if count.most_common(1)[0][1] == 1:
        return records
    common = Path(os.path.commonpath([path.absolute().parent for path in records]))
    named = {}
    for path, record in records.items():
        name = record.name
        if count[name] > 1:
            name = f"{name} ({path.absolute().relative_to(common)})"
        named[path] = replace(record, experiment=replace(record.experiment, name=name))
    return named


def _require_long(record: TraceRecord, path: Path, shortest_s: float) -> None:
    seconds = record.rows * record.experiment.Ts_s
    if seconds < shortest_s:
        raise NotARecordError(
            f"{path.name}: left out: expected at least {shortest_s:g} s, found {seconds:.2g} s"
        )


def require_live(record: TraceRecord, path: Path) -> None:
    """Raise NotARecordError for a record with a constant sensor reading.

    An axis of an imported record may rest while another one moves, if nothing pushes it: its
    encoder says so with one reading.
    """
    constant = np.ptp(record.gap, axis=0) == 0.0
    if record.kind == IMPORTED and not constant.all():
        varies = np.ptp(record.experiment.u, axis=0) > 0.0
        pushed = np.any(record.places.actuator_motion[varies] != 0.0, axis=0)
        constant = constant & np.any(record.places.sensor_shape[:, pushed] != 0.0, axis=1)
    frozen = np.flatnonzero(constant)
    if len(frozen):
        places = record.places
        outputs = not places.beam and places.sensors == len(places.dof)
        names = places.dof if outputs else None
        which = [names[i] if names else f"sensor:{i}" for i in frozen.tolist()]
        raise NotARecordError(
            f"{path.name}: left out: {', '.join(which)} is frozen at "
            f"{record.gap[0, frozen[0]]:.6g} {places.sensor_unit} in every row"
        )
