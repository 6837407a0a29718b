"""The shipped rig on each backend, its electronics in another process, and a cycle of it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from levid.config.base import parse_text
from levid.config.rig import RigConfig
from levid.config.shipped import shipped
from levid.drivers.base import Context, Devices
from levid.drivers.registry import open_devices

RATE_HZ = 1000.0
HEAD = shipped("rigs/loopback.yaml").read_text().partition("amplifiers:")[0]
CAN = "{backend: can, bus: main"
SERIAL = "{backend: serial, bus: main"
FD = (
    "can: {main: {interface: INTERFACE, channel: CHANNEL, data_bitrate: 5000000, "
    "stale_cycles: 1000}}",
    CAN,
)
BUSES = {
    "can": (  # two buses: one classic one does not carry 1 kHz
        "can: {main: {interface: INTERFACE, channel: CHANNEL, stale_cycles: 1000}, "
        "motion: {interface: INTERFACE, channel: CHANNEL-2, stale_cycles: 1000}}",
        CAN,
    ),
    "canfd": FD,
    "canfd_udp": FD,
    "serial": ("serial: {main: {port: FOLDER/port, baud: 3000000, stale_cycles: 1000}}", SERIAL),
}
VIRTUAL = ("virtual", "bench")
INTERFACES = {
    "canfd": ("levid_local", "FOLDER/bus"),
    "canfd_udp": ("udp_multicast", "239.74.163.17"),
}
IN_ONE_PROCESS = ("can", "canfd", "serial")
TIMED = ("canfd", "canfd_udp", "serial")
"""With the electronics in a process of their own."""


def rig_text(name: str, folder: Path, by: tuple[str, str] | None = None) -> str:
    """Return the text of the shipped rig with every role on this backend.

    `by`: interface and channel of CAN, if other than its own.
    """
    if name == "loopback":
        return f"""{HEAD}
amplifiers: {{backend: loopback}}
sensors: {{backend: loopback}}
drives: {{backend: loopback}}
sim: {shipped("sims/nominal.yaml")}
"""
    buses, role = BUSES[name]
    interface, channel = by or INTERFACES.get(name, ("", ""))
    if interface == "udp_multicast":
        # Its own: a kernel hands frames of any group to all sockets of a port.
        port = 20_000 + os.getpid() % 20_000
        buses = buses.replace("CHANNEL", f"CHANNEL, options: {{port: {port}}}")
    buses = buses.replace("INTERFACE", interface).replace("CHANNEL", channel)
    buses = buses.replace("FOLDER", str(folder))
    every = ", every: 4, expire_s: 60" if name.startswith("can") else ""
    other = role.replace("main", "motion") if name == "can" else role
    return f"""{HEAD}
{buses}
amplifiers: {role}, expire_cycles: 1000}}
sensors: {other}}}
drives: {other}{every}}}
sim: {shipped("sims/nominal.yaml")}
"""


def rig_on(name: str, folder: Path, by: tuple[str, str] | None = None) -> RigConfig:
    """Return that rig."""
    return parse_text(rig_text(name, folder, by), RigConfig, name)


def cycle_of(devices: Devices) -> Callable[[int], None]:
    """Return what the loop does with devices in a cycle, at zero force."""
    gap, force, zero = np.zeros(9), np.zeros(9), np.zeros(9)
    beam, rotor, still = np.zeros(3), np.zeros(3), np.zeros(3)

    def cycle(k: int) -> None:
        for sync in devices.syncs:
            sync(k)
        devices.sensors.read(gap)
        devices.drives.read(beam, rotor)
        devices.amplifiers.read(force)
        devices.amplifiers.write(zero)
        devices.drives.write(still, still)

    return cycle


def electronics_of(rig_file: Path) -> subprocess.Popen[bytes]:
    """Start the electronics of a rig in a process of their own."""
    return subprocess.Popen(
        [sys.executable, "-m", "levid.cli.main", "electronics", str(rig_file)],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def opened(rig: RigConfig, folder: Path) -> Devices:
    """Open devices once their electronics, which are just being started, answer."""
    give_up_s = time.monotonic() + 30.0
    while True:
        try:
            return open_devices(Context(rig, 1 / RATE_HZ, folder))
        except Exception:
            if time.monotonic() > give_up_s:
                raise
            time.sleep(0.2)
