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
from ..force_balance.force_record import ForceModel
from ..search_options import SearchOptions
from .training_records import Training

Array = NDArray[np.float64]


def taken_beyond_noise(
    before: ForceModel, after: ForceModel, training: Training, options: SearchOptions
) -> NDArray[np.bool_]:
    """Return whether a fitted model takes more of the squared missing force that another one leaves
    than of the noise in it, for each DOF (n,)."""
    both = [training.at(point) for point in (before, after)]
    squares = np.array([at.squares for at in both])
    noise = np.array([training.noise(at.point) * at.share**2 for at in both])
    return more_than_noise(squares, noise, options)


def more_than_noise(squares: Array, noise: Array, options: SearchOptions) -> NDArray[np.bool_]:
    """Return whether squared forces (2, n), before and after, fall by more than their noise (n,).

    noise (2, n): the part of the squares that the noise of the outputs has. It is enough if what
    fell is beyond the noise that fell, even with as much noise as may be left where nothing is
    missing (`much_left`), or if the squares fell in units of the noise; both by `least_gain` of all
    that fell. The first does not depend on what another effect still lacks, the second not on how
    much noise there is.
    """
    fell = squares[0] - squares[1]
    noise_fell = options.much_left**2 * (noise[0] - noise[1])
    left = squares[1] / np.maximum(squares[0], TINY)
    left_in_noise = left / np.maximum(noise[1] / np.maximum(noise[0], TINY), TINY)
    absolute = fell - noise_fell > options.least_gain * fell
    relative = 1.0 - left_in_noise > options.least_gain * (1.0 - left)
    return np.asarray(absolute | relative)
