"""Check the readings of all sensors in every cycle; compiled, the same on every backend.

A sensor's reading may stand still (see standing_readings), lie off the plane through the readings
of the others (see plane_residual), or jump alone. Each is the fault SENSOR. Readings of a cycle in
which the device did not answer are old readings and are not checked.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...log.signals import Stale
from .force_without_motion import (
    FORCE_FOUND,
    FORCE_HEAD,
    FORCE_SENSOR,
    ForceRule,
    note_force,
)
from .plane_residual import averaging_cycles, off_plane, plane_text, residual_projector
from .standing_readings import LEAST_ROWS, LEAST_STEP, RestNoise, evidence_limit, rest_noise

Array = NDArray[np.float64]

_OLD = int(Stale.SENSORS)

# Scalars, then those of the force rule.
(
    _FOUND, _WHERE, _AMOUNT, _EVIDENCE, _WEIGHT, _PLANE, _COARSE,
) = range(7)  # fmt: skip
_FORCE_HEAD = 7
_HEAD = _FORCE_HEAD + FORCE_HEAD
# Of each sensor: newest reading, repeats, averaged residual; evidence of a repeat in nats, step;
# one over its residual's share of its error (0: not seen by the others); row of the shape matrix.
_LAST, _REPEATS, _MEAN, _NATS, _STEP, _SHARE = range(6)
_SHAPE, _FORCE_AT = slice(6, 9), 9
_SENSOR = _FORCE_AT + FORCE_SENSOR
_STANDS, _OFF, _JUMPED, _WITHOUT_MOTION = 1, 2, 3, 4


@njit(cache=True)
def checks_size(sensors) -> int:  # type: ignore[no-untyped-def]
    """Return how many numbers the checks keep in the controller's memory."""
    return _HEAD + sensors * (_SENSOR + sensors)  # type: ignore[no-any-return]


class SensorChecks:
    """Set up the checks of S sensors, learn their noise at rest, and say what was found.

    Args:
        rig: geometry, limits and model.
        period_s: cycle period in s.
        memory: array of `checks_size` numbers, part of the controller's memory.
    """

    def __init__(self, rig: RigConfig, period_s: float, memory: Array) -> None:
        x, y = rig.geometry.sensors_x_m, rig.geometry.sensors_y_m
        count = len(x)
        self._rig, self._rate_hz = rig, 1.0 / period_s
        self._head, sensors, projector = np.split(memory, [_HEAD, _HEAD + count * _SENSOR])
        self._sensors = sensors.reshape(count, _SENSOR)
        memory[:] = 0.0
        found = residual_projector(x, y)
        projector[:] = found.projector.ravel()
        self._sensors[:, _SHARE] = found.inverse_share
        self._sensors[:, _SHAPE] = found.shape
        self._projector = found.projector
        self._head[_EVIDENCE] = evidence_limit(count, self._rate_hz)
        self._head[_PLANE] = rig.plane_m
        self._force = ForceRule(
            rig, period_s, self._head[_FORCE_HEAD:], self._sensors[:, _FORCE_AT:]
        )
        self._least_step_m = LEAST_STEP * rig.limits.gap_m
        self._earlier: RestNoise | None = None
        self.forget()

    def forget(self) -> None:
        """Forget noise and readings: the sensors may be others, or repaired."""
        sensors = self._sensors
        # Unknown: no repeat is evidence.
        sensors[:, _NATS], sensors[:, _STEP] = 0.0, math.inf
        self._average(None)
        self._begin()

    def learn(self, rows: NDArray[np.void]) -> str:
        """Measure the noise in cycle records (n,) at zero force, and begin the checks.

        Return what is wrong, empty if nothing is: a sensor that had noise before repeats a single
        reading. Fewer than LEAST_ROWS records with new readings leave the noise unknown.
        """
        rows = rows[(rows["stale"] & _OLD) == 0]
        self.forget()
        if len(rows) < LEAST_ROWS:
            return ""
        noise, sensors = rest_noise(rows["gap_m"], self._least_step_m), self._sensors
        if self._earlier is not None:
            expected = (len(rows) - 1) * -np.log(self._earlier.repeat)
            standing = np.flatnonzero(np.isinf(noise.step_m) & (expected > self._head[_EVIDENCE]))
            if len(standing):
                return f"{_named(standing, len(sensors))} at rest, with noise before"
        self._earlier = noise
        sensors[:, _NATS] = -np.log(noise.repeat)
        sensors[:, _STEP] = noise.step_m
        self._head[_COARSE] = float(np.any(noise.repeat >= 1.0))
        self._average(noise)
        return ""

    def engage(self) -> None:
        """Note that control begins."""
        self._force.begin()

    def text(self) -> str:
        """Return which sensor was found, and what is wrong with it; empty if nothing was."""
        found, where, amount = int(self._head[_FOUND]), int(self._head[_WHERE]), self._head[_AMOUNT]
        sensors = self._sensors
        if found in (_STANDS, _WITHOUT_MOTION):
            standing = np.flatnonzero(sensors[:, _REPEATS] >= max(0.5 * amount, 1.0))
            words = f"{_named(standing, len(sensors))} for {amount:.0f} cycles"
            return words if found == _STANDS else f"{words} while the commanded force changed"
        if found == _OFF:
            # The average follows with a delay: the newest readings tell how far.
            residual = self._projector @ sensors[:, _LAST]
            text = plane_text(sensors[:, _MEAN], residual, self._projector, self._head[_PLANE])
            repeats = sensors[where, _REPEATS]
            stood = repeats * self._head[_WEIGHT] >= 1.0
            return f"{text}; it repeats its reading for {repeats:.0f} cycles" if stood else text
        if found == _JUMPED:
            return f"sensor {where} jumped by {1e3 * amount:.3f} mm, the others did not"
        return ""

    def repeats(self, sensor: int) -> int:
        """Return for how many cycles a sensor has repeated its reading."""
        return int(self._sensors[sensor, _REPEATS])

    def _begin(self) -> None:
        sensors = self._sensors
        sensors[:, _LAST] = math.nan
        sensors[:, _REPEATS] = sensors[:, _MEAN] = 0.0
        self._head[:3] = 0.0
        self._head[_COARSE] = 1.0
        self._force.begin()

    def _average(self, noise: RestNoise | None) -> None:
        noise_m = np.zeros(len(self._sensors)) if noise is None else noise.noise_m
        error_m = float((noise_m * np.sqrt(self._sensors[:, _SHARE])).max())
        self._head[_WEIGHT] = 1.0 / averaging_cycles(
            error_m, self._head[_PLANE], self._rate_hz, self._head[_EVIDENCE]
        )


