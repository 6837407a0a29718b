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


@dataclass(frozen=True)
class FaultText:
    """A fault for people."""

    cause: str
    check: str


FAULTS: dict[Fault, FaultText] = {
    Fault.NONE: FaultText("no fault", ""),
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
    Fault.SIMULATION: FaultText(
        "the simulated plant or one of its effects failed",
        "SIM.yaml and the effect that the message names",
    ),
    Fault.LATE: FaultText(
        "too many cycles in a row were late by a period or more",
        "load of the machine, priority of the loop, a rate that the bus cannot carry",
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
