"""Guide the first contact with a rig: sensors by hand, then coils with forces that cannot lift."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...model.geometry import shape_matrix
from ..control.feed_forward import feed_forward
from .answer_delays import Delay, Swings, delay_of_moves, delay_of_swings, swings
from .beam_direction import BeamDirection, beam_direction, tilt_compliance
from .coil_order import CoilOrder, coil_order
from .device_session import DeviceSession, Readings
from .encoder_scales import Axis, EncoderScale, Measure, encoder_scale
from .errors import CommissionError
from .resting_readings import Resting, clipped, resting
from .sensor_order import Followed, SensorOrder, at_the_stops, on_the_way, sensor_order

Array = NDArray[np.float64]

_REST_S = 2.0
_LOOK_S, _STILL_WINDOWS = 0.1, 5
"""Time of a mean, and how many of them must agree for the platform to count as held still."""
_MOVED_SHARE, _STILL_SHARE = 0.1, 0.01
"""Changes over the stroke: from one held pose to the next, and within one."""
_HAND_S = 180.0
_BEAM_LOOK_S, _BEAM_MOVES = 0.5, 3
_TURN_RAD = np.pi / 6.0
_ACTED_SHARE = 0.97
"""Of the largest change of the measured force: one of 25 settled cycles without force is less."""
_SD_OF_MAD = 1.4826
_PULSE_S, _SETTLED_SHARE, _PULSES = 0.1, 0.5, 10
"""A coil pushes up for half of a pulse and down for the other; of each, the last half counts."""


class Hold(StrEnum):
    """How the operator holds the platform."""

    REST = "rest"
    WHOLE = "all"
    X_SIDE = "x"
    Y_SIDE = "y"


PROMPTS = {
    Hold.WHOLE: "Lift the whole platform against its upper stops, and hold it there.",
    Hold.X_SIDE: "Lift only the side of positive x against its upper stops; the other side stays "
    "on the lower ones.",
    Hold.Y_SIDE: "Lift only the side of positive y against its upper stops; the other side stays "
    "on the lower ones.",
    Hold.REST: "Let the platform rest on its lower stops.",
}
Ask = Callable[[Hold], None]
"""Function that tells the operator how to hold the platform; it may return at once."""


@dataclass(frozen=True)
class Held:
    """Mean readings (S,) of a platform that is held still, and which are at the end of a range."""

    mean_m: Array
    clipped: NDArray[np.bool_]


@dataclass(frozen=True)
class Stops:
    """Half the distance of the stops along x and y in m, and the platform's stroke in m."""

    half_m: tuple[float, float]
    stroke_m: float


@dataclass(frozen=True)
class Commissioned:
    """What was found: sensors, coils, and the delay of the amplifiers' answer in cycles.

    stuck (S,): sensors whose reading never changed. readback (C,): channel whose measured force
    follows the command of each channel, -1 for none. largest_n: largest force of a coil that was
    commanded. height_delay: of the heights after a coil's command. beam, beam_delay: None if the
    beam was not moved. encoders: what was measured by hand.
    """

    resting: Resting
    stuck: NDArray[np.bool_]
    sensors: SensorOrder
    coils: CoilOrder
    readback: NDArray[np.int64]
    delay_cycles: int
    largest_n: float
    height_delay: Delay
    beam: BeamDirection | None = None
    beam_delay: Delay | None = None
    encoders: tuple[EncoderScale, ...] = ()


def commission(
    session: DeviceSession,
    rig: RigConfig,
    stops: Stops,
    force_n: float,
    ask: Ask,
    progress: Callable[[str, float], None],
    beam_m: float = 0.0,
    measure: Measure | None = None,
) -> Commissioned:
    """Find order, sign and scale of all channels of a rig at rest on its lower stops.

    force_n: force of one coil at a time, up and down. beam_m: how far the beam moves, 0 for not at
    all; the rest of the commissioning does without. measure: asks how far beam and rotor moved;
    None does not ask.

    Raises:
        CommissionError: the platform was not held as asked, or too few sensors follow it.
        DriverError: a device failed.
    """
    rate_hz = rig.rate_hz
    progress("readings at rest", 0.0)
    rest = session.run(round(_REST_S * rate_hz))
    at_rest = resting(rest.gap_m, rate_hz)
    held, ways = [Held(at_rest.mean_m, at_rest.clipped)], [rest.gap_m]
    for number, hold in enumerate((Hold.WHOLE, Hold.X_SIDE, Hold.Y_SIDE, Hold.REST)):
        progress(f"platform held: {hold}", 0.1 + 0.1 * number)
        ask(hold)
        now, way = _held(session, rate_hz, held[-1].mean_m, stops.stroke_m, hold)
        held.append(now)
        ways.append(way)
    geometry = rig.geometry
    moved = np.concatenate(ways)
    sensors = _sensors(rig, held, moved, stops)
    count = len(geometry.coil_x_m)
    pose, sd = np.zeros((count, 3)), np.zeros((count, 3))
    readback, delays = np.full(count, -1), []
    late: list[Swings] = []
    for channel in range(count):
        progress(f"coil {channel}", 0.5 + 0.5 * channel / count)
        found = _pulsed(session, rate_hz, channel, count, force_n)
        # A push downwards may take a sensor to the end of its range.
        decouple = _decoupling(rig, sensors, ~(at_rest.clipped | clipped(found.gap_m)))
        pose[channel], sd[channel] = _pose_per_newton(found, channel, decouple, rate_hz)
        late.append(_height_swings(found, decouple, pose[channel], sd[channel], rate_hz))
        readback[channel], delay = _answer(found, channel, force_n)
        delays += [delay] if delay is not None else []
    coils = coil_order(
        pose, np.median(sd, axis=0), np.array(geometry.coil_x_m), np.array(geometry.coil_y_m)
    )
    beam = beam_delay = None
    if beam_m and coils.place.max() >= 0:
        progress("beam", 0.95)
        beam, beam_delay = _beam(session, rig, sensors, coils, pose, at_rest, beam_m)
    encoders: tuple[EncoderScale, ...] = ()
    if measure is not None:
        moves: tuple[tuple[Axis, float], ...] = (("beam", beam_m), ("rotor", _TURN_RAD))
        encoders = tuple(
            encoder_scale(session, axis, by, measure, rate_hz) for axis, by in moves if by
        )
    typical = round(float(np.median(delays))) if delays else -1
    stuck = np.ptp(moved, axis=0) == 0.0
    return Commissioned(
        at_rest, stuck, sensors, coils, readback, typical, session.largest_n,
        delay_of_swings(late), beam, beam_delay, encoders,
    )  # fmt: skip


