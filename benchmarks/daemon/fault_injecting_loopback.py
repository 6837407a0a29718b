"""Loopback backend that injects faults, and the client that asks it to.

The backend runs in the loop. At the start of a cycle it takes one line from a socket in the rig's
folder: `push 50` (N), `tilt 0.6` (N m), `shift 0.2` (offset of the beam's encoders, m), `race 2.0`
(their drift, m/s), `nan-coil 3`, `nan-axis x1`, `coil-force 3=7.6`, `coil-gain 3=0.5`, `coil-offset
3=2`, `jam x1`, `slow phi` (as in `levid electronics`), a line of sensor_errors, or a fault that the
backend itself reports, such as `trip 3`: see REPORTED. The simulated amplifiers end with the loop,
and stand still with it.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import socket
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from levid.benchmarks.daemon.fault_injecting_electronics import ENDS
from levid.benchmarks.daemon.sensor_errors import NAMES, SensorErrors
from levid.drivers.base import (
    AmplifierError,
    Context,
    DriveError,
    DriverError,
    LinkError,
    SensorError,
    StaleError,
)
from levid.drivers.loopback import LoopbackBackend
from levid.sim.electronics.faulty_actuators import Array, FaultyActuators

BACKEND = "fault_injecting_loopback"
"""Name of the backend in RIG.yaml."""
REPORTED: dict[str, type[DriverError]] = {
    "drop": StaleError,
    "stuck": SensorError,
    "trip": AmplifierError,
    "encoder": DriveError,
    "disconnect": LinkError,
}
"""Faults that the backend reports, as a driver would."""
_MOST_BYTES = 1 << 14
_ANSWER_S = 1.0


class FaultInjectingLoopback(LoopbackBackend):
    """The simulated rig, with faults on request."""

    def __init__(self, context: Context, roles: dict[str, dict[str, Any]]) -> None:
        super().__init__(context, roles)
        self._period_s = period_s = context.period_s
        self._actuators = actuators = FaultyActuators()
        advance = self._plant.advance

        def advanced(coil_n: Array, beam: Array, rotor: Array) -> None:
            advance(actuators.forces(coil_n), *actuators.motion(np.stack([beam, rotor]), period_s))

        self._plant.advance = advanced  # type: ignore[method-assign]
        self._faults: dict[str, str] = {}
        self._raced_m = 0.0
        self._sensor_errors = SensorErrors(len(self._plant.gap_m), context.period_s)
        self._forced_periods = 0
        self._ends_s = deque[float](maxlen=ENDS)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        path = _backend_socket(context.folder)
        path.unlink(missing_ok=True)  # of a loop that was killed
        self._socket.bind(str(path))

    def sync(self, cycle: int, late_s: float = 0.0) -> None:
        """Take a line, advance the plant, count the periods with force and spoil the readings."""
        self._take_line()
        before = cycle if self._cycle is None else self._cycle
        acts = self._actuators.forces(self._acting.coil_n).any()
        super().sync(cycle, late_s)
        if acts:
            self._forced_periods += cycle - before
            self._ends_s += [time.monotonic()] * (cycle - before)
        self._spoil()

    def recover(self) -> None:
        """Fail as long as the bus is lost."""
        if "disconnect" in self._faults:
            raise LinkError("the bus is still lost (injected)")

    def close(self) -> None:
        """Command zero force; listen no longer."""
        super().close()
        self._socket.close()

    def _take_line(self) -> None:
        try:
            text, address = self._socket.recvfrom(_MOST_BYTES)
        except BlockingIOError:
            return
        number, line = json.loads(text)
        answer: dict[str, Any] = {
            "number": number,
            "pid": os.getpid(),
            "acting_n": self._acting.coil_n.tolist(),
            "driven_n": self._actuators.forces(self._acting.coil_n).tolist(),
            "forced_periods": self._forced_periods,
            "force_ends_s": list(self._ends_s),
        }
        name, _, argument = line.partition(" ")
        if name == "clear":
            self._faults.clear()
            self._actuators.clear()
            self._sensor_errors.clear()
            self._raced_m = 0.0
        elif name.startswith("coil-"):
            coil, _, number = argument.partition("=")
            self._actuators.set_force(name, int(coil), float(number))
        elif name in ("jam", "slow"):
            self._actuators.delay_drive(name, argument)
        elif name in NAMES:
            self._sensor_errors.command(line)
        elif name != "status":
            self._faults[name] = argument
        push, tilt = (float(self._faults.get(name, 0.0)) for name in ("push", "tilt"))
        self._plant.push(np.array([0.0, tilt, push]))
        with contextlib.suppress(OSError):  # the client has given up
            self._socket.sendto(json.dumps(answer).encode(), address)

    def _spoil(self) -> None:
        faults, plant = self._faults, self._plant
        self._sensor_errors.spoil(plant.gap_m)
        race_m_s = float(faults.get("race", 0.0))
        self._raced_m += race_m_s * self._period_s
        plant.beam[0] += float(faults.get("shift", 0.0)) + self._raced_m
        plant.beam[1] += race_m_s
        if "nan-coil" in faults:
            plant.coil_readback_n[int(faults["nan-coil"])] = math.nan
        if "nan-axis" in faults:
            axis = plant.rotor if faults["nan-axis"] == "phi" else plant.beam
            axis[0] = math.nan
        for name in faults.keys() & REPORTED.keys():
            raise REPORTED[name](f"{name} {faults[name]} (injected)")


class LoopbackClient:
    """Sends lines to the backend in the loop, which may be dead, stopped or starting."""

    def __init__(self, folder: Path) -> None:
        self._backend = _backend_socket(folder)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(folder / "plant_client.sock"))
        self._number = 0
        self._pid: int | None = None
        self._periods = self._earlier_periods = 0

    def say(self, line: str) -> dict[str, Any] | None:
        """Send a line; return the state before it, with periods counted over all loops.

        None if no cycle begins within a second.
        """
        self._number += 1
        give_up_s = time.monotonic() + _ANSWER_S
        try:
            self._socket.sendto(json.dumps([self._number, line]).encode(), str(self._backend))
            while (left_s := give_up_s - time.monotonic()) > 0.0:
                self._socket.settimeout(left_s)
                answer: dict[str, Any] = json.loads(self._socket.recv(_MOST_BYTES))
                if answer["number"] == self._number:  # else late, of a loop that was stopped
                    return self._counted(answer)
        except OSError:
            pass
        return None

    @property
    def forced_periods(self) -> int:
        """Periods with force as last answered, over all loops."""
        return self._earlier_periods + self._periods

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _counted(self, answer: dict[str, Any]) -> dict[str, Any]:
        if answer["pid"] != self._pid:
            self._earlier_periods, self._pid = self.forced_periods, answer["pid"]
        self._periods = answer["forced_periods"]
        return {**answer, "forced_periods": self.forced_periods}


def install_backend(folder: Path) -> dict[str, str]:
    """Register the backend for processes that get the returned environment."""
    info = folder / f"{BACKEND}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {BACKEND}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        f"[levid.backends]\n{BACKEND} = {__name__}:{FaultInjectingLoopback.__name__}\n"
    )
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path}


def _backend_socket(folder: Path) -> Path:
    return folder / "plant.sock"
