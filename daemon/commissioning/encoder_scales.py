"""Compare what the encoders of beam and rotor say with what the operator measures."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Literal

from .device_session import DeviceSession

Axis = Literal["beam", "rotor"]
Measure = Callable[[Axis, float], "Future[float | None]"]
"""Function that asks how far an axis has moved, which should be by the number (m or rad); what it
returns is done as soon as the operator has answered, with None for not measured."""

_OFF = 0.05
"""Relative error that a ruler or a protractor tells from none over 20 mm or 30 degrees."""
_ANSWER_S = 600.0
_LOOK_S = 0.1


@dataclass(frozen=True)
class EncoderScale:
    """Way that was measured over that which the encoder says; None if nobody measured it."""

    axis: Axis
    scale: float | None

    @property
    def problem(self) -> str | None:
        """What has to be repaired, if anything."""
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
