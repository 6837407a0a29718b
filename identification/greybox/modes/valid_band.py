"""Compute the band in which the declared model is valid, beside the modes that it lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .identify_in_loop import LoopFit
from .sampled_response import LinearPlant, continuous_response

Array = NDArray[np.float64]

_PER_DECADE = 200
_DRAWS = 100
_SURE = (2.5, 97.5)


@dataclass(frozen=True)
class ValidBand:
    """Where the declared model's error passes `share` of the response, and for which output.

    `end_hz`, with its 95 % interval from low_hz to high_hz; `complete` if the error stays below up
    to the end of the excited band, which is then `end_hz`. `by_mode`: whether a mode is the error;
    else neither the model nor a mode explains it.
    """

    end_hz: float
    low_hz: float
    high_hz: float
    share: float
    output: int
    complete: bool
    by_mode: bool


def valid_band(fit: LoopFit, share: float = 0.1) -> ValidBand:
    """Return the band up to which the declared part of the fitted plant is within `share` of it.

    The error is that of the diagonal of P without hold and lag, at all points of the schedule. It
    does not depend on the records' length: their noise widens the interval only. What the records
    show beyond that, and no mode explains, counts as well.
    """
    points = [p.schedule for p in fit.points]
    low, high = float(fit.points[0].freq_hz[0]), float(fit.points[0].freq_hz[-1])
    freq_hz = np.geomspace(low, high, max(int(_PER_DECADE * np.log10(high / low)), 50))
    end, output = _end(fit.plant, points, freq_hz, share)
    draws = np.random.default_rng(0).multivariate_normal(
        np.zeros(len(fit.names)), fit.covariance, _DRAWS, method="svd"
    )
    ends = [_end(_drawn(fit, d), points, freq_hz, share)[0] for d in draws]
    finite = np.where(np.isfinite([*ends, end]), [*ends, end], high)
    bounds = np.percentile(finite, _SURE)
    unexplained, other = _unexplained(fit, share)
    if unexplained < end:
        return ValidBand(unexplained, unexplained, unexplained, share, other, False, False)
    at = end if np.isfinite(end) else high
    return ValidBand(
        at, min(float(bounds[0]), at), max(float(bounds[1]), at), share, output, end == np.inf, True
    )


def _unexplained(fit: LoopFit, share: float) -> tuple[float, int]:
    """Return the first frequency at which more than `share` of an output is unexplained."""
    first, output = np.inf, 0
    for point, found in zip(fit.points, fit.residuals, strict=True):
        wrong = found.clear_error > share**2
        for i in range(wrong.shape[1]):
            if np.any(wrong[:, i]) and point.freq_hz[int(np.argmax(wrong[:, i]))] < first:
                first, output = float(point.freq_hz[int(np.argmax(wrong[:, i]))]), i
    return first, output


def _end(
    plant: LinearPlant, points: Sequence[Mapping[str, float]], freq_hz: Array, share: float
) -> tuple[float, int]:
    """Return the first frequency with a larger error, infinite without one, and its output."""
    first, output = np.inf, 0
    for schedule in points:
        whole = continuous_response(plant, schedule, freq_hz)
        rigid = continuous_response(replace(plant, modes=()), schedule, freq_hz)
        for i in range(min(whole.shape[1:])):
            wrong = np.abs(rigid[:, i, i] - whole[:, i, i]) > share * np.abs(whole[:, i, i])
            if np.any(wrong) and freq_hz[int(np.argmax(wrong))] < first:
                first, output = float(freq_hz[int(np.argmax(wrong))]), i
    return first, output


def _drawn(fit: LoopFit, step: Array) -> LinearPlant:
    """Return the plant after a step, without lags and dampings below zero."""
    values, lags = fit.plant.model.values, fit.plant.model.lag.names
    for k, name in enumerate(fit.names):
        if isinstance(name, str):
            step[k] = max(step[k], -values[name]) if name in lags else step[k]
        elif len(name) == 2 and name[1] == "damping":
            step[k] = max(step[k], -0.99 * fit.plant.modes[name[0]].damping)
    return fit.plant.moved(fit.names, step)
