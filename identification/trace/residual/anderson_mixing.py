"""Speed up a fixed-point iteration by extrapolation from its last steps (Anderson 1965)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class AndersonMixing:
    """Find x = g(x) where x = g(x) alone would oscillate or take many steps.

    The next x is the g of that combination of the last `kept` x whose residual g(x) - x is least,
    as if g were linear: for a linear g this is GMRES (Walker and Ni, *Anderson acceleration for
    fixed-point iterations*, SIAM J. Numer. Anal. 49, 2011). If a residual grows, the older steps
    are forgotten.
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
