"""Prepare the first cycle: compile the control cycle, read the manipulator position."""

from __future__ import annotations

from contextlib import suppress
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...drivers.base import Devices, DriveError, StaleError
from ..control.control_cycle import BEAM_MARGIN_M, Controller
from ..control.flight_segment import Segment, idle_segment


def warm_up(
    controller: Controller,
    devices: Devices,
    row: NDArray[np.void],
    rig: RigConfig,
    cycle: int = 0,
) -> None:
    """Compile the cycle with dummy readings, writing row (1,), and `locate` the manipulator.

    `cycle` is the number of the cycle before the first. Raises DriverError.
    """
    controller.begin(resting_segment(controller, 1))
    controller.step(row, 0, cycle, 0.0, 0)
    controller.halt()
    locate(controller, devices, rig, cycle)


def locate(
    controller: Controller,
    devices: Devices,
    rig: RigConfig,
    cycle: int,
    timeout_s: float = 1.0,
) -> None:
    """Read the manipulator position in this cycle and set it as setpoint, to hold it there.

    From then on the controller checks that coils and drives follow their commands. A lost or late
    answer is requested again. Raises DriveError if no position comes within `timeout_s` or the beam
    is out of range; then the setpoints stay unchanged.
    """
    beam, rotor = controller.beam, controller.rotor
    deadline_s = perf_counter() + timeout_s
    while True:
        for sync in devices.syncs:
            sync(cycle)
        with suppress(StaleError):
            devices.drives.read(beam, rotor)
        if np.isfinite(beam[0]) and np.isfinite(rotor[0]):
            break
        if perf_counter() > deadline_s:
            raise DriveError(f"the drives reported no position within {timeout_s:g} s")
    reach = rig.limits.beam_m + BEAM_MARGIN_M
    if not abs(beam[0]) <= reach:
        raise DriveError(
            f"the beam is at {beam[0]:.4g} m, expected within {reach:g} m of its centre: move it"
        )
    controller.beam_ref[:] = beam[0], 0.0, 0.0
    controller.rotor_ref[:] = rotor[0], 0.0, 0.0
    controller.follow(devices.reads_back)


def resting_segment(controller: Controller, cycles: int) -> Segment:
    """Return a segment of zero force with the manipulator at its last setpoints."""
    beam_m, rotor_rad = controller.beam_ref[0], controller.rotor_ref[0]
    return idle_segment(
        cycles,
        len(controller.coil_n),
        np.array([beam_m, 0.0, 0.0]),
        np.array([rotor_rad, 0.0, 0.0]),
    )
