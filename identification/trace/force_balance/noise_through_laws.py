"""Compute what the noise of the outputs gives of the missing force, also through laws.

In the linear part of a model its power follows from the matrices. A law passes on much more where
it is steep, as a dry friction where it turns: that is measured by adding as much noise once more.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .force_record import ForceModel, ForceRecord

Array = NDArray[np.float64]


def noise_with_laws(
    point: ForceModel, records: Sequence[ForceRecord], noisier: Sequence[ForceRecord]
) -> list[Array]:
    """Return the RMS missing force (n,) that the noise of the outputs gives in each record.

    noisier: the records with twice the variance of that noise.
    """
    found = []
    for record, more in zip(records, noisier, strict=True):
        noise = record.noise_force(point)
        if point.placed:
            change = more.missing_force(point) - record.missing_force(point)
            noise = np.maximum(noise, record.varying(change * more.moves).std(axis=0))
        found.append(noise)
    return found
