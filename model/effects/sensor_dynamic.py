"""Dynamic sensor errors: lag, play, stick and jump, temporarily frozen readings.

A first-order lag in one channel; a reading with play; a reading that sticks and then jumps
(Visintin, *Differential Models of Hysteresis*, 1994, on play and stop); a reading that freezes for
a while, for example if the probe's electronics hang. Signature: each of these sensor errors appears
in the non-rigid part of the readings, with the pattern of one sensor. The error of a lag grows with
the speed; that of play has constant size and the sign of the speed. In small motions lag and play
still cause errors, but a sticking reading does not change at all. A frozen reading is wrong only
while it is constant and the other readings change.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_sensor
from .lag_and_hysteresis_recursions import held, jumping, lagged_motion, play
from .operating_range import Extent

_LAG_S = 2e-3
_MOST_DEPTH = 2.0
"""Bound of the depth; a fully frozen reading has 1, and its estimate scatters around 1."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return lag, play and stick of every sensor, and freezing of sensors with frozen readings."""
    found = []
    for s in range(places.sensors):
        where = (f"sensor:{s}",)
        found += [
            Effect(
                "sensor_lag",
                "Lag of a sensor",
                "sensor_lag",
                where,
                "reading = h + (h lagged by tail - h) lag / tail",
                (Quantity("lag", "s"),),
                partial(_lag, sensor=s),
                (Quantity("tail", "s", 1e-4, 0.2, log=True),),
                ((_LAG_S,),),
                told_apart_by="excitation at high frequencies",
            ),
            Effect(
                "sensor_stuck.play",
                "Play of a sensor",
                "sensor_stuck",
                where,
                "reading = h + depth (p - h), p within width of h moves only when h pushes it",
                (Quantity("depth", "1", 0.0, _MOST_DEPTH),),
                partial(_play, sensor=s),
                (Quantity("width", places.sensor_unit, 1e-3 * extent.gap, extent.gap, log=True),),
                ((0.1 * extent.gap,),),
                told_apart_by="small and large motions",
            ),
            Effect(
                "sensor_stuck.jump",
                "Sensor that sticks and jumps",
                "sensor_stuck",
                where,
                "reading = h + depth (p - h), p stays until h is more than width away",
                (Quantity("depth", "1", 0.0, _MOST_DEPTH),),
                partial(_jump, sensor=s),
                (Quantity("width", places.sensor_unit, 1e-3 * extent.gap, extent.gap, log=True),),
                ((0.1 * extent.gap,),),
                told_apart_by="small and large motions",
            ),
        ]
    found += [
        Effect(
            "sensor_stuck.stand",
            "Frozen reading of a sensor",
            "sensor_stuck",
            (f"sensor:{s}",),
            "reading = h + depth (p - h), p is h at the time of freezing",
            (Quantity("depth", "1", 0.0, _MOST_DEPTH),),
            partial(_stand, sensor=s),
            told_apart_by="readings constant within their noise while the platform moves",
        )
        for s in extent.stuck
    ]
    return found


def _lag(signals: Signals, shape: Sequence[float], *, sensor: int) -> list[Term]:
    h = signals.gap(sensor)
    return [on_sensor(signals, sensor, (lagged_motion(h, shape[0], signals.Ts_s) - h) / shape[0])]


def _play(signals: Signals, shape: Sequence[float], *, sensor: int) -> list[Term]:
    h = signals.gap(sensor)
    return [on_sensor(signals, sensor, play(h, shape[0], signals.Ts_s) - h)]


def _jump(signals: Signals, shape: Sequence[float], *, sensor: int) -> list[Term]:
    h = signals.gap(sensor)
    return [on_sensor(signals, sensor, jumping(h, shape[0], signals.Ts_s) - h)]


def _stand(signals: Signals, _shape: Sequence[float], *, sensor: int) -> list[Term]:
    h = signals.gap(sensor)
    if signals.stuck is None:
        return [on_sensor(signals, sensor, np.zeros_like(h))]
    return [on_sensor(signals, sensor, held(h, signals.stuck[:, sensor]) - h)]
