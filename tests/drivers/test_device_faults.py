"""Every injected fault of the electronics leads to zero force within three cycles, and is named."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
from waiting import wait_until

from levid.benchmarks.bus import device_fault_reaction
from levid.config.base import parse_text
from levid.config.rig import RigConfig, with_model
from levid.config.shipped import shipped
from levid.drivers.base import (
    AmplifierError,
    Context,
    Devices,
    DriveError,
    DriverError,
    LinkError,
)
from levid.drivers.open_backends import open_devices
from levid.log.signals import Stale
from levid.sim.electronics.emulated_rig import Electronics
from levid.sim.electronics.faults import InjectionError
from levid.wire.can.can_bus import open_bus
from levid.wire.device_protocol import AmplifierState, DriveState

pytestmark = pytest.mark.usefixtures("host_paced")

RATE_HZ = 50.0
WITHIN_CYCLES = 3
LONG, SHORT = 20, 2
"""Cycles until setpoints expire. With LONG, only a zero force that is sent can end the force in
time; faults in which no frame arrives need SHORT."""

# What is injected: the error that the host raises, and words that name the cause.
_WORDS = device_fault_reaction
EXPECTED = list(_WORDS.EXPECTED)


@dataclass
class Bench:
    devices: Devices
    electronics: Electronics
    patience: Any
    cycle: int = -1

    def run(self, force_n: float) -> None:
        self.cycle += 1
        devices = self.devices
        gap_m, coil_n, beam, rotor = np.zeros(9), np.zeros(9), np.zeros(3), np.zeros(3)
        for sync in devices.syncs:
            sync(self.cycle)
        devices.sensors.read(gap_m)
        devices.drives.read(beam, rotor)
        devices.amplifiers.read(coil_n)
        devices.amplifiers.write(np.full(9, force_n))
        devices.drives.write(np.zeros(3), np.zeros(3))


@pytest.fixture(params=["can", "serial"])
def bench(request, rig_on, patience) -> Iterator[Bench]:
    with on_bench(rig_on(request.param, RATE_HZ, shipped("sims/nominal.yaml")), patience) as bench:
        yield bench


@contextmanager
def on_bench(rig: RigConfig, patience: Any) -> Iterator[Bench]:
    with Electronics(rig, Path()) as electronics:
        devices = open_devices(Context(rig, 1 / RATE_HZ, Path()))
        bench = Bench(devices, electronics, patience)
        try:
            yield bench
        finally:
            electronics.injector.clear()
            devices.close()


def fly(bench: Bench) -> None:
    """Enable the amplifiers, then command a force, as in flight."""
    for _ in range(50):
        bench.run(0.0)
    for _ in range(5):
        bench.run(7.0)
    assert bench.electronics.core.acting_n == pytest.approx(7.0, abs=1e-3)


def cycles_of_force(bench: Bench, most: int = 10) -> tuple[int, DriverError | None]:
    """Fly until no force acts; return in how many cycles it did, and what the host raised first.

    The loop's reaction is zero force at once, as well as the wire still allows, and from then on.
    """
    core, raised, acted = bench.electronics.core, None, 0
    for _ in range(most):
        try:
            bench.run(0.0 if raised else 7.0)
        except DriverError as error:
            raised = raised or error
            with suppress(LinkError):
                bench.devices.amplifiers.release(np.zeros(9))
        time.sleep(0.01)  # the rest of the period, in which further frames may arrive
        if bench.electronics.injector.receives:
            until_heard(bench)
        else:
            core.pass_period()  # without a host the plant runs on its own clock
        acted += bool(core.acting_n.any())
        if raised and not core.acting_n.any():
            break
    return acted, raised


def until_heard(bench: Bench) -> None:
    """Wait until the electronics have come to the host's cycle."""
    core = bench.electronics.core

    def heard() -> bool:
        with core.lock:
            return core.cycle == bench.cycle

    wait_until(heard)


