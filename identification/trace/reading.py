"""The records of a trace, read from logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...config.model import ModelConfig
from ...log.reader import read_log
from ..data import IdentificationError
from ..from_log import NotARecordError
from .record import TraceRecord, trace_record


def read_records(
    logs: Sequence[Path], config: ModelConfig
) -> tuple[dict[Path, TraceRecord], tuple[str, ...]]:
    """Return the records among the logs by path, their names told apart, and why others are none.

    A record in which a sensor is frozen is none: the loop held the platform by a reading that says
    nothing, and there is no error to be made of it.

    Raises IdentificationError: there are none, or what trace_record raises.
    """
    records: dict[Path, TraceRecord] = {}
    notes = []
    for path in logs:
        try:
            record = trace_record(read_log(path), config)
            require_live(record, path)
            records[path] = record
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


def require_live(record: TraceRecord, path: Path) -> None:
    """Raise NotARecordError where a sensor shows one value throughout."""
    frozen = np.flatnonzero(np.ptp(record.gap, axis=0) == 0.0)
    if len(frozen):
        places = record.places
        names = places.dof if places.sensors == len(places.dof) else None
        which = [names[i] if names else f"sensor:{i}" for i in frozen.tolist()]
        raise NotARecordError(
            f"{path.name}: left out, since {', '.join(which)} is frozen: it shows "
            f"{record.gap[0, frozen[0]]:.6g} {places.sensor_unit} in every row"
        )
