"""Setpoints expire when the host is silent, whatever else is said on its bus meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

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
from levid.wire.serial.serial_frames import SerialFrames

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
    for module in ("core", "can_bus", "serial_port", "drive_nodes"):
        monkeypatch.setattr(f"levid.sim.electronics.{module}.time", clock)
    return clock


@pytest.fixture(params=["can_end", "serial_end"])
def end(request) -> CanElectronics | SerialElectronics:
    """Electronics at the end of a bus that a test plays; they drive 7 N in cycle 10."""
    return request.getfixturevalue(request.param)


@pytest.fixture
def can_end(rig_on, clock: Clock) -> CanElectronics:
    return flying("can", rig_on)


@pytest.fixture
def serial_end(rig_on, clock: Clock) -> SerialElectronics:
    return flying("serial", rig_on)


def flying(bus: str, rig_on) -> Any:
    rig = rig_on(bus, RATE_HZ, shipped("sims/nominal.yaml"), EXPIRE)
    end: Any = Electronics(rig, Path())._buses[0]
    end._line = SimpleNamespace(write=lambda _: None)
    drive_force(end._core)
    return end


def drive_force(core: Core) -> None:
    limits = {p: core.limits[p] for p in AMPLIFIER_LIMITS}
    _, challenge = core.request(Request.READ, DeviceParameter.CHALLENGE, 0)
    for cycle in range(11):
        core.begin(cycle)
        core.apply_setpoints()
        core.request(Request.ENABLE, 0, response(challenge, limits))
        core.setpoints(np.full(9, 7.0))
    assert core.acting_n == pytest.approx(7.0)


def play(end: CanElectronics | SerialElectronics, come: Callable[[int], object], n: int) -> None:
    """Let `end` run while come(k), k < n, is what its bus brings."""
    left = iter(range(n))

    def receive(_: float) -> object:
        k = next(left)
        if k == n - 1:
            end._stopping.set()
        return come(k)

    ignored = SimpleNamespace(send=lambda *_: None, write=lambda *_: None, open=lambda: None)
    ignored.receive = ignored.read = receive
    if isinstance(end, CanElectronics):
        end._bus = ignored  # type: ignore[assignment]
    else:
        end._line = ignored  # type: ignore[assignment]
    end._run()


def foreign(end: CanElectronics | SerialElectronics) -> object:
    return ReceivedFrame(0x7F0, b"", 0.0) if isinstance(end, CanElectronics) else b"\x11\x00"


def same_cycle(end: CanElectronics | SerialElectronics) -> object:
    if isinstance(end, CanElectronics):
        return ReceivedFrame(*load_frames(None, 9, 9, False).sync.encode(10), 0.0)
    # As an adapter does that sends its last buffer again and again: 1 N each, of a cycle long gone.
    end._sequence = 10
    return SerialFrames(end._contents).cycle(10, np.ones(9), REST, PHI)


@pytest.mark.parametrize("what", [foreign, same_cycle])
def test_frames_that_begin_no_cycle_keep_no_force(
    end: CanElectronics | SerialElectronics, what, clock: Clock
) -> None:
    core, acting = end._core, []

    def come(_: int) -> object:
        acting.append(core.acting_n.any())
        clock.now += 0.5 * PERIOD_S
        return what(end)

    play(end, come, 20)
    assert core.amplifier_state is AmplifierState.EXPIRED
    # A cycle is missing half a period after it was due, so many times, and found by the next frame.
    assert sum(acting) <= 2 * (EXPIRE + 1)


def test_time_that_the_electronics_slept_through_is_no_silence(
    can_end: CanElectronics, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames waited for their turn for ten periods: their stamps say when they came."""
    monkeypatch.setattr(can_end._ages, "of", lambda _: 10 * PERIOD_S)

    def come(k: int) -> object:
        clock.now += 10 * PERIOD_S if k == 0 else 0.0
        return foreign(can_end)

    play(can_end, come, 5)
    assert can_end._core.amplifier_state is AmplifierState.ENABLED


def test_silence_is_counted_in_periods_however_often_it_is_looked_at(
    end: CanElectronics | SerialElectronics, clock: Clock
) -> None:
    core = end._core
    for silent, expired in ((EXPIRE + 0.4, False), (EXPIRE + 0.6, True)):
        core.tick(clock.now + silent * PERIOD_S)
        assert (core.amplifier_state is AmplifierState.EXPIRED) is expired
    assert not core.acting_n.any()


def test_one_that_slept_for_a_year_expires_and_does_not_race(
    end: CanElectronics | SerialElectronics, clock: Clock
) -> None:
    core = end._core
    core.tick(clock.now + 3e7)
    assert core.amplifier_state is AmplifierState.EXPIRED
    assert core._last_s == clock.now + 3e7


def test_zero_force_in_a_cycle_at_hand_acts_at_once(
    serial_end: SerialElectronics,
) -> None:
    core = serial_end._core
    serial_end._answer(SerialFrames(serial_end._contents).cycle(10, np.zeros(9), REST, PHI)[:-1])
    assert not core.acting_n.any()
    assert core.amplifier_state is AmplifierState.ENABLED


def test_setpoints_act_in_their_cycle_whichever_bus_begins_it(
    end: CanElectronics | SerialElectronics,
) -> None:
    """Of two ports, or two buses, the one without amplifiers may be handled first."""
    core = end._core
    core.setpoints(np.full(9, 8.0))
    assert core.begin(11)  # by the other one
    if isinstance(end, SerialElectronics):
        end._answer(SerialFrames(end._contents).cycle(11, np.full(9, 8.0), REST, PHI)[:-1])
    else:
        end._sync(*load_frames(None, 9, 9, False).sync.encode(11))
    assert core.acting_n == pytest.approx(8.0)
    assert core.reported_state is AmplifierState.ENABLED


def test_setpoints_of_two_sets_are_not_joined(can_end: CanElectronics) -> None:
    """A frame of the first is lost; the second is zero force, in the same cycle."""
    setpoint = load_frames(None, 9, 9, False).setpoint
    can_end._sync(*load_frames(None, 9, 9, False).sync.encode(11))
    for frame in setpoint.encode(np.full(9, 8.0), 11, 1)[:-1]:
        can_end._setpoint(*frame)
    for frame in setpoint.encode(np.zeros(9), 11, 2):
        can_end._setpoint(*frame)
    assert not can_end._core.pending_n.any()
