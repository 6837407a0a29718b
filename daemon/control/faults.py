"""The table of faults: number in the log, name, cause in words, what to check."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Fault(IntEnum):
    """What stopped the flight; the number is the log's field `fault`."""

    NONE = 0
    READING = 1
    GAP = 2
    COMPUTATION = 3
    BEAM = 4
    DRIVER = 5
    LATE = 6
    SIMULATION = 7
    STALE = 8
    LINK = 9
    AMPLIFIER = 10
    SENSOR = 11
    DRIVE = 12
    STOPPED = 13
    SUPERVISOR = 14
    LOOP = 15
    SELF_TEST = 16
    SEQUENCE = 17
    POSE = 18
    VELOCITY = 19
    HEAT = 20
    COIL_CHECK = 21


@dataclass(frozen=True)
class FaultText:
    """A fault for people: its cause, what to check, and what makes it go away."""

    cause: str
    check: str
    cleared: str = "levid clear"


FAULTS: dict[Fault, FaultText] = {
    Fault.NONE: FaultText("no fault", "", ""),
    Fault.READING: FaultText(
        "a sensor, amplifier or drive gave a reading that is no number",
        "the sensor's cable and supply, the ADC",
    ),
    Fault.GAP: FaultText(
        "the platform left the range it may fly in (limits.gap_m)",
        "excitation level, gains, a stuck sensor, something lying on the platform",
    ),
    Fault.COMPUTATION: FaultText(
        "the control law gave a force that is no number",
        "gains and references; this should not happen with finite readings",
    ),
    Fault.BEAM: FaultText(
        "the beam is outside its range (limits.beam_m)",
        "homing of the linear motors, the drives' own position loops",
    ),
    Fault.DRIVER: FaultText(
        "a device or bus failed",
        "cables, supply and bus of the device that the message names",
    ),
    Fault.STALE: FaultText(
        "readings did not come in time, or not as they should, in too many cycles in a row",
        "load and errors of the bus that the message names, its budget (levid check)",
    ),
    Fault.LINK: FaultText(
        "a bus or port is gone, or nobody answers on it",
        "plug, adapter and supply",
        "levid clear, which opens it again",
    ),
    Fault.AMPLIFIER: FaultText(
        "the coil amplifiers tripped, or switched off while force was asked of them",
        "the coil that the message names, its current and temperature; late cycles",
        "levid clear, which resets the trip once its cause is gone",
    ),
    Fault.SENSOR: FaultText(
        "a sensor channel has no reading, is stuck, or is at the end of its range",
        "the sensor that the message names, its cable and the ADC",
    ),
    Fault.DRIVE: FaultText(
        "a drive of the manipulator does not follow",
        "encoder and motor that the message names, the gantry's skew",
        "levid clear, which homes the drives (on CAN) and enables them",
    ),
    Fault.SIMULATION: FaultText(
        "the simulated plant or one of its effects failed",
        "SIM.yaml and the effect that the message names",
    ),
    Fault.LATE: FaultText(
        "too many cycles were late by a period or more: in a row, within a minute, or all at once "
        "(limits.late_cycles, late_in_window, stall_s)",
        "load of the machine, priority of the loop, a rate that the bus cannot carry",
    ),
    Fault.STOPPED: FaultText(
        "somebody stopped it (levid stop)",
        "why; whoever stopped it knows",
    ),
    Fault.SUPERVISOR: FaultText(
        "the supervisor died, hung, was stopped or left the loop without its plan (supervisor_s)",
        "load and memory of the machine, the journal",
        "levid clear; a dead supervisor takes the loop along, and is started anew",
    ),
    Fault.LOOP: FaultText(
        "the loop's process died, hung or was stopped; the devices went to zero by themselves",
        "the journal, a driver that blocks, the machine's memory",
        "levid clear, which starts the loop anew",
    ),
    Fault.SELF_TEST: FaultText(
        "a channel did not answer, or its reading was not plausible, before lift-off",
        "the channel that the message names; what lies on the platform",
    ),
    Fault.SEQUENCE: FaultText(
        "a state was to follow that may not follow this one",
        "this should not happen: report it, with the flight recording",
    ),
    Fault.POSE: FaultText(
        "the platform tilted further than it may (limits.tilt_rad)",
        "excitation level, gains, something lying on the platform",
    ),
    Fault.VELOCITY: FaultText(
        "platform or beam moved faster than they may (limits.gap_m_s, beam_velocity_m_s)",
        "gains, a loose sensor, the drives' own loops",
    ),
    Fault.HEAT: FaultText(
        "a coil carried more than it may in the long run (limits.coil_rms_n)",
        "what the platform carries and where; excitation level",
        "levid clear, after the coils have cooled down",
    ),
    Fault.COIL_CHECK: FaultText(
        "a coil did not move the sensors that it should, just after lift-off",
        "cables of the coil that the message names: swapped, reversed or open",
    ),
}


class FlightFault(Exception):  # noqa: N818 - it is a fault, in the field's words
    """A flight that ended in a fault; forces are zero."""

    def __init__(self, fault: Fault, time_s: float, step: str, detail: str = "") -> None:
        self.fault, self.time_s, self.step, self.detail = fault, time_s, step, detail
        text = FAULTS[fault]
        what = f"{text.cause}{f' ({detail})' if detail else ''}"
        super().__init__(
            f"fault {fault.name} at {time_s:.3f} s in step '{step}': {what}; check: {text.check}"
        )
