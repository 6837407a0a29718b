"""Find records whose outputs have another sign than in the other records of one plant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .held_out_simulation import HoldOut

_ALIKE = 0.7
"""Least correlation of a simulation with the record: it then explains half of the power."""
_FEWEST = 3
"""Records from which most of them tell what the sign is."""


def records_of_other_sign(holdout: Sequence[HoldOut], names: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence for each record and output that one model simulates with the other sign.

    names: of the outputs. The model is fitted to all records together, of which most are right.
    """
    found = []
    for i, name in enumerate(names):
        by_record = {held.record: _correlation(held, i) for held in holdout}
        told = {record: c for record, c in by_record.items() if abs(c) > _ALIKE}
        other = [record for record, c in told.items() if c < 0.0]
        if len(told) == len(by_record) >= _FEWEST and 2 * len(other) < len(told):
            found += [
                f"it looks as if {name} has the other sign in record '{record}', or the input: all "
                "other records agree with one model. Compare the sign in its signals file"
                for record in other
            ]
    return tuple(found)


def _correlation(held: HoldOut, i: int) -> float:
    measured, simulated = (a[:, i] - a[:, i].mean() for a in (held.measured, held.simulated))
    size = float(np.linalg.norm(measured) * np.linalg.norm(simulated))
    return float(measured @ simulated) / size if np.isfinite(size) and size > 0.0 else 0.0
