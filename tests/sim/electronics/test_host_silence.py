"""Setpoints expire when the host is silent, whatever other frames are on its bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from levid.config.backends import ROLES
from levid.config.rig import RigConfig
from levid.config.shipped import shipped
from levid.sim.electronics.can_emulator import CanElectronics
from levid.sim.electronics.emulated_devices import Core
from levid.sim.electronics.emulated_rig import Electronics
from levid.sim.electronics.serial_emulator import SerialElectronics
from levid.wire.can.can_frames import load_frames
from levid.wire.can.kernel_frame import ReceivedFrame
from levid.wire.device_protocol import (
    AMPLIFIER_LIMITS,
    AmplifierState,
    DeviceParameter,
    Request,
    response,
)
from levid.wire.serial.serial_frames import FrameContents, SerialFrames

RATE_HZ = 50.0
PERIOD_S = 1 / RATE_HZ
EXPIRE = 4
REST, PHI = np.zeros(3), np.zeros(3)


class Clock:
    """The time of the electronics, which goes on as a test says."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    for module in ("emulated_devices", "can_emulator", "serial_emulator", "drive_nodes"):
        monkeypatch.setattr(f"levid.sim.electronics.{module}.time", clock)
    return clock


class PlayedBus:
    """A bus that brings what a test says, and then stops the electronics at its end."""

    def __init__(self) -> None:
        self.coming: Iterator[object] = iter(())
        self.stop: Callable[[], None] = lambda: None

    def receive(self, _: float) -> object:
        try:
            return next(self.coming)
        except StopIteration:
            self.stop()
            return None

    def read(self, _: float) -> object:
        return self.receive(0.0) or b""

    def send(self, *_: object) -> None:
        return

    write = open = close = shutdown = send


class End:
    """Electronics at the end of a bus that a test plays; they drive 7 N in cycle 10."""

    def __init__(self, backend: str, rig: RigConfig) -> None:
        made = Electronics(rig, Path())
        self.core, self.bus = made.core, PlayedBus()
        roles = {role: options for role in ROLES if (options := rig.on_bus(role)[1])}
        kind: Any = {"can": CanElectronics, "serial": SerialElectronics}[backend]
        self.electronics = kind("main", rig, Path(), roles, made.core, made.injector, self.bus)
        self.serial = SerialFrames(FrameContents.of(rig, roles)) if backend == "serial" else None
        drive_force(self.core)

    def play(self, coming: Iterable[object]) -> None:
        """Let the electronics answer cycle 10 and what comes next on their bus, then stop them."""
        self.bus.coming = chain([self.cycle(10, 7.0)], coming)
        self.bus.stop = self.electronics.stop
        self.electronics.serve()

    def cycle(self, number: int, force_n: float) -> object:
        """Return the frame that begins a cycle; on a serial port it has the setpoints too."""
        if self.serial:
            return self.serial.cycle(number, np.full(9, force_n), REST, PHI)
        return ReceivedFrame(*load_frames(None, 9, 9, False).sync.encode(number), 0.0)

    def foreign(self) -> object:
        """Return what no device of the rig sends."""
        return b"\x11\x00" if self.serial else ReceivedFrame(0x7F0, b"", 0.0)


@pytest.fixture(params=["can", "serial"])
def end(request, rig_on, clock: Clock) -> End:
    return flying(request.param, rig_on)


@pytest.fixture
def can_end(rig_on, clock: Clock) -> End:
    return flying("can", rig_on)


@pytest.fixture
def serial_end(rig_on, clock: Clock) -> End:
    return flying("serial", rig_on)


def flying(backend: str, rig_on) -> End:
    return End(backend, rig_on(backend, RATE_HZ, shipped("sims/nominal.yaml"), EXPIRE))


