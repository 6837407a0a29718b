"""The shipped rig on each backend, its electronics in another process, and a cycle of it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from levid.config.base import parse_text
from levid.config.rig import RigConfig, with_model
from levid.config.shipped import shipped
from levid.drivers.base import Context, Devices, DriverError
from levid.drivers.registry import open_devices

RATE_HZ = 1000.0
HEAD = shipped("rigs/loopback.yaml").read_text().partition("amplifiers:")[0]
HEAD = HEAD.replace("../models/rig.yaml", str(shipped("models/rig.yaml")))
CAN = "{backend: can, bus: main"
SERIAL = "{backend: serial, bus: main"
FD = (
    "can: {main: {interface: INTERFACE, channel: CHANNEL, data_bitrate: 5000000, "
    "stale_cycles: 1000}}",
    CAN,
)
BUSES = {
    "can": (  # a bus a role, as in the shipped rig: two classic ones carry 896 Hz
        "can: {main: {interface: INTERFACE, channel: CHANNEL, stale_cycles: 1000}, "
        "gap: {interface: INTERFACE, channel: CHANNEL-2, stale_cycles: 1000}, "
        "motion: {interface: INTERFACE, channel: CHANNEL-3, stale_cycles: 1000}}",
        CAN,
    ),
    "canfd": FD,
    "canfd_udp": FD,
    "canfd_virtual": FD,
    "serial": ("serial: {main: {port: FOLDER/port, baud: 3000000, stale_cycles: 1000}}", SERIAL),
}
INTERFACES = {
    "can": ("levid_local", "FOLDER/bus"),
    "canfd": ("levid_local", "FOLDER/bus"),
    "canfd_udp": ("udp_multicast", "239.74.163.17"),
    "canfd_virtual": ("virtual", "bench"),
}
APART = ("can", "canfd", "canfd_udp", "serial")
"""With the electronics in a process of their own."""
TIMED = ("canfd", "canfd_udp", "serial")
LABELS = {
    "can": "classic CAN on local sockets",
    "canfd": "CAN FD on local sockets",
    "canfd_udp": "CAN FD by udp_multicast",
    "canfd_virtual": "CAN FD on python-can's virtual bus",
    "serial": "serial on a pty",
    "loopback": "loopback",
}
_ANSWERS_S, _ENDS_S = 30.0, 10.0


def rig_text(name: str, folder: Path) -> str:
    """Return the text of the shipped rig with every role on this backend."""
    if name == "loopback":
        return f"""{HEAD}
amplifiers: {{backend: loopback}}
sensors: {{backend: loopback}}
drives: {{backend: loopback}}
sim: {shipped("sims/nominal.yaml")}
"""
    buses, role = BUSES[name]
    interface, channel = INTERFACES.get(name, ("", ""))
    if interface == "udp_multicast":
        # Its own: a kernel hands frames of any group to all sockets of a port.
        port = 20_000 + os.getpid() % 20_000
        buses = buses.replace("CHANNEL", f"CHANNEL, options: {{port: {port}}}")
    buses = buses.replace("INTERFACE", interface).replace("CHANNEL", channel)
    buses = buses.replace("FOLDER", str(folder))
    every = ", every: 4, expire_s: 60" if name.startswith("can") else ""
    gap, motion = ("gap", "motion") if name == "can" else ("main", "main")
    return f"""{HEAD}
{buses}
amplifiers: {role}, expire_cycles: 1000}}
sensors: {role.replace("main", gap)}}}
drives: {role.replace("main", motion)}{every}}}
sim: {shipped("sims/nominal.yaml")}
"""


def rig_on(name: str, folder: Path) -> RigConfig:
    """Return that rig."""
    return with_model(parse_text(rig_text(name, folder), RigConfig, name), folder / name)


def cycle_of(devices: Devices) -> Callable[[int], bool]:
    """Return what the loop does with devices in a cycle, at zero force.

    It returns whether all readings were of the cycle itself.
    """
    gap, force, zero = np.zeros(9), np.zeros(9), np.zeros(9)
    beam, rotor, still = np.zeros(3), np.zeros(3), np.zeros(3)

    def cycle(k: int) -> bool:
        for sync in devices.syncs:
            sync(k)
        devices.sensors.read(gap)
        devices.drives.read(beam, rotor)
        devices.amplifiers.read(force)
        devices.amplifiers.write(zero)
        devices.drives.write(still, still)
        return not devices.stale_roles

    return cycle


def electronics_of(rig_file: Path) -> subprocess.Popen[bytes]:
    """Start the electronics of a rig in a process of their own."""
    return subprocess.Popen(
        [sys.executable, "-m", "levid.cli.main", "electronics", str(rig_file)],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


@contextmanager
def electronics_on(rig_file: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run the electronics of a rig in a process of their own, and end it."""
    process = electronics_of(rig_file)
    try:
        yield process
    finally:
        end(process)


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process: by asking, and by force where that is not heard."""
    process.terminate()
    try:
        process.wait(_ENDS_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(_ENDS_S)


@contextmanager
def opened(rig: RigConfig, folder: Path) -> Iterator[Devices]:
    """Open devices once their electronics, which are just being started, answer; and close them."""
    give_up_s = time.monotonic() + _ANSWERS_S
    while True:
        try:
            devices = open_devices(Context(rig, 1 / RATE_HZ, folder))
            break
        except DriverError:
            if time.monotonic() > give_up_s:
                raise
            time.sleep(0.2)
    try:
        yield devices
    finally:
        devices.close()
