"""A straight line through samples: what grows, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy.stats import t


class Trend(NamedTuple):
    """Slope of y over x and its standard error, of n samples that scatter independently."""

    slope: float
    error: float
    n: int

    @property
    def most(self) -> float:
        """The slope's upper 95 % bound, one-sided."""
        return self.slope + float(t.ppf(0.95, self.n - 2)) * self.error


def trend(x: Sequence[float], y: Sequence[float]) -> Trend | None:
    """Return the trend by least squares, None of fewer than three samples."""
    n = len(x)
    if n < 3:
        return None
    off = np.asarray(x, float) - np.mean(x)
    square = float(off @ off)
    slope = float(off @ np.asarray(y, float)) / square
    left = np.asarray(y, float) - np.mean(y) - slope * off
    return Trend(slope, sqrt(float(left @ left) / (n - 2) / square), n)
