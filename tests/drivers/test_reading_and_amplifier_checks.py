"""Missing and faulty readings; states and challenges of amplifiers."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numba import typeof
from numba.core.dispatcher import Dispatcher

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.control.control_cycle import Controller
from levid.daemon.loop.prepare_first_cycle import locate
from levid.drivers import reading_checks
from levid.drivers.amplifier_enabling import AmplifierWatch, worst_state
from levid.drivers.base import AmplifierError, DriveError, SensorError, StaleError
from levid.drivers.reading_checks import SensorWatch
from levid.wire import int16_scaling
from levid.wire.can import can_frames
from levid.wire.device_protocol import (
    AmplifierState,
    DeviceParameter,
    Request,
    SensorState,
    expected_parameters,
)
from levid.wire.serial import cobs, serial_frames

RIG = load_rig(shipped("rigs/loopback.yaml"))


def test_faulty_state_of_the_adc_is_an_error() -> None:
    watch = SensorWatch("sensors", RIG.geometry, 1e-3)
    draw = np.random.default_rng(1).normal
    watch.judge(draw(0, 1e-7, 9), SensorState.OK)
    with pytest.raises(SensorError, match="the ADC reports a faulty channel"):
        watch.judge(draw(0, 1e-7, 9), SensorState.FAULTY)
    watch.judge(draw(0, 1e-7, 9), SensorState.FAULTY)  # raised once
    watch.reset()
    with pytest.raises(SensorError):
        watch.judge(draw(0, 1e-7, 9), 7)  # an undefined state
    watch.reset()
    gap = draw(0, 1e-7, 9)
    gap[4] = np.nan
    # The more specific error comes first.
    with pytest.raises(SensorError, match="sensor 4: no reading"):
        watch.judge(gap, SensorState.FAULTY)


@pytest.mark.parametrize(
    ("states", "told"),
    [
        ((1, 1, 1), AmplifierState.ENABLED),
        ((1, 2, 1), AmplifierState.EXPIRED),
        ((1, 1, 4), AmplifierState.UNHEARD),
        ((4, 0, 1), AmplifierState.OFF),
        ((0, 2, 3), AmplifierState.TRIPPED),
        ((1, 9, 1), 9),
    ],
)
def test_worst_amplifier_state_is_reported(states: tuple[int, ...], told: int) -> None:
    assert worst_state(states) == told


def test_amplifiers_that_failed_in_flight_stay_off_until_cleared() -> None:
    asked: list[tuple[Request, int, int]] = []
    watch = AmplifierWatch(
        "amplifiers", expected_parameters(RIG, 3), lambda *what: asked.append(what), 2
    )
    coil_n, zero_n = np.full(9, 7.0), np.zeros(9)
    watch.judge(AmplifierState.OFF, coil_n)
    assert asked  # no force is commanded: they may be enabled
    watch.judge(AmplifierState.ENABLED, coil_n)
    watch.commanding(coil_n)
    with pytest.raises(AmplifierError, match="switched off"):
        watch.judge(AmplifierState.OFF, coil_n)
    watch.commanding(zero_n)  # as after every fault
    asked.clear()
    for _ in range(20):
        watch.judge(AmplifierState.OFF, coil_n)
    assert not asked
    watch.reset(lambda *_: (DeviceParameter.TRIPPED_COILS, 0))
    watch.judge(AmplifierState.OFF, coil_n)
    assert asked


@pytest.mark.parametrize("late", ["in flight", "after a fault", "in time"])
def test_challenge_is_answered_only_while_amplifiers_are_being_enabled(late: str) -> None:
    """It was asked for on the ground; what it leads to is force, or amplifiers on after a fault."""
    asked = []
    watch = AmplifierWatch(
        "amplifiers", expected_parameters(RIG, 3), lambda *what: asked.append(what), 2
    )
    zero_n = np.zeros(9)
    watch.judge(AmplifierState.OFF, zero_n)
    assert asked == [(Request.READ, DeviceParameter.CHALLENGE, 0)]
    if late != "in time":
        watch.commanding(np.full(9, 7.0))
    if late == "after a fault":
        with pytest.raises(AmplifierError):
            watch.judge(AmplifierState.TRIPPED, zero_n)
        watch.commanding(zero_n)
    watch.answered(DeviceParameter.CHALLENGE, 0x12345678)
    assert (asked[-1][0] == Request.ENABLE) == (late == "in time")
    watch.reset(lambda *_: (DeviceParameter.TRIPPED_COILS, 0))
    watch.answered(DeviceParameter.CHALLENGE, 0x12345678)
    assert asked[-1][0] == Request.ENABLE


def test_missing_position_is_requested_again() -> None:
    controller, syncs = Controller(RIG, 1e-3), []

    def read(beam: np.ndarray, rotor: np.ndarray) -> None:
        if len(syncs) == 2:
            raise StaleError("two in a row")
        beam[:] = rotor[:] = 0.02 if len(syncs) >= comes_at else np.nan

    devices = SimpleNamespace(
        syncs=(syncs.append,), drives=SimpleNamespace(read=read), reads_back=True
    )
    comes_at = 3
    locate(controller, devices, RIG, 7)  # type: ignore[arg-type]
    assert controller.beam_ref[0] == 0.02
    assert syncs == [7, 7, 7]
    comes_at = 1 << 40
    with pytest.raises(DriveError, match="no position"):
        locate(controller, devices, RIG, 7, timeout_s=0.01)  # type: ignore[arg-type]


@pytest.mark.parametrize("bus", ["can", "serial"])
def test_first_cycle_compiles_nothing(monkeypatch: pytest.MonkeyPatch, bus: str) -> None:
    """Compiling takes seconds if there is no cache."""
    called: set[object] = set()

    def note(module: object, name: str) -> None:
        function = getattr(module, name)

        def noting(*arguments: object) -> object:
            called.add((name, *map(typeof, arguments)))
            return function(*arguments)

        monkeypatch.setattr(module, name, noting)

    for module in (can_frames, cobs, int16_scaling, reading_checks):
        for name, member in list(vars(module).items()):
            if isinstance(member, Dispatcher):
                note(module, name)
    coils, gaps = np.zeros(9), np.zeros(9)
    watch = SensorWatch("sensors", RIG.geometry, 1e-3)
    if bus == "can":
        frames = can_frames.load_frames(None, 9, 9, True)
        before = called.copy()
        frames.setpoint.encode(coils, 12, 3)
        frames.gap.finish(gaps)
    else:
        port = serial_frames.SerialFrames(serial_frames.FrameContents(9, 9, True))
        before = called.copy()
        port.accept(port.cycle(12, coils, np.zeros(3), np.zeros(3))[:-1])
        port.amplifier_readings(coils)
        port.sensor_readings(gaps)
    watch.judge(gaps)
    assert len(before) == (3 if bus == "can" else 5)
    assert called == before
