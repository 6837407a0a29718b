"""Sensors of a plant with one output for each DOF: nonlinear, eccentric, late, mixed.

The position is a function of the reading, as a calibration states it, so that the force of a record
is linear in the numbers; the reading of a simulated motion follows from its inverse. A gain is told
only where parameters are of other DOF too, or where numbers are known: else it is a change of
units. Where a reading is a quadratic of the position, or 1 over a gap, the position is nearly a
ratio of polynomials of it. A cubic sensor at low frequencies is a cubic spring: inertia and
damping, which act on the true motion, tell the two apart. The lag of the only sensor is that of the
only actuator if the plant is linear.

The disk of an encoder that is not centred on its shaft reads a sine of the angle too much, once a
revolution. The signals of an encoder's two tracks are interpolated within each line of its scale:
an offset or a phase that is not a quarter of a line makes an error with the period of the lines.

Sources: Fleming, *A review of nanometer resolution position sensors*, Sensors and Actuators A 190,
2013 (nonlinearity, bandwidth, crosstalk); Hagiwara et al., *A method of processing the output
signal of rotary encoders*, IEEE Trans. Instrumentation and Measurement 41, 1992 (eccentricity);
Heydemann, *Determination and correction of quadrature fringe measurement errors in
interferometers*, Applied Optics 20, 1981 (interpolation).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline

from .base import Array, Effect, Places, Quantity, Signals, Term, on_sensor
from .coil_timing import late_starts, latest_s
from .force_units import per_unit, ratio
from .gravity import RADIANS
from .lag_and_hysteresis_recursions import lagged_motion
from .operating_range import EXCURSION, TRAVEL, Extent

_NEWTON_STEPS = 20
_LEAST_SLOPE = 0.1
"""Least change of the position per reading in Newton steps: a calibration does not turn back."""
_FAR = 0.5
"""Largest c r of a curve of the position: at 1 it would have a pole."""
_TYPICAL_LINES, _WIDER = 5.0, 2.0
"""Lines of a scale over the travel to start from if none is known; bounds beyond the start
values."""
_AMPLITUDES = "excitation at two amplitudes, up to frequencies where inertia counts"


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return gain, nonlinearity, lag, delay and crosstalk of every sensor; empty for the rig."""
    if places.beam or places.sensors != len(places.dof):
        return []
    found, single = list[Effect](), places.coils == len(places.dof) == 1
    if places.sensors > 1 and len(set(places.dof_units)) == 1:
        found.append(_gain(places, "reading.gain.all", "Gain of all sensors", slice(None)))
    for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
        found.append(_gain(places, "reading.gain", "Gain of the sensor", slice(i, i + 1)))
        for name, word, amplitude, power in (
            ("quadratic", "Quadratic", "a", 2),
            ("cubic", "Cubic", "b", 3),
        ):
            found.append(
                Effect(
                    f"reading.{name}",
                    f"{word} nonlinearity of the sensor",
                    "sensor_nonlinearity",
                    (dof,),
                    f"position = r + {amplitude} r^{power}, r the reading",
                    (Quantity(amplitude, per_unit(unit, power - 1)),),
                    partial(_power, sensor=i, power=power),
                    absorbed_by="at low frequencies: a nonlinear spring",
                    told_apart_by=_AMPLITUDES,
                    along_motion=partial(_bent_reading, sensor=i, power=power),
                )
            )
        found.append(_rational(i, dof, unit, extent))
        if unit in RADIANS and unit != "1":
            found.append(
                Effect(
                    "reading.eccentric",
                    "Eccentric encoder",
                    "sensor_nonlinearity",
                    (dof,),
                    "position = r + a sin r + b (cos r - 1), r the reading, in its sines in rad",
                    (Quantity("a", unit), Quantity("b", unit)),
                    partial(_eccentric, sensor=i, radians=RADIANS[unit]),
                    absorbed_by="at small angles: gain of the sensor",
                    told_apart_by="turning by a revolution or more",
                    along_motion=partial(_eccentric_reading, sensor=i, radians=RADIANS[unit]),
                )
            )
        found += _periodic(i, dof, unit, extent)
        found += [
            Effect(
                "reading.lag",
                "Lag of the sensor",
                "sensor_lag",
                (dof,),
                "position = r + lag r', r the reading",
                (Quantity("lag", "s", 0.0),),
                partial(_ahead, sensor=i),
                absorbed_by="of a linear plant with one input: a lag of the actuator",
                told_apart_by="a second sensor or another source of force",
                along_motion=partial(_lagged_reading, sensor=i),
                same_if_linear=("actuator_lag",) if single else (),
            ),
            Effect(
                "reading.delay",
                "Delay of the sensor",
                "sensor_delay",
                (dof,),
                "position = r + (r(t + back) - r) delay / back, r the reading",
                (Quantity("delay", "s", 0.0),),
                partial(_later, sensor=i),
                (Quantity("back", "s", 1e-4, latest_s(places, extent), log=True),),
                late_starts(places, extent),
                absorbed_by="of a linear plant with one input: a delay of the actuator",
                told_apart_by="a second sensor or another source of force",
                along_motion=partial(_delayed_reading, sensor=i),
                equal_numbers=("delay", "back"),
                same_if_linear=("delay",) if single else (),
            ),
        ]
        found += [
            Effect(
                "reading.crosstalk",
                "Reading with a part of another one",
                "sensor_crosstalk",
                (dof, other),
                "position = r + share r_2, r the readings of the first and the second",
                (Quantity("share", ratio(unit, places.dof_units[j])),),
                partial(_part_of, sensor=i, other=j),
                absorbed_by="free entries of the matrices between the two",
                told_apart_by="excitation of both, one at a time",
                along_motion=partial(_mixed_reading, sensor=i, other=j),
            )
            for j, other in enumerate(places.dof)
            if j != i
        ]
    return found


