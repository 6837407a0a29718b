"""Measure the share of the sensors' noise that effects in the readings remove with their motion.

An effect in the readings is computed from the measured motion, which contains the noise of the
same readings: a reading corrected by 8 % of its motion has 8 % less of the noise that the filter
follows. That lowers the squared errors and explains nothing. Simulated noise, added to the record,
shows how much; forces act on later readings only, so that effects of force remove none.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...greybox.prediction.discretisation import motion
from ...greybox.prediction.prediction_errors import predict_along
from ..records.record_from_log import TraceRecord
from .gram_matrices import block_edges
from .innovations_filter_bank import thinned
from .linearisation_point import WorkingPoint, along, corrected_experiment, filtered

Array = NDArray[np.float64]


def noise_removed(point: WorkingPoint, record: TraceRecord) -> Array:
    """Return the squared errors of noise that the point's effects remove, by block (B,).

    The simulated noise has the covariance of the sensors' and a fixed seed. Zeros if no effect of
    the point acts in the readings.
    """
    at = motion(point.model, record.experiment, point.hold)
    _, added = filtered(point, record, at)
    here = along(point, record)
    edges = block_edges(len(here.errors), here.every * record.experiment.Ts_s)
    if added.gap is None:
        return np.zeros(len(edges) - 1)
    e = record.experiment
    root = np.linalg.cholesky(point.disturbance.noise.output_covariance)
    noise = np.random.default_rng(0).standard_normal(e.y.shape) @ root.T
    noisy = replace(record, experiment=replace(e, y=e.y + noise))
    corrected, driven = corrected_experiment(point, noisy, at, added)
    passed = thinned(predict_along(driven, corrected, here.kalman).errors, here.every)
    left = along(point, noisy).errors
    squares = np.sum((passed - here.errors) ** 2 - (left - here.errors) ** 2, axis=1)
    return np.array([squares[a:b].sum() for a, b in pairwise(edges.tolist())])
