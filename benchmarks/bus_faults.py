"""Every fault of a bus or a device: cycles until zero force, and what the host calls it.

The host sets the pace, cycle by cycle, so that the count does not depend on the machine. A cycle
counts if a force acts in it, from the one on in which the fault is switched on. The reaction is
that of the loop, zero force at once and in every cycle that follows; setpoints expire after 20
cycles, so that this alone can end the force in time, but where nothing gets through: there after 2.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from pathlib import Path

import _table
import numpy as np
from _table import Figure

from levid.config.base import parse_text
from levid.config.rig import RigConfig
from levid.config.shipped import shipped
from levid.drivers import on_bus
from levid.drivers.base import Context, Devices, DriverError
from levid.drivers.registry import open_devices
from levid.sim.electronics import core
from levid.sim.electronics.core import Core
from levid.sim.electronics.faults import FAULTS
from levid.sim.electronics.rig import Electronics

RATE_HZ = 50.0
MOST_CYCLES = 40
EXPIRE_CYCLES, EXPIRE_UNHEARD_CYCLES = 20, 2
_PACE_S = 0.01
"""What comes behind an answer comes within the cycle, which is longer than that."""
LINES = [
    "drop", "drop-setpoints", "delay", "corrupt", "repeat", "reorder", "bus-off", "disconnect",
    "stuck 4", "frozen 6", "saturated 2", "trip 3", "encoder phi", "skew 0.001",
]  # fmt: skip
BUSES = {
    "can": "can: {main: {interface: virtual, channel: faults, stale_cycles: 2}}",
    "canfd": "can: {main: {interface: virtual, channel: faults, data_bitrate: 5000000, "
    "stale_cycles: 2}}",
    "serial": "serial: {main: {port: FOLDER/port, baud: 3000000, stale_cycles: 2}}",
}


UNHEARD = ("drop-setpoints", "bus-off", "disconnect")
NO_FAULT_OF_A_DEVICE = {"push"}


def measure(quick: bool) -> list[Figure]:
    assert {line.split()[0] for line in LINES} == set(FAULTS) - NO_FAULT_OF_A_DEVICE
    core._SILENT_PERIODS = 1e9  # type: ignore[misc]
    on_bus._ANSWER_SHARE = 1e4  # type: ignore[misc]
    figures = []
    for bus in ("canfd", "serial") if quick else BUSES:
        for line in LINES:
            cycles, name = until_zero(bus, line)
            key = f"{bus}_{line.split()[0].replace('-', '_')}_cycles"
            figures.append(Figure(key, cycles, "", f"{bus}: {line}: {name}"))
    worst = max(figure.value for figure in figures)
    return [*figures, Figure("most_cycles", worst, "", "the slowest of them")]


def until_zero(bus: str, line: str) -> tuple[int, str]:
    """Return the cycles in which the amplifiers drive force, and the error that the host raises."""
    with tempfile.TemporaryDirectory() as text:
        expire = EXPIRE_UNHEARD_CYCLES if line in UNHEARD else EXPIRE_CYCLES
        rig = _rig(bus, Path(text), expire)
        with Electronics(rig, Path(text)) as electronics:
            devices = open_devices(Context(rig, 1.0 / RATE_HZ, Path(text)))
            try:
                return _play(devices, electronics, line)
            finally:
                electronics.injector.clear()
                devices.close()


def _play(devices: Devices, electronics: Electronics, line: str) -> tuple[int, str]:
    cycle = -1
    gap, coil, beam, rotor = np.zeros(9), np.zeros(9), np.zeros(3), np.zeros(3)

    def run(force_n: float) -> None:
        nonlocal cycle
        cycle += 1
        for sync in devices.syncs:
            sync(cycle)
        devices.sensors.read(gap)
        devices.drives.read(beam, rotor)
        devices.amplifiers.read(coil)
        devices.amplifiers.write(np.full(9, force_n))
        devices.drives.write(np.zeros(3), np.zeros(3))

    for _ in range(50):
        run(0.0)
    for k in range(10):
        run(7.0 + 0.5 * (k // 5 % 2))
    _answers_by(devices, 0.05)
    electronics.injector.command(line)
    device, words, forced = electronics.core, "", 0
    for k in range(1, MOST_CYCLES):
        try:
            run(0.0 if words else 7.0 + 0.5 * (k // 5 % 2))
        except DriverError as error:
            words = words or f"{type(error).__name__}: {str(error).partition(': ')[2] or error}"
            with contextlib.suppress(DriverError):  # it is gone: the device's own expiry has to do
                devices.amplifiers.release(np.zeros(9))
        time.sleep(_PACE_S)
        if electronics.injector.hears:
            _wait_for(device, cycle)
        else:  # its own clock goes on, in step with the host's
            device._period()
        forced += bool(device.acting_n.any())
        if words and not device.acting_n.any():
            return forced, words
    return MOST_CYCLES, words or "not found"


def _wait_for(device: Core, cycle: int) -> None:
    """Wait until the electronics have come to the host's cycle, at most 5 s."""
    give_up_s = time.monotonic() + 5.0
    while device.cycle != cycle and time.monotonic() < give_up_s:
        time.sleep(0.001)


def _answers_by(devices: Devices, seconds: float) -> None:
    for backend in devices.backends:
        for waiting in getattr(backend, "_ports", {"": backend}).values():
            waiting._wait_s = seconds


def _rig(bus: str, folder: Path, expire_cycles: int) -> RigConfig:
    head = shipped("rigs/loopback.yaml").read_text().partition("amplifiers:")[0]
    backend = "serial" if bus == "serial" else "can"
    role = f"{{backend: {backend}, bus: main"
    text = f"""{head.replace("rate_hz: 1000", f"rate_hz: {RATE_HZ}")}
{BUSES[bus].replace("FOLDER", str(folder))}
amplifiers: {role}, expire_cycles: {expire_cycles}}}
sensors: {role}}}
drives: {role}}}
sim: {shipped("sims/nominal.yaml")}
"""
    return parse_text(text, RigConfig, bus)


if __name__ == "__main__":
    _table.run("Faults of buses and devices: cycles until zero force", measure)
