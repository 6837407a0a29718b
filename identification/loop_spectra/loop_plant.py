"""Say what the spectra of a loop need to know of a plant."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .spectral_lines import PointLines

Complex = NDArray[np.complex128]


class LoopPlant(Protocol):
    """A linear plant P from the command u to the outputs y, sampled."""

    def response(self, point: PointLines) -> Complex:
        """Return P (F, n, p) at the point's lines, the input held, with all delays."""
        ...

    def compliance(self, point: PointLines) -> Complex:
        """Return the response (F, n, p) to a force that acts at once and is not held."""
        ...

    def free_motions(self, point: PointLines) -> Complex:
        """Return columns (F, n, T) of which Y - P U holds an unknown real combination.

        The DFT of a finite record of a linear plant is Y = P U + C (z I - A)^-1 z (x_0 - x_N): a
        free motion of the plant from the difference of its state at begin and end (Pintelon and
        Schoukens 2012, 6.3.2).
        """
        ...
