"""Tell an effect from one that only keeps the noise of an output out of an equation.

The noise of the outputs is part of the missing force, by what each output is multiplied with. A law
that gives a motion by that of another output may take the place of the terms that read it: a load
that is measured moves as one on a soft shaft that nobody measures. With less noise in it the
equation has smaller errors, in which nothing was missing but the noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...rounding import TINY
from ..search_options import SearchOptions
from .force_record import ForceModel
from .training_records import Training

Array = NDArray[np.float64]


_UNSURE = 2.0
"""Factor to which the power of the noise is known: it is measured as if it were white."""


def taken_beyond_noise(
    before: ForceModel, after: ForceModel, training: Training, options: SearchOptions
) -> NDArray[np.bool_]:
    """Return whether what a fitted model takes of another one's squared missing force, of each DOF
    (n,), is more than what it takes of the noise of the outputs there."""
    squares, noise = [], []
    for point in (before, after):
        at = training.at(point)
        squares.append(np.sum([np.sum(m * m, axis=0) for m in at.missing], axis=0))
        noise.append(training.noise(point) * at.share**2)
    return more_than_noise(np.array(squares), np.array(noise), options.least_gain)


def more_than_noise(squares: Array, noise: Array, least_gain: float) -> NDArray[np.bool_]:
    """Return whether what is taken of squares (2, n), before and after, is more than noise (n,).

    noise (2, n): the part of the noise. Either the squares fall by more than it may fall, or they
    fall in units of it, as they do not if all of them is noise, of whatever size. What other
    effects still lack does not fall with it. `least_gain` of what is taken must be beyond noise.
    """
    taken = squares[0] - squares[1]
    left = squares[1] / np.maximum(squares[0], TINY)
    relative = left / np.maximum(noise[1] / np.maximum(noise[0], TINY), TINY)
    by_size = taken - _UNSURE * (noise[0] - noise[1]) > least_gain * taken
    return np.asarray(by_size | (1.0 - relative > least_gain * (1.0 - left)))
