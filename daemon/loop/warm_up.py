"""Everything that a first cycle would pay for, paid before it: compiling, and where things are."""

from __future__ import annotations

from contextlib import suppress
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...drivers.base import Devices, DriveError, StaleError
from ..control.control_cycle import BEAM_MARGIN_M, Controller
from ..control.segment import Segment, idle_segment

_PATIENCE_S = 1.0


def warm_up(
    controller: Controller,
    devices: Devices,
    row: NDArray[np.void],
    rig: RigConfig,
    cycle: int = 0,
) -> None:
    """Compile the cycle on made-up readings, writing row (1,), and `locate` the manipulator.

    `cycle` is the one before the first.
    """
    controller.begin(resting_segment(controller, 1))
    controller.step(row, 0, cycle, 0.0, 0)
    controller.halt()
    locate(controller, devices, rig, cycle)


def locate(controller: Controller, devices: Devices, rig: RigConfig, cycle: int) -> None:
    """Read where the manipulator is, in this cycle, and hold it there from now on.

    An answer may be lost, or come too late: it is asked again. Raises DriverError: nothing came, or
    the beam is where it may not be. It is held where it is, and told to go nowhere.
    """
    beam, rotor = controller.beam, controller.rotor
    give_up_s = perf_counter() + _PATIENCE_S
    while True:
        for sync in devices.syncs:
            sync(cycle)
        with suppress(StaleError):
            devices.drives.read(beam, rotor)
        if np.isfinite(beam[0]) and np.isfinite(rotor[0]):
            break
        if perf_counter() > give_up_s:
            raise DriveError(f"the manipulator's position did not come within {_PATIENCE_S:g} s")
    reach = rig.limits.beam_m + BEAM_MARGIN_M
    if not abs(beam[0]) <= reach:
        raise DriveError(
            f"the beam is at {beam[0]:.4g} m, expected within {reach:g} m of its middle"
        )
    controller.beam_ref[:] = beam[0], 0.0, 0.0
    controller.rotor_ref[:] = rotor[0], 0.0, 0.0


def resting_segment(controller: Controller, cycles: int) -> Segment:
    """Return zero force, the manipulator at rest where it was last told to be."""
    beam_m, rotor_rad = controller.beam_ref[0], controller.rotor_ref[0]
    return idle_segment(
        cycles,
        len(controller.coil_n),
        np.array([beam_m, 0.0, 0.0]),
        np.array([rotor_rad, 0.0, 0.0]),
    )
