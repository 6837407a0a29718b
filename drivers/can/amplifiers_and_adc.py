"""Coil amplifiers and ADC on CAN: setpoints out, forces and heights in, requests in between."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

from ...config.rig import RigConfig
from ...log.signals import Stale
from ...wire.can.can_frames import CanFrames, Fields
from ...wire.device_protocol import (
    AMPLIFIER_LIMITS,
    SENSOR_LIMITS,
    AmplifierState,
    Request,
    declared,
)
from ...wire.frame_rejection import Rejected
from ...wire.int16_scaling import LARGEST
from ..amplifier_enabling import AmplifierWatch, compare_limits, refusal, worst_state
from ..base import Array, CoilAmplifiers, LinkError, PositionSensors
from ..force_quantiser import CarriedRounding
from ..reading_checks import SensorWatch
from .bus_link import CanLink
from .readings import Readings

_UNHEARD = int(Stale.SETPOINTS)
_EXCHANGE_S = 0.1
_TRIES = 5
_SETS = 16

Deadline = Callable[[], float]


class CanAmplifiers(CoilAmplifiers):
    """Amplifiers by the DBC's Setpoints, Forces, Request and Answer."""

    def __init__(
        self,
        link: CanLink,
        frames: CanFrames,
        rig: RigConfig,
        expire_cycles: int,
        stale_cycles: int,
        deadline: Deadline,
    ) -> None:
        self.readings = Readings("amplifiers", link, frames.force, stale_cycles)
        self.cycle = 0
        self._set = 0
        self._link, self._setpoint, self._deadline = link, frames.setpoint, deadline
        self._in_steps = CarriedRounding(frames.setpoint.unit, len(rig.geometry.coil_x_m))
        self._limits = declared(rig, expire_cycles)
        self._questions = Questions(link, frames.request, frames.answer)
        self._watch = AmplifierWatch(
            self.readings.what, self._limits, self._questions.ask, stale_cycles
        )
        self._questions.answered = self._watch.answered

    def write(self, coil_n: Array) -> None:
        """Send setpoints (C,) in N; the amplifiers take them over at the next Sync.

        Of several sets in a cycle each has its number, where other frames have a state: frames of
        one of which some are lost are not taken for those of the next.
        """
        self._watch.commanding(coil_n)
        send = self._link.send
        self._set = (self._set + 1) % _SETS
        for can_id, data in self._setpoint.encode(self._in_steps(coil_n), self.cycle, self._set):
            send(can_id, data)

    def read(self, coil_n: Array) -> None:
        """Fill `coil_n` (C,) with the forces of this cycle, or of the last that came."""
        self.readings.collect(self._deadline(), coil_n)
        if self.readings.fresh:
            # Each frame may be of an amplifier of its own.
            state = worst_state(self.readings.states)
            self.stale = _UNHEARD if state == AmplifierState.UNHEARD else 0
            self._watch.judge(state, coil_n)

    def recover(self) -> None:
        """Compare limits and reset trips; raises DriverError."""
        self.readings.reset()
        exchange = self._questions.exchange
        compare_limits(self.readings.what, self._limits, AMPLIFIER_LIMITS, exchange)
        self._watch.reset(exchange)


class CanSensors(PositionSensors):
    """An ADC by the DBC's Gaps, SensorRequest and SensorAnswer."""

    def __init__(
        self,
        link: CanLink,
        frames: CanFrames,
        rig: RigConfig,
        stale_cycles: int,
        deadline: Deadline,
    ) -> None:
        self.readings = Readings("sensors", link, frames.gap, stale_cycles)
        self._deadline, self._limits = deadline, declared(rig, 0)
        self._questions = Questions(link, frames.sensor_request, frames.sensor_answer)
        range_m = frames.gap.unit * LARGEST
        self._watch = SensorWatch(self.readings.what, rig.geometry, range_m)

    def read(self, gap_m: Array) -> None:
        """Fill `gap_m` (S,) with the heights of this cycle, or of the last that came."""
        self.readings.collect(self._deadline(), gap_m)
        if self.readings.fresh:
            self.stale = 0
            self._watch.judge(gap_m, max(self.readings.states))

    def recover(self) -> None:
        """Compare limits; raises DriverError."""
        self.readings.reset()
        self._watch.reset()
        exchange = self._questions.exchange
        compare_limits(self.readings.what, self._limits, SENSOR_LIMITS, exchange)


def _answers(answer: int, request: Request, index: int) -> bool:
    return request != Request.READ or answer == index or bool(refusal(answer))


class Questions:
    """Requests to one device, in the cycle without waiting or between cycles with its answer."""

    def __init__(self, link: CanLink, request: Fields, answer: Fields) -> None:
        self._link, self._request, self._answer = link, request, answer
        self.answered: Callable[[int, int], None] = lambda _, __: None
        self._latest: tuple[int, int] | None = None
        link.listen(answer.can_id, self._take)

    def ask(self, request: Request, index: int, value: int) -> None:
        """Ask; the answer goes to `answered` when it comes."""
        self._link.send(*self._request.encode(request, index, value))

    def exchange(self, request: Request, index: int, value: int) -> tuple[int, int]:
        """Ask and return index and value of the answer; raises LinkError where none comes."""
        for _ in range(_TRIES):
            self._link.drain()
            self._latest = None
            self.ask(request, index, value)
            deadline_s = perf_counter() + _EXCHANGE_S
            while perf_counter() < deadline_s and self._link.receive(deadline_s):
                # An answer to what was asked before this, and came too late, is another's.
                if self._latest is not None and _answers(self._latest[0], request, index):
                    return self._latest
        raise LinkError(f"{self._link.what}: nobody answers to {self._request.name}")

    def _take(self, _: int, data: bytes) -> None:
        numbers = self._answer.decode(data)
        if not isinstance(numbers, Rejected):
            self._latest = numbers[0], numbers[1]
            self.answered(*self._latest)
