"""Find place, sign and scale of each sensor from the platform against its stops, lifted by hand.

The platform rests on its lower stops. Lifted as a whole against the upper ones, every sensor sees
the stroke: its reading gives sign and scale. Lifted at one side only, it turns about the stops of
the other side, and a sensor at x of a stroke between -a and a sees the share (x + a) / (2 a). So
each reading gives its own place, whatever the order of the channels; nothing is assumed of it but
that it is one of the places in RIG.yaml.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Array = NDArray[np.float64]

_LEAST_SHARE = 0.1
"""Share of the stroke that a sensor must show to count as alive."""
_EDGE_SHARE, _LEAST_ROWS = 0.02, 3
"""Part of a sensor's range at each end that does not count as inside, and fewest rows there: its
scale and its zero are found from them."""
_FAR_SHARE = 0.25
"""Distance between a found and its place, over that of neighbouring places, from which it is in
doubt: at a half, two places are equally near."""


@dataclass(frozen=True)
class SensorOrder:
    """Of each channel (S,): its place as an index into RIG.yaml's, -1 if dead; reading per metre.

    scale (S,): 1 if right, negative if its sign is wrong, 0 if dead. doubtful (S,): whether what
    was found lies between two places.
    """

    place: NDArray[np.int64]
    scale: Array
    doubtful: NDArray[np.bool_]

    @property
    def dead(self) -> NDArray[np.bool_]:
        """Channels that do not follow the platform."""
        return self.place < 0


@dataclass(frozen=True)
class Followed:
    """How each sensor (S,) follows the platform: reading per metre, and its place in m."""

    scale: Array
    x_m: Array
    y_m: Array


def at_the_stops(
    whole_m: Array, x_side_m: Array, y_side_m: Array, stops_m: tuple[float, float], stroke_m: float
) -> Followed:
    """Return scale and place of sensors from their changes (S,) against the resting platform.

    whole_m: lifted as a whole; x_side_m, y_side_m: at the side of positive x, or of positive y.
    stops_m: half the distance of the stops along x and y.
    """
    alive = np.abs(whole_m) > _LEAST_SHARE * stroke_m
    moved = np.where(alive, whole_m, np.inf)
    return Followed(
        np.where(alive, whole_m / stroke_m, 0.0),
        (2.0 * x_side_m / moved - 1.0) * stops_m[0],
        (2.0 * y_side_m / moved - 1.0) * stops_m[1],
    )


def on_the_way(
    reading_m: Array, pose: Array, x_m: Array, y_m: Array, stroke_m: float
) -> tuple[float, float, float]:
    """Return scale and place (x, y) of a sensor whose range ends before the stops.

    reading_m (n,): its readings at rest, held and in between. pose (n, 3): psi, theta, z of the
    platform, from other sensors. Of the places (S,) it is the one at which readings of the height,
    cut off where the sensor's are, agree best: a height that is never reached inside the range at
    one place tells it from another. A sensor that does not follow has scale 0.
    """
    low, high = float(reading_m.min()), float(reading_m.max())
    edge = _EDGE_SHARE * (high - low)
    inside = (reading_m > low + edge) & (reading_m < high - edge)
    if high - low < _LEAST_SHARE * stroke_m or inside.sum() < _LEAST_ROWS:
        return 0.0, 0.0, 0.0
    best, best_left = (0.0, 0.0, 0.0), np.inf
    for x, y in zip(x_m.tolist(), y_m.tolist(), strict=True):
        height = pose @ np.array([y, x, 1.0])
        columns = np.column_stack([height[inside], np.full(inside.sum(), stroke_m)])
        scale, offset = np.linalg.lstsq(columns, reading_m[inside], rcond=None)[0]
        cut = np.clip(scale * height + offset * stroke_m, low, high)
        left = float(np.sum((cut - reading_m) ** 2))
        if left < best_left and abs(scale) > _LEAST_SHARE:
            best, best_left = (float(scale), x, y), left
    return best


def sensor_order(found: Followed, x_m: Array, y_m: Array) -> SensorOrder:
    """Return the order of the channels; x_m, y_m (S,) are the places in RIG.yaml."""
    place, doubtful = places_of(found.x_m, found.y_m, found.scale != 0.0, x_m, y_m)
    return SensorOrder(place, found.scale, doubtful)


def places_of(
    found_x: Array, found_y: Array, alive: NDArray[np.bool_], x_m: Array, y_m: Array
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the place of each channel, each place once, and which are in doubt.

    The channels that are not alive have place -1.
    """
    channels = np.flatnonzero(alive & np.isfinite(found_x) & np.isfinite(found_y))
    distance = np.hypot(
        found_x[channels, None] - x_m[None, :], found_y[channels, None] - y_m[None, :]
    )
    rows, columns = linear_sum_assignment(distance**2)
    place = np.full(len(alive), -1)
    place[channels[rows]] = columns
    apart = np.hypot(x_m[:, None] - x_m[None, :], y_m[:, None] - y_m[None, :])
    nearest = float(apart[apart > 0.0].min())
    doubtful = np.zeros(len(alive), bool)
    doubtful[channels[rows]] = distance[rows, columns] > _FAR_SHARE * nearest
    return place, doubtful