def _named(standing: NDArray[np.intp], count: int) -> str:
    names = [str(number) for number in standing]
    if len(names) == count:
        return f"all {count} sensors repeat their readings"
    if len(names) == 1:
        return f"sensor {names[0]} repeats its reading"
    return f"sensors {', '.join(names[:-1])} and {names[-1]} repeat their readings"


@njit(cache=True)
def check_sensors(  # type: ignore[no-untyped-def]
    gap, pose, stale, memory
) -> bool:
    """Check the readings of a cycle; return whether a sensor is at fault.

    control_cycle contains the compiled code: touch its file after a change here.
    """
    if stale & _OLD:
        return False
    n = gap.size
    head, end = memory[:_HEAD], _HEAD + n * _SENSOR
    sensors = memory[_HEAD:end].reshape(n, _SENSOR)
    found, off = 0, False
    for j in range(n):
        own = sensors[j]
        if gap[j] != own[_LAST]:
            if own[_NATS] == 0.0:  # the step was not seen at rest, or not reliably
                own[_STEP] = min(own[_STEP], abs(gap[j] - own[_LAST]))
            own[_LAST] = gap[j]
            own[_REPEATS] = 0.0
        else:
            own[_REPEATS] += 1.0
            if own[_REPEATS] * own[_NATS] > head[_EVIDENCE]:
                found = j + 1
        residual = gap[j] - (own[6] * pose[0] + own[7] * pose[1] + own[8] * pose[2])
        own[_MEAN] += head[_WEIGHT] * (residual - own[_MEAN])
        off = off or abs(own[_MEAN]) * own[_SHARE] > head[_PLANE]
    if found:
        head[_FOUND], head[_WHERE] = _STANDS, found - 1
        head[_AMOUNT] = sensors[found - 1, _REPEATS]
        return True
    if head[_COARSE] > 0.0:
        at = int(head[_FORCE_HEAD + FORCE_FOUND]) - 1
        head[_FORCE_HEAD + FORCE_FOUND] = 0.0
        if at >= 0 and sensors[at, _REPEATS] > 0.0:
            head[_FOUND], head[_WHERE] = _WITHOUT_MOTION, at
            head[_AMOUNT] = sensors[at, _REPEATS]
            return True
    if off:
        at = off_plane(sensors[:, _MEAN], sensors[:, _SHARE])
        error = sensors[at, _MEAN] * sensors[at, _SHARE]
        if abs(error) > head[_PLANE]:
            head[_FOUND], head[_WHERE], head[_AMOUNT] = _OFF, at, error
            return True
    return False


@njit(cache=True)
def jumped(gap, before, most, memory) -> bool:  # type: ignore[no-untyped-def]
    """Return whether one reading alone explains a change by more than `most` in m since `before`.

    The changes of the others, and of this one without its error, stay within `most`.
    """
    n = gap.size
    head, end = memory[:_HEAD], _HEAD + n * _SENSOR
    sensors, projector = memory[_HEAD:end].reshape(n, _SENSOR), memory[end:]
    for j in range(n):
        error = 0.0
        for i in range(n):
            error += projector[j * n + i] * (gap[i] - before[i])
        error *= sensors[j, _SHARE]
        alone = True
        for i in range(n):
            change = gap[i] - before[i] - (error if i == j else 0.0)
            alone = alone and abs(change) <= most
        if alone:
            head[_FOUND], head[_WHERE], head[_AMOUNT] = _JUMPED, j, error
            return True
    return False


@njit(cache=True)
def note_command(  # type: ignore[no-untyped-def]
    coil, coil_shape, planned, share, steady, n_sensors, memory
) -> None:
    """Note the commanded coil forces (C,), which act from the next cycle on; see note_force."""
    head = memory[:_HEAD]
    if head[_COARSE] > 0.0:
        sensors = memory[_HEAD : _HEAD + n_sensors * _SENSOR].reshape(n_sensors, _SENSOR)
        note_force(
            coil, coil_shape, planned, share, steady, head[_FORCE_HEAD:], sensors[:, _FORCE_AT:],
            sensors[:, _REPEATS], sensors[:, _STEP],
        )  # fmt: skip
