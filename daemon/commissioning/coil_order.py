"""Find place, polarity and relative gain of each coil from small forces on the resting platform.

Stops yield a little: a coil that takes a part of the weight off them moves the platform by some
tenths of a micrometre, up, and tilts it towards the other side. With sensors whose order is known
the pose gives the force's point of attack: the tilts per height are proportional to its x and y.
The compliance of the stops to height and tilts is unknown; it is the same for all coils, and fitted
with them. What remains of a coil is its height per force: its sign is the polarity, its size the
gain relative to the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from .errors import CommissionError
from .sensor_order import places_of

Array = NDArray[np.float64]

_DEAD_SHARE = 0.2
"""Response below this share of the median is none: gains differ by less."""
_MOST_CHOICES = 20_000
"""Of places that dead coils may have left free: so many are tried in a second."""
_LEAST_SIGMA = 8.0
"""Response over its own uncertainty that a coil must reach to be judged."""


@dataclass(frozen=True)
class CoilOrder:
    """Of each channel (C,): its place as an index into RIG.yaml's, -1 if dead; relative gain.

    gain (C,): 1 in the median of those alive, negative if the polarity is wrong, 0 if dead.
    doubtful (C,): whether what was found lies between two places.
    """

    place: NDArray[np.int64]
    gain: Array
    doubtful: NDArray[np.bool_]

    @property
    def dead(self) -> NDArray[np.bool_]:
        """Channels that do not move the platform."""
        return self.place < 0


def coil_order(pose: Array, pose_sd: Array, x_m: Array, y_m: Array) -> CoilOrder:
    """Return the order of the coils from the pose (C, 3) per force of each channel.

    pose: psi in rad, theta in rad, z in m, each per N; pose_sd (3,): their standard deviation.
    x_m, y_m (C,): the places in RIG.yaml.

    Raises:
        CommissionError: most coils do not move the platform.
    """
    lifted, sd = pose[:, 2], pose_sd[2]
    size = np.abs(lifted)
    heard = size > _LEAST_SIGMA * sd
    if 2 * heard.sum() < len(heard):
        raise CommissionError(
            f"{len(heard) - heard.sum()} of {len(heard)} coils move the platform by less than "
            f"{_LEAST_SIGMA:g} times its noise: give them more force (--force-n), or check their "
            "supply"
        )
    usual = float(np.median(size[heard])) if heard.any() else np.inf
    alive = heard & (size > _DEAD_SHARE * usual)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope_x, slope_y = pose[:, 1] / lifted, pose[:, 0] / lifted
    found_x = _scaled(slope_x, alive, x_m)
    found_y = _scaled(slope_y, alive, y_m)
    place, doubtful = places_of(found_x, found_y, alive, x_m, y_m)
    gain = np.where(alive, lifted / np.median(size[alive]) if alive.any() else 0.0, 0.0)
    return CoilOrder(place, gain, doubtful)


def _scaled(slope: Array, alive: NDArray[np.bool_], places_m: Array) -> Array:
    """Return positions (C,) in m from tilts per height, whose unit is not known.

    Both lists, sorted, belong together, up to a factor: that of least squares. A dead coil leaves a
    place free, and it may be any, so all are tried.
    """
    known = np.sort(slope[alive])
    ordered = np.sort(places_m)
    best, best_left = 1.0, np.inf
    if math.comb(len(ordered), len(known)) > _MOST_CHOICES:
        return np.full(len(slope), np.nan)
    for chosen in set(combinations(ordered.tolist(), len(known))):
        places, power = np.array(chosen), float(known @ known)
        factor = float(known @ places) / power if power else 1.0
        left = float(np.sum((factor * known - places) ** 2))
        if left < best_left:
            best, best_left = factor, left
    return np.asarray(best * slope)