def _gain(places: Places, key: str, title: str, sensors: slice) -> Effect:
    return Effect(
        key,
        title,
        "sensor_gain",
        places.dof[sensors],
        "position = r - error r, r the reading",
        (Quantity("error", "1"),),
        partial(_too_much, sensors=sensors),
        absorbed_by="free entries of the matrices at the DOF, all of them together",
        told_apart_by="a known position, such as a stop",
        along_motion=partial(_scaled_reading, sensors=sensors),
        linear=True,
        exact=True,
    )


def _periodic(i: int, dof: str, unit: str, extent: Extent) -> list[Effect]:
    """Return the interpolation error of an encoder; none for a DOF that does not move."""
    typical = TRAVEL * extent.reach[i] / _TYPICAL_LINES
    if not typical > 0.0:
        return []
    pitches = (extent.scales[i] if extent.scales else ()) or (typical,)
    low, high = min(pitches) / _WIDER, _WIDER * max(pitches)
    return [
        Effect(
            "reading.periodic",
            "Interpolation error of the encoder",
            "sensor_nonlinearity",
            (dof,),
            "position = r + a sin(2 pi r / pitch) + b (cos(2 pi r / pitch) - 1), r the reading",
            (Quantity("a", unit), Quantity("b", unit)),
            partial(_waves, sensor=i),
            (Quantity("pitch", unit, low, high, log=True),),
            tuple((pitch,) for pitch in pitches),
            absorbed_by="pitch longer than the travel: gain of the sensor",
            told_apart_by="fast and slow motion: an error of the reading grows with the speed",
            along_motion=partial(_wavy_reading, sensor=i),
        )
    ]


def _rational(i: int, dof: str, unit: str, extent: Extent) -> Effect:
    """Return a sensor whose reading is a quadratic of the position, or 1 over a gap, or between."""
    most = _FAR / (abs(extent.around(i)) + EXCURSION * extent.reach[i])
    return Effect(
        "reading.rational",
        "Rational nonlinearity of the sensor",
        "sensor_nonlinearity",
        (dof,),
        "position = r + a r^2 / (1 + c r), r the reading",
        (Quantity("a", per_unit(unit, 1)),),
        partial(_curve, sensor=i),
        (Quantity("c", per_unit(unit, 1), -most, most),),
        ((-0.5 * most,), (0.5 * most,)),
        absorbed_by="at low frequencies: a nonlinear spring",
        told_apart_by=_AMPLITUDES,
        along_motion=partial(_curved_reading, sensor=i),
        contains={"reading.quadratic": _straight},
    )


def _straight(_shape: Sequence[float]) -> tuple[float, ...]:
    return ()


# The position less the reading, which a force balance subtracts as an error of the reading.


def _too_much(signals: Signals, _shape: Sequence[float], *, sensors: slice) -> list[Term]:
    return [Term(gap=_only(signals.q, sensors))]


def _only(q: Array, sensors: slice) -> Array:
    """Return positions (N, n) with zeros for all sensors but some."""
    found = np.zeros_like(q)
    found[:, sensors] = q[:, sensors]
    return found


def _power(signals: Signals, _shape: Sequence[float], *, sensor: int, power: int) -> list[Term]:
    r = signals.q[:, sensor]
    return [on_sensor(signals, sensor, -(r**power))]


def _curve(signals: Signals, shape: Sequence[float], *, sensor: int) -> list[Term]:
    r = signals.q[:, sensor]
    return [on_sensor(signals, sensor, -(r * r) / _below(1.0 + shape[0] * r))]