def _beam(
    session: DeviceSession,
    rig: RigConfig,
    sensors: SensorOrder,
    coils: CoilOrder,
    pose: Array,
    at_rest: Resting,
    beam_m: float,
) -> tuple[BeamDirection, Delay]:
    """Move the beam forth and back; return what the tilt says of its direction, and its delay."""
    decouple = _decoupling(rig, sensors, ~at_rest.clipped)
    look = round(_BEAM_LOOK_S * rig.rate_hz)

    def tilt() -> float:
        return float((session.run(look).gap_m.mean(axis=0) @ decouple.T)[1])

    begin_m = session.beam_m
    away_m = begin_m + (beam_m if begin_m <= 0.0 else -beam_m)  # inside its limits
    tilts, moves = [tilt()], []
    for number in range(2 * _BEAM_MOVES):
        moves.append(session.move_beam(away_m if number % 2 == 0 else begin_m).beam)
        tilts.append(tilt())
    alive = ~coils.dead
    x_m = np.array(rig.geometry.coil_x_m)[coils.place]
    compliance = tilt_compliance(pose[alive, 1], coils.gain[alive], x_m[alive])
    law = feed_forward(rig, 1.0 / rig.rate_hz)
    here, there = law.wrench(np.array([[begin_m, 0.0, 0.0], [away_m, 0.0, 0.0]]))
    direction = beam_direction(np.diff(tilts), float(there[1] - here[1]), compliance)
    return direction, delay_of_moves(moves)


def _sensors(rig: RigConfig, held: Sequence[Held], moved_m: Array, stops: Stops) -> SensorOrder:
    """Return the order of the sensors; of those that reach the end of their range, on the way."""
    x_m, y_m = np.array(rig.geometry.sensors_x_m), np.array(rig.geometry.sensors_y_m)
    rest, whole, x_side, y_side, _ = held
    found = at_the_stops(
        whole.mean_m - rest.mean_m,
        x_side.mean_m - rest.mean_m,
        y_side.mean_m - rest.mean_m,
        stops.half_m,
        stops.stroke_m,
    )
    ends = np.any([h.clipped for h in held], axis=0)
    if not ends.any():
        return sensor_order(found, x_m, y_m)
    scale = np.where(ends, 0.0, found.scale)
    inside = sensor_order(Followed(scale, found.x_m, found.y_m), x_m, y_m)
    pose = moved_m @ _decoupling(rig, inside, np.full(len(scale), True)).T
    x, y = found.x_m.copy(), found.y_m.copy()
    free = np.setdiff1d(np.arange(len(scale)), inside.place)
    for i in np.flatnonzero(ends):
        scale[i], x[i], y[i] = on_the_way(moved_m[:, i], pose, x_m[free], y_m[free], stops.stroke_m)
    return sensor_order(Followed(scale, x, y), x_m, y_m)


