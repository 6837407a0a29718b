"""The records of a trace, read from logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ...config.model import ModelConfig
from ...log.reader import read_log
from ..data import IdentificationError
from ..from_log import NotARecordError
from .record import TraceRecord, trace_record


def read_records(
    logs: Sequence[Path], config: ModelConfig
) -> tuple[dict[Path, TraceRecord], tuple[str, ...]]:
    """Return the records among the logs by path, their names told apart, and why others are none.

    Raises IdentificationError: there are none, or what trace_record raises.
    """
    records: dict[Path, TraceRecord] = {}
    notes = []
    for path in logs:
        try:
            records[path] = trace_record(read_log(path), config)
        except NotARecordError as reason:
            notes.append(str(reason))
    if not records:
        raise IdentificationError(
            f"expected records among the {len(logs)} logs, found none: {'; '.join(notes)}"
        )
    names = [r.name for r in records.values()]
    for path, record in records.items():
        if names.count(record.name) > 1:
            named = replace(record.experiment, name=f"{record.name} ({path})")
            records[path] = replace(record, experiment=named)
    return records, tuple(notes)
