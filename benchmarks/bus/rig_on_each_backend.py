"""The shipped rig on each backend, and a cycle of its devices."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from levid.benchmarks.harness.start_and_end_processes import started
from levid.config.base import parse_text
from levid.config.rig import RigConfig, with_model
from levid.config.shipped import shipped
from levid.drivers.base import Context, Devices, DriverError
from levid.drivers.open_backends import open_devices

RATE_HZ = 1000.0
LABELS = {
    "loopback": "loopback",
    "can": "classic CAN on local sockets",
    "canfd": "CAN FD on local sockets",
    "canfd_udp": "CAN FD by udp_multicast",
    "serial": "serial on a pty",
}
_PATIENT = "stale_cycles: 1000"
_LOCAL = "interface: levid_local, channel: FOLDER/bus"
# udp_multicast on a port of its own: a kernel passes frames of any group to all sockets of a port.
_UDP = (
    "interface: udp_multicast, channel: 239.74.163.17, "
    f"options: {{port: {20_000 + os.getpid() % 20_000}}}"
)
_BUSES = {
    # One bus for each role, as in the shipped rig: two classic buses carry less than 1 kHz.
    "can": (
        f"can: {{main: {{{_LOCAL}, {_PATIENT}}}, gap: {{{_LOCAL}-2, {_PATIENT}}}, "
        f"motion: {{{_LOCAL}-3, {_PATIENT}}}}}"
    ),
    "canfd": f"can: {{main: {{{_LOCAL}, data_bitrate: 5000000, {_PATIENT}}}}}",
    "canfd_udp": f"can: {{main: {{{_UDP}, data_bitrate: 5000000, {_PATIENT}}}}}",
    "serial": f"serial: {{main: {{port: FOLDER/port, baud: 3000000, {_PATIENT}}}}}",
}
_HEAD = shipped("rigs/loopback.yaml").read_text().partition("amplifiers:")[0]
_ANSWERS_S = 30.0


def rig_text(name: str, folder: Path) -> str:
    """Return the text of the shipped rig with every role on this backend."""
    head = _HEAD.replace("../models/rig.yaml", str(shipped("models/rig.yaml")))
    amplifiers = sensors = drives = "backend: loopback"
    if name != "loopback":
        backend = "serial" if name == "serial" else "can"
        gap, motion = ("gap", "motion") if name == "can" else ("main", "main")
        amplifiers = f"backend: {backend}, bus: main, expire_cycles: 1000"
        sensors = f"backend: {backend}, bus: {gap}"
        every = ", every: 4, expire_s: 60" if backend == "can" else ""
        drives = f"backend: {backend}, bus: {motion}{every}"
    return f"""{head}
{_BUSES.get(name, "").replace("FOLDER", str(folder))}
amplifiers: {{{amplifiers}}}
sensors: {{{sensors}}}
drives: {{{drives}}}
sim: {shipped("sims/nominal.yaml")}
"""


def rig_on(name: str, folder: Path) -> RigConfig:
    """Return the shipped rig with every role on this backend."""
    return with_model(parse_text(rig_text(name, folder), RigConfig, name), folder / name)


def cycle_of(devices: Devices) -> Callable[[int], bool]:
    """Return a cycle at zero force, which returns whether all readings are fresh."""
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


@contextmanager
def electronics_on(rig_file: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run the emulated electronics of a rig in a separate process."""
    command = [sys.executable, "-m", "levid.cli.main", "electronics", str(rig_file)]
    pipes = {"stdin": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with started(command, **pipes) as process:
        yield process


@contextmanager
def opened(rig: RigConfig, folder: Path) -> Iterator[Devices]:
    """Open devices, as soon as their electronics answer; raises DriverError after 30 s."""
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
