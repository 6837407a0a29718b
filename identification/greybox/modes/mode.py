"""Describe a mode that the declared model does not have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

Kind = Literal["bending", "attached", "beyond"]


@dataclass(frozen=True)
class Mode:
    """A resonance of `omega` rad/s and damping ratio `damping` beside the declared model.

    kind "bending": the structure bends, and the sensors see it. P gets strength / d(s), with
    d(s) = s^2 + 2 zeta omega s + omega^2 and `strength` (n, p), an inverse modal mass: for coils
    and sensors at the same places a a^T / m, with the shape a seen through T.
    kind "attached": a body moves on the structure (a beam in its bearing). Its whole mass counts
    as rigid in M, and the dynamic stiffness gets - s^4 strength / d(s); `strength` (n, n) is
    symmetric, g g^T m for a body of mass m that the motion g^T q carries along.
    kind "beyond": the static compliance strength / omega^2 of all modes above the band.
    """

    kind: Kind
    omega: float
    damping: float
    strength: Array

    @property
    def freq_hz(self) -> float:
        """Natural frequency in Hz."""
        return self.omega / (2.0 * np.pi)

    def denominator(self, s: Complex) -> Complex:
        """Return d(s); for modes beyond the band the constant omega^2."""
        if self.kind == "beyond":
            return np.full(len(s), self.omega**2, complex)
        return s * s + 2.0 * self.damping * self.omega * s + self.omega**2

    def entries(self) -> list[tuple[int, int]]:
        """Return the rows and columns of `strength` that are parameters."""
        rows, columns = self.strength.shape
        symmetric = self.kind == "attached"
        return [(i, j) for i in range(rows) for j in range(i if symmetric else 0, columns)]
