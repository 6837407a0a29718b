"""What records cannot tell: parameters, or combinations of them, that no prediction depends on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SINGULAR = 1e-8
"""Central differences leave this much of an exactly singular direction."""
_TAKES_PART = 0.02


@dataclass(frozen=True)
class Unidentifiable:
    """A parameter that the records say nothing of, and those it cannot be told apart from.

    `standard_error`: what it would have if it were fitted, SI; infinite where exactly singular.
    """

    name: str
    together_with: tuple[str, ...]
    standard_error: float

    def __str__(self) -> str:
        """Say it in a sentence."""
        partners = f" from {', '.join(self.together_with)}" if self.together_with else ""
        return f"{self.name} cannot be told{partners} by these records; held as declared"


def judge(R: Array, names: Sequence[str], worth: Array, scale: Array) -> list[Unidentifiable]:
    """Return the parameters to hold, from R (F, F) of the Jacobian by parameters over scale.

    A parameter is worth fitting while its standard error stays below `worth` (F,), SI. The
    direction that the records know least about, parameters counted in units of their worth, is
    found by SVD; its largest part is held, and so on until every direction is known well enough.
    """
    by_worth = R * (worth / scale)
    left = list(range(len(names)))
    found: list[Unidentifiable] = []
    while left:
        _, s, Vt = np.linalg.svd(by_worth[:, left])
        weakest, direction = s[-1], np.abs(Vt[-1])
        exact = bool(weakest <= _SINGULAR * s[0])
        if not exact and weakest > 1.0:
            break
        worst = int(np.argmax(direction))
        partners = [
            names[left[i]]
            for i in np.argsort(-direction)
            if i != worst and direction[i] > _TAKES_PART * direction[worst]
        ]
        error = np.inf if exact else float(direction[worst] / weakest * worth[left[worst]])
        found.append(Unidentifiable(names[left[worst]], tuple(partners), error))
        del left[worst]
    return found
