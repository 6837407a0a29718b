"""Correct the significance of many tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def holm(p_values: Sequence[float]) -> NDArray[np.float64]:
    """Return p-values (n,) corrected for n tests, of any dependence.

    A test is significant at 5 % if its corrected value is below 0.05; with a probability of 95 %
    no test is then significant by chance. Source: Holm, Scand. J. Stat. 6, 1979.
    """
    p = np.asarray(p_values, np.float64)
    order = np.argsort(p)
    stepped = np.maximum.accumulate((len(p) - np.arange(len(p))) * p[order])
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected
