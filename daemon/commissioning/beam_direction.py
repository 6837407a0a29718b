"""Find whether the beam moves to where its drives say, from the tilt of the resting platform.

A beam that moves to positive x weighs on the stops of that side. How much the platform tilts
follows from the weight in the declared model and from the compliance of the stops, which the coils
have shown. A negative ratio of measured and expected tilt is a beam that goes the other way; its
size is the product of two scales, of the encoder and of the coils, over the declared weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LEAST_SIGMA = 8.0


@dataclass(frozen=True)
class BeamDirection:
    """Measured over expected tilt, and its standard deviation; sure if it is far from noise."""

    ratio: float
    sd: float

    @property
    def sure(self) -> bool:
        """Whether the tilt stands out of its noise."""
        return abs(self.ratio) > _LEAST_SIGMA * self.sd

    @property
    def reversed(self) -> bool:
        """Whether the beam surely moves the wrong way."""
        return self.sure and self.ratio < 0.0


def tilt_compliance(theta_per_n: Array, gain: Array, x_m: Array) -> float:
    """Return theta in rad per N m of torque on the stops, from coils (C,) at x_m with gains."""
    arm = gain * x_m
    return float(arm @ theta_per_n / (arm @ arm))


def beam_direction(tilts_rad: Array, torque_n_m: float, compliance: float) -> BeamDirection:
    """Return the direction of the beam from tilts (n,), each after a move minus that before it.

    Moves go forth and back, forth first. torque_n_m: torque that balances the weight after a move
    forth, by the declared model; the platform tilts the other way without it. compliance: of the
    stops, in rad per N m.
    """
    forth = tilts_rad * np.where(np.arange(len(tilts_rad)) % 2 == 0, 1.0, -1.0)
    expected = -torque_n_m * compliance
    sd = forth.std(ddof=1) / np.sqrt(len(forth))
    return BeamDirection(float(forth.mean() / expected), float(sd / abs(expected)))
