"""Find a sensor that is off the plane through the other sensors, and those that it may be.

The readings y (S,) of a rigid platform are y = S q, so their residual r = P y with P = I - S S^+ is
zero. An error e of sensor j gives r = e P[:, j]. The averaged residual therefore gives each
sensor's error, if it alone has one: e_j = r_j / P_jj, its distance from the plane through the
others, and explains r_j^2 / P_jj of the residual's square. The sensor that explains most is named.
Where columns of P are parallel, sensors explain the same and cannot be told apart, as with one
sensor more than DOF; where P_jj is zero, as with as many sensors as DOF, no error of j shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...model.geometry import decoupling_matrix, shape_matrix

Array = NDArray[np.float64]

AVERAGE_S = 0.1
"""Time constant of the averaged residual: a wrong reading in one cycle, and vibrations of a
platform that is not rigid, from about 10 Hz on, average out. An error of 0.5 mm is found after
0.02 s, of 0.2 mm after 0.07 s, with the default limit."""
_LEAST_SHARE = 1e-6
_ALIKE = 0.9
"""Share of the explained square above which a sensor is as good an explanation as the best one: its
column of P is within 18 degrees of the best one's, and levels differ by some percent."""


@dataclass(frozen=True)
class Residual:
    """Residual of S sensors: projector P (S, S), 1 / P_jj (S,), 0 where P_jj is, and S (S, 3)."""

    projector: Array
    inverse_share: Array
    shape: Array

    @property
    def unseen(self) -> list[int]:
        """Sensors whose error does not show in the residual."""
        return [int(j) for j in np.flatnonzero(self.inverse_share == 0.0)]

    @property
    def alike(self) -> list[list[int]]:
        """Groups of sensors whose errors cannot be told apart."""
        share = np.sqrt(self.inverse_share)
        same = (self.projector * share * share[:, None]) ** 2 > _ALIKE
        groups = {tuple(map(int, np.flatnonzero(row))) for row in same}
        return sorted([list(group) for group in groups if len(group) > 1])


def residual_projector(x_m: Sequence[float], y_m: Sequence[float]) -> Residual:
    """Return the residual of sensors at these points."""
    shape = shape_matrix(x_m, y_m)
    projector = np.eye(len(shape)) - shape @ decoupling_matrix(x_m, y_m)
    share = np.diag(projector)
    seen = share > _LEAST_SHARE
    inverse = np.where(seen, 1.0 / np.where(seen, share, 1.0), 0.0)
    return Residual(projector, inverse, shape)


def averaging_cycles(error_m: float, limit_m: float, rate_hz: float, evidence: float) -> float:
    """Return the time constant of the average in cycles, at least AVERAGE_S.

    error_m: standard deviation of a sensor's error in one cycle, by noise. The averaged error
    exceeds half the limit with a probability of exp(-evidence).
    """
    return max(AVERAGE_S * rate_hz, 4.0 * evidence * (error_m / limit_m) ** 2, 1.0)


def suspects(mean_m: Array, projector: Array) -> list[int]:
    """Return the sensors that may be off by averaged residuals (S,) in m, the likeliest first.

    The list is empty if no error shows.
    """
    share = np.diag(projector)
    seen = share > _LEAST_SHARE
    explained = np.where(seen, mean_m**2 / np.where(seen, share, 1.0), 0.0)
    best = int(np.argmax(explained))
    if not explained[best] > 0.0:
        return []
    alike = np.flatnonzero(explained >= _ALIKE * explained[best])
    return [best, *(int(j) for j in alike if j != best)]


def plane_text(mean_m: Array, newest_m: Array, projector: Array, limit_m: float) -> str:
    """Return which sensor is off and how far, by residuals (S,) in m; empty within the limit.

    mean_m: averaged residuals, which are compared with the limit. newest_m: of the newest readings.
    """
    may_be = suspects(mean_m, projector)
    if not may_be:
        return ""
    first, share = may_be[0], projector[may_be[0], may_be[0]]
    if abs(mean_m[first]) <= share * limit_m:
        return ""
    error_m = max(mean_m[first], newest_m[first], key=abs) / share
    if len(may_be) == 1:
        subject, sign, more = f"sensor {first}", "+", ""
    else:
        *names, last = map(str, sorted(may_be))
        subject, sign = f"sensor {', '.join(names)} or {last}", ""
        more = "; too few sensors to tell which one"
        error_m = abs(error_m)
    return (
        f"{subject} is {1e3 * error_m:{sign}.3f} mm off the plane through the other sensors, "
        f"expected at most {1e3 * limit_m:g} mm{more}"
    )


def detection_s(error_m: float, limit_m: float) -> float:
    """Return the time in s after which a sensor that is off at once by error_m is found."""
    return math.inf if error_m <= limit_m else -AVERAGE_S * math.log1p(-limit_m / error_m)


@njit(cache=True)
def off_plane(mean, inverse_share):  # type: ignore[no-untyped-def]
    """Return the sensor that explains most of the averaged residual (S,)."""
    best, most = 0, -1.0
    for j in range(mean.size):
        explained = mean[j] * mean[j] * inverse_share[j]
        if explained > most:
            best, most = j, explained
    return best
