"""Table of faults: log number, name, cause, what to check, how to clear."""

from __future__ import annotations

from dataclasses import dataclass

from ...log.cycle_codes import Fault

__all__ = ["FAULTS", "Fault", "FaultText", "FlightFault"]


@dataclass(frozen=True)
class FaultText:
    """Describe a fault to the user: cause, what to check, how to clear it."""

    cause: str
    check: str
    cleared: str = "levid clear"


FAULTS: dict[Fault, FaultText] = {
    Fault.NONE: FaultText("no fault", "", ""),
    Fault.READING: FaultText(
        "a sensor, amplifier or drive reading is not a finite number",
        "cable and supply of the sensor, the ADC",
    ),
    Fault.GAP: FaultText(
        "the gap at a sensor exceeded its limit (limits.gap_m)",
        "excitation level, gains, a stuck sensor, an object on the platform",
    ),
    Fault.COMPUTATION: FaultText(
        "the control law computed a force that is not a finite number",
        "gains and references; if they are correct, report this software defect",
    ),
    Fault.BEAM: FaultText(
        "the beam left its range (limits.beam_m)",
        "homing of the linear motors, position loops of the drives",
    ),
    Fault.DRIVER: FaultText(
        "a device or bus failed",
        "cables, supply and bus of the device in the message",
    ),
    Fault.STALE: FaultText(
        "readings were missing, late or invalid in too many cycles in a row",
        "load and error counters of the bus in the message, its time budget (levid check)",
    ),
    Fault.LINK: FaultText(
        "a bus or port is disconnected, or no device on it responds",
        "plug, adapter and supply",
        "levid clear, which reopens it",
    ),
    Fault.AMPLIFIER: FaultText(
        "the coil amplifiers tripped, switched off while a force was commanded, or drive another "
        "force than commanded (limits.coil_follow_n)",
        "the coil in the message: its cable, current and temperature; if it keeps a force at zero "
        "command, switch off its supply; late cycles",
        "levid clear, which resets the trip once its cause is removed",
    ),
    Fault.SENSOR: FaultText(
        "a sensor has no reading, repeats its reading, is off the plane of the others "
        "(limits.plane_m), jumps alone, or is at the end of its range",
        "the sensor in the message, its fastening and cable; the ADC if several repeat",
    ),
    Fault.DRIVE: FaultText(
        "a manipulator drive failed, or does not follow its setpoints (limits.beam_follow_m, "
        "rotor_follow_rad)",
        "the drive in the message: encoder, motor, what blocks it; gantry skew",
        "levid clear, which homes the drives (on CAN) and enables them",
    ),
    Fault.SIMULATION: FaultText(
        "the simulated plant or one of its effects failed",
        "SIM.yaml and the effect in the message",
    ),
    Fault.LATE: FaultText(
        "too many cycles were late by a period or more: in a row, within limits.late_window_s, or "
        "in one stall (limits.late_cycles, late_in_window, stall_s)",
        "machine load, loop priority, a cycle rate that the bus cannot carry",
    ),
    Fault.STOPPED: FaultText(
        "a user stopped the rig (levid stop)",
        "the reason, with the user who stopped it",
    ),
    Fault.SUPERVISOR: FaultText(
        "the supervisor died, hung, was stopped, or did not send the plan in time "
        "(service.supervisor_s)",
        "machine load and memory, the journal",
        "levid clear; if the supervisor died, restart the daemon (systemd does so)",
    ),
    Fault.LOOP: FaultText(
        "the loop process died, hung or was stopped; the devices switched to zero force",
        "the journal, a driver that blocks, machine memory",
        "levid clear, which restarts the loop",
    ),
    Fault.SELF_TEST: FaultText(
        "a channel did not respond before lift-off, or its reading was implausible",
        "the channel in the message; objects on the platform",
    ),
    Fault.SEQUENCE: FaultText(
        "the loop rejected a state transition that is not allowed",
        "nothing on the rig: report this software defect with the flight recording",
    ),
    Fault.POSE: FaultText(
        "the platform tilt exceeded its limit (limits.tilt_rad)",
        "excitation level, gains, an object on the platform",
    ),
    Fault.VELOCITY: FaultText(
        "the platform or beam velocity exceeded its limit (limits.gap_m_s, beam_velocity_m_s)",
        "gains, a loose sensor, position loops of the drives",
    ),
    Fault.HEAT: FaultText(
        "the long-term RMS force of a coil exceeded its limit (limits.coil_rms_n)",
        "mass and position of the load on the platform; excitation level",
        "levid clear, after the coils have cooled down",
    ),
    Fault.COIL_CHECK: FaultText(
        "a coil did not move the platform as expected in the check after lift-off",
        "cables of the coil in the message: swapped, reversed or open",
    ),
    Fault.SOFTWARE: FaultText(
        "the daemon's software failed, not a device",
        "nothing on the rig: disk, memory and installation of the daemon; if they are in order, "
        "report this software defect with the message and the journal",
    ),
}


class FlightFault(Exception):  # noqa: N818 - "fault" is the field's term
    """Report that a flight ended in a fault; forces are zero."""

    def __init__(self, fault: Fault, time_s: float, step: str, detail: str = "") -> None:
        self.fault, self.time_s, self.step, self.detail = fault, time_s, step, detail
        text = FAULTS[fault]
        cause = f"{text.cause}{f' ({detail})' if detail else ''}"
        super().__init__(
            f"fault {fault.name} at {time_s:.3f} s in step '{step}': {cause}; check: {text.check}"
        )
