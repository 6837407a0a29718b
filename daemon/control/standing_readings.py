"""Find readings that stand still although the noise of their sensor should move them.

A sensor's reading is a multiple of its step. With white noise of standard deviation s it
repeats with at most the probability p = erf(step / (2 sqrt(2) s)), which it has where the true
height is in the middle of a step. n repeats in a row have at most p^n, so -ln(p) of *evidence*
comes with each repeat. `rest_noise` measures step, s and p of each channel at zero force, where
nothing else moves the readings. Nothing is assumed of the converter.

A reading stands still once the evidence exceeds the limit: `evidence_limit` makes it once in a
thousand years of all sensors together. Where the noise is below about a third of the step, repeats
are normal and give no evidence: then `ForceRule` judges by the commanded force, and the plane
through the other readings by where they are. That the others move is no evidence within cycles: a
platform that is not rigid may stand still at one sensor while it moves at the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FALSE_ALARMS_A_YEAR = 1e-3
"""False alarms of one check on a rig that flies without a pause."""
_YEAR_S = 365.25 * 86_400.0
LEAST_ROWS = 40
"""Fewest readings from which the noise is estimated."""
MOST_ROWS = 500
"""Newest readings that are used."""
COUNTED_NOISE = 0.4
"""Noise over the step from which 200 readings show that repeats are rare."""
LEAST_STEP = 1e-6
"""Step over the gap limit below which changes are no noise: a simulated platform without noise
comes to rest by ever smaller steps."""
_SIGMAS = 3.1
"""Estimates of the noise are lower bounds with a confidence of 99.9 %."""
_NATS = 0.5 * _SIGMAS**2
_COARSE = 4.0
"""Variance in squared steps up to which the distribution over the steps is fitted."""
_MOST_REPEATS = 0.96
"""Repeat probability above which repeats are normal."""
_TRIED = np.geomspace(0.25, 6.0, 48)
_ODD_ONES = 1e-3
"""Share of readings that need not come from the noise."""
_AROUND = np.linspace(-0.6, 0.6, 13)
_AT_EDGE = np.linspace(-2.5, 2.5, 27)
_X = np.linspace(-9.0, 9.0, 4001)
_NORMAL = np.array([0.5 * math.erfc(-x / math.sqrt(2.0)) for x in _X])


@dataclass(frozen=True)
class RestNoise:
    """Noise of S sensors as measured at zero force.

    step_m (S,): smallest difference of two readings, infinite if all are equal. noise_m (S,):
    standard deviation. repeat (S,): upper bound of the probability that a reading repeats, 1 where
    repeats are normal.
    """

    step_m: Array
    noise_m: Array
    repeat: Array


def evidence_limit(sensors: int, rate_hz: float) -> float:
    """Return -ln of the probability of one test, which gives FALSE_ALARMS_A_YEAR at this rate."""
    return math.log(sensors * rate_hz * _YEAR_S / FALSE_ALARMS_A_YEAR)


def repeats_until_found(repeat: float, sensors: int, rate_hz: float) -> float:
    """Return the equal readings in a row that make a fault, infinite if repeats are normal."""
    return (
        math.inf
        if repeat >= 1.0
        else math.ceil(evidence_limit(sensors, rate_hz) / -math.log(repeat))
    )


def repeat_probability(step_m: float, noise_m: float) -> float:
    """Return the largest probability that a reading with white noise repeats."""
    return math.erf(step_m / (2.0 * math.sqrt(2.0) * noise_m)) if noise_m > 0.0 else 1.0


def rest_noise(gap_m: Array, least_step_m: float) -> RestNoise:
    """Measure the noise of readings (n, S) in m at zero force, of n >= LEAST_ROWS cycles.

    Changes below half of `least_step_m` are none.
    """
    newest = np.asarray(gap_m, float)[-MOST_ROWS:]
    return RestNoise(*np.array([_of_channel(y, least_step_m) for y in newest.T]).T)


def _of_channel(y: Array, least_step_m: float) -> tuple[float, float, float]:
    levels = np.unique(y)
    if len(levels) == 1:
        return math.inf, 0.0, 1.0
    step = max(float(np.diff(levels).min()), least_step_m)
    number = np.rint((y - levels[0]) / step)
    by_noise = repeat_probability(1.0, _least_noise(number))
    again = np.diff(y) == 0.0
    seen = _upper_bound(float(again.mean()), len(again))  # a converter may be slower than the cycle
    return step, float(y.std()), max(by_noise, seen) if by_noise < _MOST_REPEATS else 1.0


def _least_noise(number: Array) -> float:
    """Return the lower bound of the noise in steps, 0 if the readings do not exclude that.

    number (n,): the readings in steps. Third differences leave the noise and remove what moves the
    platform slowly, such as a machine nearby: a lower bound must not count that as noise.
    """
    n, variance = len(number), float(number.var())
    white = float(np.mean(np.diff(number, 3) ** 2)) / 20.0
    # The relative standard deviation of `white` is sqrt(4.62 / n).
    at_least = white * math.exp(-_SIGMAS * math.sqrt(4.62 / n))
    if variance <= _COARSE and white > 0.5 * variance:
        return _fitted_noise(number)
    # Without noise, a height at the edge of a step may toggle: a variance of 1/4.
    return math.sqrt(max(at_least - 0.25, 0.0))


def _fitted_noise(number: Array) -> float:
    """Return the smallest noise in steps whose likelihood, with its best height, is credible.

    A height at the edge between two steps toggles with however little noise: only readings on
    three or more steps exclude that there is none.
    """
    level, count = np.unique(number, return_counts=True)
    mean = number.mean()
    at_edge = math.floor(mean) + 0.5 + np.outer(_TRIED, _AT_EDGE)
    height = np.hstack([np.tile(mean + _AROUND, (len(_TRIED), 1)), at_edge])[..., None]
    above, below = ((level + half - height) / _TRIED[:, None, None] for half in (0.5, -0.5))
    share = np.interp(above, _X, _NORMAL) - np.interp(below, _X, _NORMAL)
    likelihood = (count * np.log((1.0 - _ODD_ONES) * share + _ODD_ONES)).sum(axis=2).max(axis=1)
    first = int(np.argmax(likelihood >= likelihood.max() - _NATS))
    return float(_TRIED[first - 1]) if first else 0.0  # the bound is above the one before


def _upper_bound(share: float, n: int) -> float:
    """Return the upper bound of a probability, by Wilson's interval."""
    z2 = _SIGMAS**2
    spread = _SIGMAS * math.sqrt(share * (1.0 - share) / n + z2 / (4.0 * n * n))
    return min((share + z2 / (2.0 * n) + spread) / (1.0 + z2 / n), 1.0 - 1.0 / (4.0 * n))
