"""Take an output that never leaves its noise as at rest: it says nothing of its DOF's equation.

A stage whose axes are excited one at a time has such outputs. Their noise would limit the band of
all records to where they are above it, which is nowhere, and would be a motion in the equations of
the others, whose coupling it would show as none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...greybox.force_balance.band_limited_signals import rises_above_noise
from ...records.record import IdentificationError
from ..records.record_from_log import TraceRecord

Array = NDArray[np.float64]


def with_outputs_at_rest(
    records: Sequence[TraceRecord], sd: Array
) -> tuple[list[TraceRecord], tuple[str, ...]]:
    """Return the records with outputs at rest constant, and a note for each of these outputs.

    sd (n,): noise of the outputs. Raises IdentificationError for an output that rests in all
    records.
    """
    names = records[0].places.dof
    rests = np.array([~rises_above_noise(r.experiment, sd) for r in records])
    if np.any(never := rests.all(axis=0)):
        resting = ", ".join(np.array(names)[never])
        raise IdentificationError(
            f"expected outputs that are ten times above their noise somewhere, found {resting} "
            "within the noise in every record: excite it, or leave it out of the model"
        )
    found = [_held(r, own) if own.any() else r for r, own in zip(records, rests, strict=True)]
    notes = [
        f"{name} is within its noise in {', '.join(r.name for r in np.array(records)[own])}, and "
        "counts as at rest there"
        for name, own in zip(names, rests.T, strict=True)
        if own.any()
    ]
    return found, tuple(notes)


def _held(record: TraceRecord, rests: NDArray[np.bool_]) -> TraceRecord:
    """Return a record with some outputs (n,) at their means."""
    y = record.experiment.y
    held = np.where(rests, y.mean(axis=0), y)
    return replace(record, experiment=replace(record.experiment, y=held))
