"""Every fault of a bus or a device: cycles until zero force, and what the host calls it.

The host sets the pace, cycle by cycle, so that the count does not depend on the machine. A cycle is
counted from the one in which the fault is switched on; the reaction is that of the loop, zero force
at once, and where it no longer gets through the amplifiers' own expiry.
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
from levid.sim.electronics.faults import FAULTS
from levid.sim.electronics.rig import Electronics

RATE_HZ = 50.0
MOST_CYCLES = 40
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


def measure(quick: bool) -> list[Figure]:
    assert {line.split()[0] for line in LINES} == set(FAULTS)
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
    """Return the cycles until the amplifiers drive no force, and the error that the host raises."""
    with tempfile.TemporaryDirectory() as text:
        rig = _rig(bus, Path(text))
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
    device, zero_after = electronics.core, 0
    for k in range(1, MOST_CYCLES):
        words = ""
        try:
            run(7.0 + 0.5 * (k // 5 % 2))
        except DriverError as error:
            words = f"{type(error).__name__}: {str(error).partition(': ')[2] or error}"
            with contextlib.suppress(DriverError):  # it is gone: the device's own expiry has to do
                devices.amplifiers.release(np.zeros(9))
        time.sleep(_PACE_S)
        if not electronics.injector.hears:  # its own clock goes on, in step with the host's
            device._period()
        if not zero_after and not device.acting_n.any():
            zero_after = k
        if words:
            return zero_after or k + _more_periods(electronics), words
    return MOST_CYCLES, "not found"


def _more_periods(electronics: Electronics) -> int:
    """Return the periods until no force acts, of which what was released takes over one."""
    device = electronics.core
    give_up_s = time.monotonic() + 5.0
    while electronics.injector.hears and device.pending_n.any() and time.monotonic() < give_up_s:
        time.sleep(0.001)  # it is on its way
    for k in range(MOST_CYCLES):
        if not (device.pending_n if electronics.injector.hears else device.acting_n).any():
            return k
        device._period()
    return MOST_CYCLES


def _answers_by(devices: Devices, seconds: float) -> None:
    for backend in devices.backends:
        for waiting in getattr(backend, "_ports", {"": backend}).values():
            waiting._wait_s = seconds


def _rig(bus: str, folder: Path) -> RigConfig:
    head = shipped("rigs/loopback.yaml").read_text().partition("amplifiers:")[0]
    backend = "serial" if bus == "serial" else "can"
    role = f"{{backend: {backend}, bus: main"
    text = f"""{head.replace("rate_hz: 1000", f"rate_hz: {RATE_HZ}")}
{BUSES[bus].replace("FOLDER", str(folder))}
amplifiers: {role}, expire_cycles: 2}}
sensors: {role}}}
drives: {role}}}
sim: {shipped("sims/nominal.yaml")}
"""
    return parse_text(text, RigConfig, bus)


if __name__ == "__main__":
    _table.run("Faults of buses and devices: cycles until zero force", measure)
