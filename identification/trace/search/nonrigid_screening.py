"""Pre-screen free forms of sensor readings by the readings' non-rigid part.

With redundant sensors, an error of one sensor shows mostly in the non-rigid part of the readings,
which needs no model or filter: this costs a fraction of the filtered columns. Sensors with an
accepted effect are screened with all columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Effect
from ...rounding import TINY
from ..linearised.gram_matrices import Linearised, ResidualChannel, grams
from ..linearised.innovations_filter_bank import thinned
from ..linearised.linearisation_point import WorkingPoint, along
from ..linearised.linearise_prediction_errors import beyond_pose, readings, redundancy_basis
from ..records.record_from_log import TraceRecord
from .gauss_newton import Candidate
from .regression import ColumnEvidence, gains

Array = NDArray[np.float64]

_SHARE = 0.5
"""Of what is expected there of a candidate that takes enough, as much has to be there: beside an
effect that comes later it may be more."""


def asked_first(
    point: WorkingPoint, candidates: Sequence[Candidate]
) -> tuple[list[Candidate], list[Candidate]]:
    """Split the candidates: pre-screened in the non-rigid readings, and others."""
    found = {where for p in point.placed for where in p.effect.where}
    first = [(e, s) for e, s in candidates if _reads(e) is not None and e.where[0] not in found]
    chosen = {id(e) for e, _ in first}
    return first, [c for c in candidates if id(c[0]) not in chosen]


def shown_beyond(
    point: WorkingPoint, record: TraceRecord, candidates: Sequence[Candidate]
) -> Linearised:
    """Return the Gram matrices of sensor candidates in the non-rigid readings only.

    Each sensor's errors are those along the direction in which it shows. A form has the same
    columns at every sensor.
    """
    here = along(point, record)
    basis = redundancy_basis(record.places.sensor_shape)
    length = np.linalg.norm(basis, axis=1)
    errors = beyond_pose(here, readings(here)) @ (basis / np.maximum(length, TINY)[:, None]).T
    built: dict[tuple[str, tuple[float, ...]], list[Array]] = {}
    of_sensor: dict[int, list[int]] = {}
    columns: list[Array] = []
    for effect, shape in candidates:
        sensor, alike = _sensor(effect), (effect.key, shape)
        if alike not in built:
            terms = effect.build(here.signals, shape)
            gaps = (term.gap for term in terms)
            built[alike] = [thinned(g[:, sensor], here.every) for g in gaps if g is not None]
        at = of_sensor.setdefault(sensor, [])
        at += range(len(columns), len(columns) + len(built[alike]))
        columns += built[alike]
    total = len(columns)
    channels = []
    for sensor, numbers in of_sensor.items():
        each = [-length[sensor] / here.sd * columns[j] for j in numbers]
        values = np.stack([*each, errors[:, sensor]], axis=1)
        channels.append(ResidualChannel(values[:, None, :], [*numbers, total]))
    widths = [len(effect.amplitudes) for effect, _ in candidates]
    return grams(record, channels, 0, widths, here.every * record.experiment.Ts_s)


def worth_columns(
    candidates: Sequence[Candidate],
    shown: Sequence[Linearised],
    sensor_shape: Array,
    least: float,
    most: int,
) -> list[Candidate]:
    """Return the best candidates that may explain `least` squared errors, by the pre-screening.

    They are `most` at most. Of a false reading that share is expected there which the sensor has
    outside the pose; that is nearly all that there is of it, and in about the same order.
    """
    outside = (redundancy_basis(sensor_shape) ** 2).sum(axis=1)
    gained = [float(gain.sum()) for gain in gains(ColumnEvidence.gather(shown, np.zeros((0, 1))))]
    enough = [
        i
        for i, (effect, _) in enumerate(candidates)
        if not gained[i] < _SHARE * outside[_sensor(effect)] * least
    ]
    enough.sort(key=lambda i: -gained[i])
    best = list(dict.fromkeys(candidates[i][0].identity for i in enough))[:most]
    return [candidates[i] for i in sorted(enough) if candidates[i][0].identity in best]


def _reads(effect: Effect) -> int | None:
    """Return the sensor of a free form of a reading; None for other candidates."""
    if effect.effect_class != "unknown" or not effect.where[0].startswith("sensor:"):
        return None
    return int(effect.where[0].partition(":")[2])


def _sensor(effect: Effect) -> int:
    sensor = _reads(effect)
    assert sensor is not None
    return sensor