def drive_force(core: Core) -> None:
    limits = {p: core.limits[p] for p in AMPLIFIER_LIMITS}
    _, challenge = core.request(Request.READ, DeviceParameter.CHALLENGE, 0)
    for cycle in range(11):
        core.begin(cycle)
        core.apply_setpoints()
        core.request(Request.ENABLE, 0, response(challenge, limits))
        core.setpoints(np.full(9, 7.0))
    assert core.acting_n == pytest.approx(7.0)


@pytest.mark.parametrize("what", ["foreign", "same cycle"])
def test_force_expires_though_frames_come_that_begin_no_cycle(
    end: End, what: str, clock: Clock
) -> None:
    acting = []

    def coming() -> Iterator[object]:
        for _ in range(20):
            acting.append(end.core.acting_n.any())
            clock.now += 0.5 * PERIOD_S
            # An adapter may send its last buffer again and again: 1 N each, of a past cycle.
            yield end.foreign() if what == "foreign" else end.cycle(10, 1.0)

    end.play(coming())
    assert end.core.amplifier_state is AmplifierState.EXPIRED
    # A cycle is missing half a period after it was due, so many times, and found by the next frame.
    assert sum(acting) <= 2 * (EXPIRE + 1)


def test_delay_of_the_electronics_is_not_silence_of_the_host(can_end: End, clock: Clock) -> None:
    """Frames waited in the queue for ten periods: their timestamps say when they came."""

    def coming() -> Iterator[object]:
        clock.now += 10 * PERIOD_S
        for k in range(5):
            if k == 4:  # no silence follows the last frame
                can_end.electronics.stop()
            yield ReceivedFrame(0x7F0, b"", time.time() - 10 * PERIOD_S)

    can_end.play(coming())
    assert can_end.core.amplifier_state is AmplifierState.ENABLED


def test_silence_is_counted_in_periods_however_often_it_is_checked(end: End, clock: Clock) -> None:
    core = end.core
    for silent, expired in ((EXPIRE + 0.4, False), (EXPIRE + 0.6, True)):
        core.tick(clock.now + silent * PERIOD_S)
        assert (core.amplifier_state is AmplifierState.EXPIRED) is expired
    assert not core.acting_n.any()


def test_electronics_delayed_for_a_year_do_not_simulate_it(
    end: End, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    core, periods = end.core, []
    advance = core.plant.advance
    monkeypatch.setattr(core.plant, "advance", lambda *to: (periods.append(1), advance(*to)))
    core.tick(clock.now + 3e7)
    assert core.amplifier_state is AmplifierState.EXPIRED
    assert EXPIRE < len(periods) <= 1000  # as many as are caught up at once; the rest is skipped
    periods.clear()
    core.tick(clock.now + 3e7)
    assert not periods


def test_zero_force_in_the_current_cycle_acts_at_once(serial_end: End) -> None:
    serial_end.play([serial_end.cycle(10, 0.0)])
    assert not serial_end.core.acting_n.any()
    assert serial_end.core.amplifier_state is AmplifierState.ENABLED


def test_setpoints_act_in_their_cycle_whichever_bus_begins_it(end: End) -> None:
    """With two buses, the one without amplifiers may begin the cycle."""
    core = end.core
    core.setpoints(np.full(9, 8.0))
    assert core.begin(11)  # by the other one
    end.play([end.cycle(11, 8.0)])
    assert core.acting_n == pytest.approx(8.0)
    assert core.reported_state is AmplifierState.ENABLED


def test_setpoints_of_two_sets_are_not_joined(can_end: End) -> None:
    """A frame of the first set is lost; the second set is zero force, in the same cycle."""
    setpoint = load_frames(None, 9, 9, False).setpoint
    first, second = setpoint.encode(np.full(9, 8.0), 11, 1), setpoint.encode(np.zeros(9), 11, 2)
    frames = [ReceivedFrame(*frame, 0.0) for frame in (*first[:-1], *second)]
    can_end.play([can_end.cycle(11, 0.0), *frames])
    assert not can_end.core.pending_n.any()
