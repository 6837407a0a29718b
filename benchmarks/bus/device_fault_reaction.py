"""Inject every fault of a bus or a device: cycles until zero force, and the error of the host.

The host sets the pace, cycle by cycle, so that the count does not depend on the machine. A cycle
counts if a force acts in it, from the one in which the fault begins. The reaction is that of the
loop: zero force at once and in every later cycle. Setpoints expire after 20 cycles, so that only
this reaction ends the force in time; after 2 cycles if a fault stops everything that the host
sends. The fault stays for a while after that: no force may come back.
"""

from __future__ import annotations

import contextlib
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.config.base import parse_text
from levid.config.rig import RigConfig, with_model
from levid.config.shipped import shipped
from levid.drivers import bus_backend
from levid.drivers.base import (
    AmplifierError,
    Context,
    Devices,
    DriveError,
    DriverError,
    LinkError,
    SensorError,
    StaleError,
)
from levid.drivers.open_backends import open_devices
from levid.sim.electronics import emulated_devices
from levid.sim.electronics.emulated_devices import Core
from levid.sim.electronics.emulated_rig import Electronics

EXPECTED: dict[str, tuple[tuple[type[DriverError], ...], str]] = {
    "drop": ((StaleError,), "received: nothing"),
    "drop-setpoints": ((AmplifierError,), "setpoints expired"),
    "delay": ((StaleError,), "too late"),
    "corrupt": ((StaleError,), "wrong checksum|invalid framing"),
    "repeat": ((StaleError,), "of another cycle|too late"),
    "reorder": ((StaleError,), "of another cycle"),
    "bus-off": ((LinkError, StaleError), "the controller is bus-off|^serial .*received: nothing"),
    "disconnect": ((StaleError, LinkError), "received: nothing|lost"),
    "stuck 4": ((SensorError,), "sensor 4: no reading"),
    "saturated 2": ((SensorError,), "sensor 2: at the end of its range"),
    "trip 3": ((AmplifierError,), "tripped, coil 3"),
    "encoder phi": ((DriveError,), "0x7305"),
    "skew 0.001": ((DriveError,), "X1 and X2 .* found 1.000 mm"),
}
"""Error of the host, and words in it, for each line that injects a fault."""
UNHEARD = ("drop-setpoints", "bus-off", "disconnect")
"""Faults that stop everything that the host sends: only the device's own expiry ends the force."""
NOT_REPORTED = {
    "push",
    "lift",
    "frozen",
    "off",
    "coil-force",
    "coil-gain",
    "coil-offset",
    "jam",
    "slow",
}
"""A force on the platform, which control has to hold, a hand that lifts it, and faults that neither
device nor driver detects: the control cycle judges readings and compares them with commands."""

RATE_HZ = 50.0
MOST_CYCLES = 60
AFTER_CYCLES = 25
"""Cycles in which no force may come back: more than setpoints take to expire."""
EXPIRE_CYCLES, EXPIRE_UNHEARD_CYCLES = 20, 2
SOON = 3
_PACE_S = 0.01
"""A pause within the cycle, for frames that follow an answer."""
BUSES = {
    "can": "can: {main: {interface: virtual, channel: faults, stale_cycles: 2}}",
    "canfd": "can: {main: {interface: virtual, channel: faults, data_bitrate: 5000000, "
    "stale_cycles: 2}}",
    "serial": "serial: {main: {port: FOLDER/port, baud: 3000000, stale_cycles: 2}}",
}


def names(error: DriverError | None, line: str) -> bool:
    """Return whether an error names the fault that this line injected."""
    kinds, words = EXPECTED[line]
    return isinstance(error, kinds) and re.search(words, str(error)) is not None


class Played(NamedTuple):
    """Cycles with force until it first ended, and after that; the first error of the host."""

    forced: int
    came_back: int
    raised: DriverError | None

    @property
    def words(self) -> str:
        """The error without its place."""
        if self.raised is None:
            return "not found"
        text = str(self.raised)
        return f"{type(self.raised).__name__}: {text.partition(': ')[2] or text}"


def measure(quick: bool) -> list[Figure]:
    emulated_devices._SILENT_PERIODS = 1e9  # type: ignore[misc]
    bus_backend._ANSWER_SHARE = bus_backend._SETPOINTS_SHARE = 1e4  # type: ignore[misc]
    figures, named, came_back, slowest = [], [], 0, 0
    for bus in ("canfd", "serial") if quick else BUSES:
        for line in EXPECTED:
            try:
                played = until_zero(bus, line)
            except TimeoutError as error:
                print(f"{bus}: {line}: failed: {error}", file=sys.stderr)
                played = Played(MOST_CYCLES, 0, None)
            right = names(played.raised, line)
            if not right:
                print(f"{bus}: {line}: not named: {played.words}", file=sys.stderr)
            named.append(right)
            came_back += played.came_back > 0
            slowest = max(slowest, played.forced)
            key = f"{bus}_{line.split()[0].replace('-', '_')}_cycles"
            figures.append(Figure(key, played.forced, "", f"{bus}: {line}: {played.words}"))
    return [
        *figures,
        Figure("most_cycles", slowest, "", "most cycles", target=Target(most=SOON)),
        Figure(
            "named", sum(named) / len(named), "", f"share of {len(named)} faults named",
            target=Target(least=1),
        ),
        Figure(
            "came_back", came_back, "", "faults after which a force came back",
            target=Target(most=0),
        ),
    ]  # fmt: skip


def until_zero(bus: str, line: str) -> Played:
    """Fly, inject a fault and go on until no force acts, and for a while longer.

    Raises:
        TimeoutError: the electronics did not come to a cycle.
    """
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


def _play(devices: Devices, electronics: Electronics, line: str) -> Played:
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
    device = electronics.core
    raised: DriverError | None = None
    forced = came_back = after = 0
    for k in range(1, MOST_CYCLES):
        try:
            run(0.0 if raised else 7.0 + 0.5 * (k // 5 % 2))
        except DriverError as error:
            raised = raised or error
            with contextlib.suppress(DriverError):  # the bus is lost: setpoints expire
                devices.amplifiers.release(np.zeros(9))
        time.sleep(_PACE_S)
        if electronics.injector.receives:
            _wait_for(device, cycle)
        else:  # its own clock goes on, in step with the host's
            device.pass_period()
        acts = bool(device.acting_n.any())
        if after:
            came_back += acts
            after += 1
        else:
            forced += acts
            after = int(raised is not None and not acts)
        if after > AFTER_CYCLES:
            return Played(forced, came_back, raised)
    return Played(MOST_CYCLES, came_back, raised)


def _wait_for(device: Core, cycle: int) -> None:
    """Wait until the electronics have come to the host's cycle; TimeoutError after 5 s."""
    give_up_s = time.monotonic() + 5.0
    while device.cycle != cycle:
        if time.monotonic() > give_up_s:
            raise TimeoutError(f"the electronics are at cycle {device.cycle}, the host at {cycle}")
        time.sleep(0.001)


def _answers_by(devices: Devices, seconds: float) -> None:
    for backend in devices.backends:
        for waiting in getattr(backend, "_ports", {"": backend}).values():
            waiting._answers = bus_backend.AnswerTime(seconds)


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
    return with_model(parse_text(text, RigConfig, bus), shipped("rigs/loopback.yaml"))


if __name__ == "__main__":
    benchmark_runner.run("Faults of buses and devices: cycles until zero force", measure)