@pytest.mark.parametrize("bus", ["can", "serial"])
@pytest.mark.parametrize("line", EXPECTED)
def test_fault_ends_in_zero_force_is_named_and_recovered(
    bus: str, line: str, rig_on, patience
) -> None:
    expire_cycles = SHORT if line in _WORDS.UNHEARD else LONG
    rig = rig_on(bus, RATE_HZ, shipped("sims/nominal.yaml"), expire_cycles)
    with on_bench(rig, patience) as bench:
        ends_in_zero_force_is_named_and_mended(bench, line)


def ends_in_zero_force_is_named_and_mended(bench: Bench, line: str) -> None:
    fly(bench)
    bench.patience.seconds = 0.05
    assert bench.electronics.injector.command(line) == line
    acted, raised = cycles_of_force(bench)
    assert _WORDS.names(raised, line), raised
    assert acted <= WITHIN_CYCLES
    # Without the fault, the same devices continue.
    bench.electronics.injector.clear()
    bench.patience.seconds = 2.0
    for _ in range(1000):  # the port is not open again at once
        try:
            bench.devices.recover()
            break
        except LinkError:
            time.sleep(0.01)
    fly(bench)


@pytest.mark.parametrize("why", ["askew", "released"])
def test_motors_are_switched_off_at_a_fault_that_only_the_host_detects(
    bench: Bench, why: str
) -> None:
    """Two skewed motors would push against each other until the fault is cleared."""
    devices, core = bench.devices, bench.electronics.core
    for _ in range(5):
        bench.run(0.0)
    if why == "askew":
        bench.electronics.injector.command("skew 0.001")
    else:
        devices.drives.release()
    raised = []
    for _ in range(6):
        try:
            bench.run(0.0)
        except DriveError as error:
            raised.append(error)
            devices.drives.write(np.zeros(3), np.zeros(3))  # as the loop does after an error
        until_heard(bench)
    assert len(raised) == (why == "askew")  # raised once
    assert core.drive_state is DriveState.OFF
    bench.electronics.injector.clear()
    devices.recover()
    for _ in range(5):
        bench.run(0.0)
    until_heard(bench)
    assert core.drive_state is DriveState.OPERATING


def test_lost_setpoint_is_marked_in_the_next_answer(bench: Bench) -> None:
    fly(bench)
    injector = bench.electronics.injector
    injector.command("drop-setpoints")
    bench.run(7.0)
    amplifiers = bench.devices.amplifiers
    if amplifiers.stale == 0:  # on CAN setpoints follow the answer: the next one reports it
        injector.command("clear")
        bench.run(7.0)
    assert amplifiers.stale == Stale.SETPOINTS
    injector.command("clear")
    for _ in range(2):
        bench.run(7.0)
    assert amplifiers.stale == 0


def test_consecutive_lost_setpoints_are_reported_before_they_expire(rig_on, patience) -> None:
    rig = rig_on("canfd", RATE_HZ, shipped("sims/nominal.yaml"), 10)
    with on_bench(rig, patience) as bench:
        fly(bench)
        bench.electronics.injector.command("drop-setpoints")
        words = "received no setpoints in 3 cycles"
        with pytest.raises(AmplifierError, match=words):  # noqa: PT012
            for _ in range(WITHIN_CYCLES + 1):
                bench.run(7.0)


def test_trip_stays_while_its_cause_remains(bench: Bench) -> None:
    fly(bench)
    bench.electronics.injector.command("trip 1")
    with pytest.raises(AmplifierError):  # noqa: PT012
        for _ in range(WITHIN_CYCLES):
            bench.run(7.0)
    with pytest.raises(AmplifierError, match="still tripped, coil 1"):
        bench.devices.recover()


def test_single_missed_answer_is_counted_and_bridged(bench: Bench) -> None:
    fly(bench)
    bench.patience.seconds = 0.05
    bench.electronics.injector.command("drop")
    bench.run(7.0)
    bench.electronics.injector.clear()
    bench.patience.seconds = 2.0
    stale = bench.devices.stale
    assert stale >= 1
    for _ in range(5):
        bench.run(7.0)
    assert bench.devices.stale == stale


@pytest.mark.parametrize("line", ["", "fly", "trip", "trip 9", "trip x", "drop 1", "encoder z"])
def test_invalid_injection_is_refused(bench: Bench, line: str) -> None:
    with pytest.raises((InjectionError, ValueError)):
        bench.electronics.injector.command(line)


