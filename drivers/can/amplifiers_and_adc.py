"""Coil amplifiers and ADC on CAN: setpoints, forces, heights and requests, by the DBC."""

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
    expected_parameters,
)
from ...wire.frame_rejection_reasons import Rejected
from ...wire.int16_scaling import LARGEST
from ..amplifier_enabling import AmplifierWatch, compare_limits, refusal, worst_state
from ..base import Array, CoilAmplifiers, LinkError, PositionSensors
from ..force_quantiser import ForceQuantiser
from ..reading_checks import SensorWatch
from .bus_link import CanLink
from .reading_collector import Readings

_MISSING_SETPOINTS = int(Stale.SETPOINTS)
_EXCHANGE_S = 0.1
_ATTEMPTS = 5
_SET_NUMBERS = 16

Deadline = Callable[[], float]


class CanAmplifiers(CoilAmplifiers):
    """Amplifiers with the DBC's messages Setpoints, Forces, Request and Answer."""

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
        self._in_steps = ForceQuantiser(frames.setpoint.unit, len(rig.geometry.coil_x_m))
        self._limits = expected_parameters(rig, expire_cycles)
        self._requests = Requests(link, frames.request, frames.answer)
        self._watch = AmplifierWatch(
            self.readings.what, self._limits, self._requests.ask, stale_cycles
        )
        self._requests.answered = self._watch.answered

    def write(self, coil_n: Array) -> None:
        """Send setpoints (C,) in N, which act from the next Sync on.

        Each set has a number, so that frames of two sets in one cycle are not mixed if some are
        lost.
        """
        self._watch.commanding(coil_n)
        send = self._link.send
        self._set = (self._set + 1) % _SET_NUMBERS
        for can_id, data in self._setpoint.encode(self._in_steps(coil_n), self.cycle, self._set):
            send(can_id, data)

    def read(self, coil_n: Array) -> None:
        """Fill `coil_n` (C,) with the forces of this cycle in N; unchanged if they are missing."""
        self.readings.collect(self._deadline(), coil_n)
        if self.readings.fresh:
            # Each frame may come from another amplifier.
            state = worst_state(self.readings.states)
            self.stale = _MISSING_SETPOINTS if state == AmplifierState.UNHEARD else 0
            self._watch.judge(state, coil_n)

    def recover(self) -> None:
        """Compare limits and reset trips; raises DriverError."""
        self.readings.reset()
        exchange = self._requests.exchange
        compare_limits(self.readings.what, self._limits, AMPLIFIER_LIMITS, exchange)
        self._watch.reset(exchange)


class CanSensors(PositionSensors):
    """An ADC with the DBC's messages Gaps, SensorRequest and SensorAnswer."""

    def __init__(
        self,
        link: CanLink,
        frames: CanFrames,
        rig: RigConfig,
        stale_cycles: int,
        deadline: Deadline,
    ) -> None:
        self.readings = Readings("sensors", link, frames.gap, stale_cycles)
        self._deadline, self._limits = deadline, expected_parameters(rig, 0)
        self._requests = Requests(link, frames.sensor_request, frames.sensor_answer)
        range_m = frames.gap.unit * LARGEST
        self._watch = SensorWatch(self.readings.what, rig.geometry, range_m)

    def read(self, gap_m: Array) -> None:
        """Fill `gap_m` (S,) with the heights of this cycle in m; unchanged if they are missing."""
        self.readings.collect(self._deadline(), gap_m)
        if self.readings.fresh:
            self.stale = 0
            self._watch.judge(gap_m, max(self.readings.states))

    def recover(self) -> None:
        """Compare limits; raises DriverError."""
        self.readings.reset()
        self._watch.reset()
        exchange = self._requests.exchange
        compare_limits(self.readings.what, self._limits, SENSOR_LIMITS, exchange)


def _is_answer(answer: int, request: Request, index: int) -> bool:
    return request != Request.READ or answer == index or bool(refusal(answer))


class Requests:
    """Sends requests to one device, without waiting or, between cycles, with the answer."""

    def __init__(self, link: CanLink, request: Fields, answer: Fields) -> None:
        self._link, self._request, self._answer = link, request, answer
        self.answered: Callable[[int, int], None] = lambda _, __: None
        self._latest: tuple[int, int] | None = None
        link.listen(answer.can_id, self._receive)

    def ask(self, request: Request, index: int, value: int) -> None:
        """Send a request; its answer goes to `answered`."""
        self._link.send(*self._request.encode(request, index, value))

    def exchange(self, request: Request, index: int, value: int) -> tuple[int, int]:
        """Send a request and return index and value of its answer; LinkError on a timeout."""
        for _ in range(_ATTEMPTS):
            self._link.drain()
            self._latest = None
            self.ask(request, index, value)
            deadline_s = perf_counter() + _EXCHANGE_S
            while perf_counter() < deadline_s and self._link.receive(deadline_s):
                # Ignore a late answer to an earlier request.
                if self._latest is not None and _is_answer(self._latest[0], request, index):
                    return self._latest
        raise LinkError(
            f"{self._link.what}: no answer to {self._request.name}: {self._link.remedy}"
        )

    def _receive(self, _: int, data: bytes) -> None:
        numbers = self._answer.decode(data)
        if not isinstance(numbers, Rejected):
            self._latest = numbers[0], numbers[1]
            self.answered(*self._latest)