def _held(
    session: DeviceSession, rate_hz: float, before_m: Array, stroke_m: float, hold: Hold
) -> tuple[Held, Array]:
    """Wait until the platform has moved and is held still; return this, and all readings (n, S)."""
    look = max(round(_LOOK_S * rate_hz), 1)
    found: list[Held] = []

    def still(so_far: Readings) -> bool:
        n = len(so_far.gap_m) // look
        if n < _STILL_WINDOWS:
            return False
        last = so_far.gap_m[(n - _STILL_WINDOWS) * look : n * look]
        means = last.reshape(_STILL_WINDOWS, look, -1).mean(axis=1)
        moved = np.abs(means.mean(axis=0) - before_m).max() > _MOVED_SHARE * stroke_m
        if moved and np.ptp(means, axis=0).max() < _STILL_SHARE * stroke_m:
            found[:] = [Held(means.mean(axis=0), clipped(last))]
        return bool(found)

    way = session.run(round(_HAND_S * rate_hz), ended=still, every=look)
    if not found:
        moved_mm = 1e3 * _MOVED_SHARE * stroke_m
        raise CommissionError(
            f"{PROMPTS[hold]} Within {_HAND_S:g} s no sensor moved by {moved_mm:.2g} mm and stayed "
            "there: hold it still for half a second; check the sensors' supply"
        )
    return found[0], way.gap_m


def _decoupling(rig: RigConfig, sensors: SensorOrder, usable: NDArray[np.bool_]) -> Array:
    """Return T (3, S) from readings to the pose, without dead channels and those not usable."""
    alive = ~sensors.dead & usable
    geometry = rig.geometry
    shape = shape_matrix(geometry.sensors_x_m, geometry.sensors_y_m)[sensors.place[alive]]
    if alive.sum() < 3 or np.linalg.matrix_rank(shape) < 3:
        raise CommissionError(
            f"only {alive.sum()} of {len(alive)} sensors follow the platform between its stops: at "
            "least 3, not on a line, are needed to go on; check their supply, range and mounting"
        )
    decoupling = np.zeros((3, len(alive)))
    decoupling[:, alive] = np.linalg.pinv(sensors.scale[alive, None] * shape)
    return decoupling


def _pulsed(
    session: DeviceSession, rate_hz: float, channel: int, count: int, force_n: float
) -> Readings:
    half = max(round(0.5 * _PULSE_S * rate_hz), 2)
    up, down = np.zeros(count), np.zeros(count)
    up[channel], down[channel] = force_n, -force_n
    pulses = [session.run(2 * half, lambda k: up if k < half else down) for _ in range(_PULSES)]
    return Readings(
        *(
            np.concatenate([getattr(pulse, part) for pulse in pulses])
            for part in ("gap_m", "coil_n", "commanded_n", "beam")
        )
    )


def _pose_per_newton(
    found: Readings, channel: int, decouple: Array, rate_hz: float
) -> tuple[Array, Array]:
    """Return the pose (3,) per newton of a coil's command and its standard deviation (3,).

    Each pulse gives one difference of up and down; a drift over a pulse is the same for all.
    """
    half = max(round(0.5 * _PULSE_S * rate_hz), 2)
    settled = max(round(_SETTLED_SHARE * half), 1)
    pose = found.gap_m @ decouple.T
    parts = pose.reshape(_PULSES, 2, half, 3)[:, :, -settled:].mean(axis=2)
    size = np.abs(found.commanded_n[:, channel]).max()
    each = (parts[:, 0] - parts[:, 1]) / (2.0 * size)
    each = each[_acted(found, half, settled)]
    middle = np.median(each, axis=0)
    sd = _SD_OF_MAD * np.median(np.abs(each - middle), axis=0)
    return middle, sd / np.sqrt(len(each))


def _height_swings(
    found: Readings, decouple: Array, per_n: Array, sd: Array, rate_hz: float
) -> Swings:
    """Return how the pose swings as a coil's force turns from up to down, in each pulse.

    per_n, sd (3,): pose per newton of the coil and its noise: the direction that shows it best.
    """
    half = max(round(0.5 * _PULSE_S * rate_hz), 2)
    settled = max(round(_SETTLED_SHARE * half), 1)
    weights = per_n / sd**2
    along = (found.gap_m @ decouple.T) @ (weights / np.linalg.norm(weights * sd))
    parts = along.reshape(_PULSES, 2, half)[_acted(found, half, settled)]
    return swings(parts[:, 1], parts[:, 0, -settled:].mean(axis=1), 1.0 / rate_hz)


def _acted(found: Readings, half: int, settled: int) -> NDArray[np.bool_]:
    """Return the pulses (n,) during which the measured force did not drop out.

    A cycle that comes late lets the setpoints expire. The channel of the measurement is not known
    yet: it is the one that changes most. Without any, all pulses count.
    """
    force = found.coil_n.reshape(_PULSES, 2, half, -1)[:, :, -settled:].mean(axis=2)
    change = np.abs(force[:, 0] - force[:, 1]).max(axis=1)
    return np.asarray(change >= _ACTED_SHARE * change.max())


def _answer(found: Readings, channel: int, force_n: float) -> tuple[int, int | None]:
    """Return the channel whose measured force follows a command, -1 for none, and its delay."""
    command = found.commanded_n[:, channel]
    best, delay = -1, None
    best_share = 0.5  # of the force
    for lag in range(8):
        late = command[: len(command) - lag]
        share = np.abs(found.coil_n[lag:].T @ late) / (force_n**2 * len(late))
        if share.max() > best_share:
            best, best_share, delay = int(np.argmax(share)), float(share.max()), lag
    return best, delay