def test_amplifiers_that_expired_at_zero_force_are_enabled_again_at_once(bench: Bench) -> None:
    """No clear is needed after a stall on the ground."""
    core = bench.electronics.core
    for _ in range(50):
        bench.run(0.0)
    for _ in range(3):
        core.pass_period()
    assert core.amplifier_state is AmplifierState.EXPIRED
    # State, challenge and response take a cycle each, and one more where an answer comes after the
    # reading; at 100 Hz the idling before a flight has thirty.
    for _ in range(10):
        bench.run(0.0)
    assert core.amplifier_state is AmplifierState.ENABLED


TWO_BUSES = """
can:
  force: {interface: virtual, channel: CHANNEL-force, stale_cycles: 20}
  motion: {interface: virtual, channel: CHANNEL-motion, stale_cycles: 20}
amplifiers: {backend: can, bus: force, expire_cycles: 20}
sensors: {backend: can, bus: motion}
drives: {backend: can, bus: motion}
"""
TWO_BACKENDS = """
can: {main: {interface: virtual, channel: CHANNEL, stale_cycles: 20}}
serial: {main: {port: CHANNEL/port, baud: 3000000, stale_cycles: 20}}
amplifiers: {backend: can, bus: main, expire_cycles: 20}
sensors: {backend: serial, bus: main}
drives: {backend: serial, bus: main}
"""
TWO_PORTS = """
serial:
  force: {port: CHANNEL/force, baud: 3000000, stale_cycles: 20}
  motion: {port: CHANNEL/motion, baud: 3000000, stale_cycles: 20}
amplifiers: {backend: serial, bus: force, expire_cycles: 20}
sensors: {backend: serial, bus: motion}
drives: {backend: serial, bus: motion}
"""


def rig_of(text: str, folder: Path) -> RigConfig:
    head = shipped("rigs/loopback.yaml").read_text().partition("amplifiers:")[0]
    head = head.replace("rate_hz: 1000", f"rate_hz: {RATE_HZ}")
    sim = f"sim: {shipped('sims/nominal.yaml')}"
    rig = parse_text(f"{head}{text.replace('CHANNEL', str(folder))}{sim}", RigConfig, "two")
    return with_model(rig, shipped("rigs/loopback.yaml"))


@pytest.fixture
def unplug(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """A function that lets every use of a bus fail from now on, as if its adapter were unplugged.

    The bus is named by the end of its channel or port.
    """
    buses: dict[str, Any] = {}

    def noted(bus: str, opened: Any) -> Any:
        return buses.setdefault(bus, opened)

    by_url = serial.serial_for_url
    monkeypatch.setattr(
        "levid.drivers.can.bus_link.open_bus",
        lambda config: noted(str(config.channel), open_bus(config)),
    )
    monkeypatch.setattr(
        serial,
        "serial_for_url",
        lambda url, *rest, **more: noted(url, by_url(url, *rest, **more)),
    )

    def gone(*_: object) -> None:
        raise OSError(19, "No such device")

    def unplug(end: str) -> None:
        (bus,) = (bus for name, bus in buses.items() if name.endswith(end))
        if hasattr(bus, "receive"):
            bus.receive = gone
            return
        reader, writer = os.pipe()  # writing fails without a reader, and reading fails anyway
        os.close(reader)
        os.dup2(writer, bus.fileno())
        os.close(writer)

    return unplug


@pytest.mark.parametrize(
    ("text", "lost"), [(TWO_BUSES, "-motion"), (TWO_PORTS, "/motion"), (TWO_BACKENDS, "/port")]
)
def test_lost_bus_keeps_no_force_on_another(
    text: str, lost: str, tmp_path: Path, patience, unplug: Callable[[str], None]
) -> None:
    with on_bench(rig_of(text, tmp_path), patience) as bench:
        fly(bench)
        # The lost bus comes first.
        bench.devices = replace(bench.devices, backends=bench.devices.backends[::-1])
        unplug(lost)
        acted, raised = cycles_of_force(bench)
        assert isinstance(raised, LinkError)
        assert acted <= 1  # the force of the cycle in which it was lost
