"""Sensors that are late or that stick: a filter in one channel, a reading that follows with play.

A first-order filter in one channel; a reading that follows with play; one that stays and then jumps
(Visintin, *Differential Models of Hysteresis*, 1994, on play and stop). Signature: all show beyond
the rigid platform with one sensor's pattern; a lag grows with the speed, play keeps its height at
every speed and follows the sign of the speed, and both are there in small motions, where what jumps
shows nothing at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from .base import Effect, Places, Quantity, Signals, Term, on_sensor
from .extent import Extent
from .recursions import jumping, lagged, play

_LAG_S = 2e-3


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return lag and play of every sensor."""
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
                "Sensor that follows with play",
                "sensor_stuck",
                where,
                "reading = h + depth (p - h), p within width of h moves only when h pushes it",
                (Quantity("depth", "1", 0.0, 1.0),),
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
                "reading = h + depth (p - h), p stays until h is further than width away",
                (Quantity("depth", "1", 0.0, 1.0),),
                partial(_jump, sensor=s),
                (Quantity("width", places.sensor_unit, 1e-3 * extent.gap, extent.gap, log=True),),
                ((0.1 * extent.gap,),),
                told_apart_by="small and large motions",
            ),
        ]
    return found


def _lag(signals: Signals, shape: Sequence[float], *, sensor: int) -> list[Term]:
    h = signals.gap(sensor)
    return [on_sensor(signals, sensor, (lagged(h, shape[0], signals.Ts_s) - h) / shape[0])]


def _play(signals: Signals, shape: Sequence[float], *, sensor: int) -> list[Term]:
    h = signals.gap(sensor)
    return [on_sensor(signals, sensor, play(h, shape[0], signals.Ts_s) - h)]


def _jump(signals: Signals, shape: Sequence[float], *, sensor: int) -> list[Term]:
    h = signals.gap(sensor)
    return [on_sensor(signals, sensor, jumping(h, shape[0], signals.Ts_s) - h)]