def _below(whole: Array) -> Array:
    """Return a denominator that is never near zero, which it is beyond all readings."""
    return np.maximum(whole, _LEAST_SLOPE)


def _eccentric(
    signals: Signals, _shape: Sequence[float], *, sensor: int, radians: float
) -> list[Term]:
    angle = radians * signals.q[:, sensor]
    return [on_sensor(signals, sensor, -x) for x in (np.sin(angle), np.cos(angle) - 1.0)]


def _waves(signals: Signals, shape: Sequence[float], *, sensor: int) -> list[Term]:
    return _eccentric(signals, (), sensor=sensor, radians=2.0 * np.pi / shape[0])


def _ahead(signals: Signals, _shape: Sequence[float], *, sensor: int) -> list[Term]:
    return [on_sensor(signals, sensor, -signals.qd[:, sensor])]


def _later(signals: Signals, shape: Sequence[float], *, sensor: int) -> list[Term]:
    r = signals.q[:, sensor]
    return [on_sensor(signals, sensor, (r - _moved(r, shape[0] / signals.Ts_s)) / shape[0])]


def _part_of(signals: Signals, _shape: Sequence[float], *, sensor: int, other: int) -> list[Term]:
    return [on_sensor(signals, sensor, -signals.q[:, other])]


# The reading less the position, of a motion that is known.


def _scaled_reading(
    signals: Signals, _shape: Sequence[float], amplitudes: Sequence[float], *, sensors: slice
) -> Term:
    error = amplitudes[0]
    return Term(gap=error / (1.0 - error) * _only(signals.q, sensors))


def _bent_reading(
    signals: Signals, _shape: Sequence[float], amplitudes: Sequence[float], *, sensor: int,
    power: int,
) -> Term:  # fmt: skip
    h, bend = signals.q[:, sensor], amplitudes[0]
    r = h.copy()
    for _ in range(_NEWTON_STEPS):
        slope = 1.0 + power * bend * r ** (power - 1)
        r = r - (r + bend * r**power - h) / np.maximum(slope, _LEAST_SLOPE)
    return on_sensor(signals, sensor, r - h)


def _curved_reading(
    signals: Signals, shape: Sequence[float], amplitudes: Sequence[float], *, sensor: int
) -> Term:
    h, a, c = signals.q[:, sensor], amplitudes[0], shape[0]
    r = h.copy()
    for _ in range(_NEWTON_STEPS):
        below = _below(1.0 + c * r)
        slope = 1.0 + a * r * (2.0 + c * r) / below**2
        r = r - (r + a * r * r / below - h) / np.maximum(slope, _LEAST_SLOPE)
    return on_sensor(signals, sensor, r - h)


def _eccentric_reading(
    signals: Signals, _shape: Sequence[float], amplitudes: Sequence[float], *, sensor: int,
    radians: float,
) -> Term:  # fmt: skip
    h, (a, b) = signals.q[:, sensor], amplitudes
    r = h.copy()
    for _ in range(_NEWTON_STEPS):
        sine, cosine = np.sin(radians * r), np.cos(radians * r)
        slope = 1.0 + radians * (a * cosine - b * sine)
        r = r - (r + a * sine + b * (cosine - 1.0) - h) / np.maximum(slope, _LEAST_SLOPE)
    return on_sensor(signals, sensor, r - h)


def _wavy_reading(
    signals: Signals, shape: Sequence[float], amplitudes: Sequence[float], *, sensor: int
) -> Term:
    radians = 2.0 * np.pi / shape[0]
    return _eccentric_reading(signals, (), amplitudes, sensor=sensor, radians=radians)


def _lagged_reading(
    signals: Signals, _shape: Sequence[float], amplitudes: Sequence[float], *, sensor: int
) -> Term:
    h, lag_s = signals.q[:, sensor], amplitudes[0]
    late = lagged_motion(h, lag_s, signals.Ts_s) if lag_s > 0.0 else h
    return on_sensor(signals, sensor, late - h)


def _delayed_reading(
    signals: Signals, _shape: Sequence[float], amplitudes: Sequence[float], *, sensor: int
) -> Term:
    h = signals.q[:, sensor]
    return on_sensor(signals, sensor, _moved(h, -amplitudes[0] / signals.Ts_s) - h)


def _mixed_reading(
    signals: Signals, _shape: Sequence[float], amplitudes: Sequence[float], *, sensor: int,
    other: int,
) -> Term:  # fmt: skip
    return on_sensor(signals, sensor, -amplitudes[0] * signals.q[:, other])


def _moved(values: Array, rows: float) -> Array:
    """Return samples (N,) at times that are `rows` later, the first or last one beyond the ends."""
    at = np.arange(len(values), dtype=float)
    return np.asarray(CubicSpline(at, values)(np.clip(at + rows, 0.0, at[-1])))
