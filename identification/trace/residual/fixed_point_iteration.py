"""Choose the next x of a fixed-point iteration x = g(x): a damped step, or Anderson mixing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..search_options import SearchOptions

Array = NDArray[np.float64]

_OSCILLATION_RATIO = 0.5**0.5
_MIN_STEP = SearchOptions.least_gain
_LAST = SearchOptions.resolved
"""Steps that tell at which rate an iteration converges."""


def settles(changes: Sequence[float], steps: int, within: float) -> bool:
    """Return whether so many more steps like the last ones bring the change below `within`.

    changes: of all steps before; a few steps tell nothing yet.
    """
    if len(changes) <= _LAST:
        return True
    per_step = (changes[-1] / changes[-1 - _LAST]) ** (1.0 / _LAST)
    return bool(per_step < 1.0 and changes[-1] * per_step**steps < within)


class DampedSteps:
    """Take g(x), and half of the way to it once the residual no longer falls."""

    def __init__(self) -> None:
        self._last, self._share = np.inf, 1.0

    def next(
        self, at: Sequence[Array], image: Sequence[Array], residual: Array
    ) -> tuple[Array, ...]:
        """Return the next x from an x, its g(x), and their scaled difference."""
        change = float(np.sqrt(np.mean(residual**2)))
        if change > _OSCILLATION_RATIO * self._last:
            self._share = max(0.5 * self._share, _MIN_STEP)
        self._last = change
        return tuple(a + self._share * (i - a) for a, i in zip(at, image, strict=True))


class AndersonMixing:
    """Find x = g(x) where x = g(x) alone would oscillate or take many steps.

    The next x is the g of that combination of the last `kept` x whose residual g(x) - x is least,
    as if g were linear: for a linear g this is GMRES (Walker and Ni, *Anderson acceleration for
    fixed-point iterations*, SIAM J. Numer. Anal. 49, 2011).
    """

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self._steps: list[tuple[tuple[Array, ...], tuple[Array, ...], Array]] = []

    def next(
        self, at: Sequence[Array], image: Sequence[Array], residual: Array
    ) -> tuple[Array, ...]:
        """Return the next x from an x, its g(x), and their scaled difference."""
        self._steps = [*self._steps, (tuple(at), tuple(image), residual.ravel())][-self._kept - 1 :]
        *earlier, (_, own, r) = self._steps
        if not earlier or not all(np.all(np.isfinite(v)) for v in own):
            return own
        weights = np.linalg.lstsq(np.stack([r - e for _, _, e in earlier], 1), r, rcond=None)[0]
        mixed = list(own)
        for weight, (_, theirs, _) in zip(weights, earlier, strict=True):
            mixed = [m + weight * (t - o) for m, t, o in zip(mixed, theirs, own, strict=True)]
        return tuple(mixed)
