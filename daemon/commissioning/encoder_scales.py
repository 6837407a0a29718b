"""Compare the encoders of beam and rotor with motions that the operator measures by hand."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Literal

from .device_session import DeviceSession

Axis = Literal["beam", "rotor"]
Measure = Callable[[Axis, float], "Future[float | None]"]
"""Function that asks how far an axis has moved; it gets the axis and the commanded motion in m or
rad. Its future ends with the answer of the operator in the same unit, None for not measured."""

_OFF = 0.05
"""Smallest relative error that a ruler or a protractor detects over 20 mm or 30 degrees."""
_ANSWER_S = 600.0
_LOOK_S = 0.1


@dataclass(frozen=True)
class EncoderScale:
    """Measured motion over the motion that the encoder reports; None if it was not measured."""

    axis: Axis
    scale: float | None

    @property
    def problem(self) -> str | None:
        """Error of the drives that must be repaired; None if there is none."""
        if self.scale is None or abs(self.scale - 1.0) <= _OFF:
            return None
        if self.scale < 0.0:
            return f"the {self.axis} moves the wrong way: reverse the direction of its drives"
        return (
            f"the {self.axis} moves {self.scale:.3g} times as far as its encoder says: correct the "
            "scale in its drives"
        )


def encoder_scale(
    session: DeviceSession, axis: Axis, by: float, measure: Measure, rate_hz: float
) -> EncoderScale:
    """Move an axis, wait for what the operator measures, and move back; raises DriverError."""
    move, begin = (
        (session.move_beam, session.beam_m)
        if axis == "beam"
        else (session.move_rotor, session.rotor_rad)
    )
    way = by if begin <= 0.0 else -by  # inside its limits
    move(begin + way)
    answer = measure(axis, way)
    session.run(
        round(_ANSWER_S * rate_hz),
        ended=lambda _: answer.done(),
        every=max(round(_LOOK_S * rate_hz), 1),
    )
    found = answer.result() if answer.done() else None
    move(begin)
    return EncoderScale(axis, None if found is None else found / way)
