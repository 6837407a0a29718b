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


def taken_beyond_noise(
    before: ForceModel, after: ForceModel, training: Training, options: SearchOptions
) -> NDArray[np.bool_]:
    """Return whether what a fitted model takes of another one's squared missing force, of each DOF
    (n,), is more than what it takes of the noise of the outputs there.

    In units of that noise it takes `least_gain` of what it takes in forces, at least.
    """
    squares, noise = [], []
    for point in (before, after):
        at = training.at(point)
        squares.append(np.sum([np.sum(m * m, axis=0) for m in at.missing], axis=0))
        noise.append(training.noise(point) * at.share**2)
    left = squares[1] / np.maximum(squares[0], TINY)
    left_of_noise = noise[1] / np.maximum(noise[0], TINY)
    relative = left / np.maximum(left_of_noise, TINY)
    return np.asarray(1.0 - relative > options.least_gain * (1.0 - left))
