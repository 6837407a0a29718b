"""Find unidentifiable parameters: combinations that the prediction errors do not depend on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SINGULAR = 1e-8
"""Relative singular value of an exactly singular direction, left by central differences."""
_MIN_PART = 0.02


@dataclass(frozen=True)
class Unidentifiable:
    """A parameter that the records do not determine, and those it is confounded with.

    `standard_error`: its value if the parameter were fitted, in SI units; infinite if exactly
    singular.
    """

    name: str
    together_with: tuple[str, ...]
    standard_error: float

    def __str__(self) -> str:
        """Return a sentence for the report."""
        partners = f" apart from {', '.join(self.together_with)}" if self.together_with else ""
        return f"{self.name} cannot be identified{partners} from these records; held as declared"


def find_unidentifiable(
    R: Array, names: Sequence[str], worth: Array, scale: Array
) -> list[Unidentifiable]:
    """Return the parameters to hold, from R (F, F) of the Jacobian by parameters over scale.

    A parameter is fitted if its standard error is below `worth` (F,), in SI units. The SVD finds
    the least determined direction, with parameters in units of their worth; the largest parameter
    in it is held. This repeats until all remaining directions are determined.
    """
    by_worth = R * (worth / scale)
    remaining = list(range(len(names)))
    found: list[Unidentifiable] = []
    while remaining:
        _, s, Vt = np.linalg.svd(by_worth[:, remaining])
        weakest, direction = s[-1], np.abs(Vt[-1])
        exact = bool(weakest <= _SINGULAR * s[0])
        if not exact and weakest > 1.0:
            break
        worst = int(np.argmax(direction))
        partners = [
            names[remaining[i]]
            for i in np.argsort(-direction)
            if i != worst and direction[i] > _MIN_PART * direction[worst]
        ]
        error = np.inf if exact else float(direction[worst] / weakest * worth[remaining[worst]])
        found.append(Unidentifiable(names[remaining[worst]], tuple(partners), error))
        del remaining[worst]
    return found
