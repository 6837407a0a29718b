"""Use the drive force of the beam: regress it on the motion, and weight the residual.

The drives move the beam's mass on a platform that tilts and accelerates: forces proportional to
accelerations, speed and tilt are not effects and are projected out. So are a cable's pull, which
depends on the beam's position, and the force of an unbalanced rotor: both are external forces,
which the platform shows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from ....model.effects.rotor import pushes
from ...greybox.experiment.intersample_input import held_step, lagged_input
from ...rounding import TINY
from ..records.effect_signals import products
from ..search_options import SearchOptions
from .innovations_filter_bank import thinned
from .linearisation_point import Along

Array = NDArray[np.float64]

_SLOW = 0.5 / SearchOptions.resolved
"""Share of the band whose power tells how many values are independent."""


def drive_errors(here: Along) -> Array | None:
    """Return the drive force (N,) without the effects found so far; None if not measured."""
    drive, added = here.record.drive_n, here.added.drive
    return drive if drive is None or added is None else drive - added


def beside_motion(here: Along, drive: Array, every: int = 1) -> Array:
    """Return drive forces (N', ...) without their regression on beam and platform motion.

    Each row is the mean of `every` rows of the record.
    """
    if every not in here.bases:
        here.bases[every] = _basis(here, every)
    basis = here.bases[every]
    return np.asarray(drive - basis @ (basis.T @ drive))


def calm(drive: Array) -> NDArray[np.bool_]:
    """Return the rows (N,) without outliers, which are jerks of the beam's profile.

    There the acceleration between samples is unknown.
    """
    most = SearchOptions.chance(len(drive))
    return np.asarray(np.abs(drive) <= most * float(np.std(drive)))


def drive_channel(here: Along, columns: Array) -> Array | None:
    """Return force columns (N', c) in noise standard deviations; None without a measured force.

    The noise is unknown and replaced by the standard deviation of the residual, so only the shape
    of the residual counts, not its size.
    """
    raw = here.record.drive_n
    if raw is None:
        return None
    freed = beside_motion(here, np.column_stack([columns, thinned(raw, here.every)]), here.every)
    columns, rest = freed[:, :-1], freed[:, -1]
    quiet = calm(rest)
    sd = float(np.std(rest[quiet]))
    if sd <= 0.0:
        return None
    # The residual is coloured: its low frequencies determine the number of independent values.
    every_s = here.every * here.record.experiment.Ts_s
    segment = min(round(SearchOptions.block_s / every_s), len(rest))
    freq_hz, power = welch(np.where(quiet, rest, 0.0), 1 / every_s, nperseg=segment)
    slow = power[(freq_hz > 0) & (freq_hz < _SLOW * freq_hz[-1])]
    sd *= float(np.sqrt(max(slow.mean() / power[1:].mean(), 1.0)))
    return np.asarray(columns * quiet[:, None] / sd)


def _basis(here: Along, every: int) -> Array:
    """Return an orthonormal basis (N', .) of the forces that beam and platform motion need."""
    s = here.signals
    # Speed is included: its effect is that of a reading delayed by half a period.
    own = np.column_stack(
        [
            np.ones(s.rows), s.x_b_m, s.x_b_m**2, s.v_b_m_s, s.a_b_m_s2, *pushes(s), s.q,
            _accelerations(here),
        ]
    )  # fmt: skip
    size = np.maximum(np.abs(own).max(axis=0), TINY)
    return np.asarray(np.linalg.qr(thinned(own / size, every))[0])


def _accelerations(here: Along) -> Array:
    """Return the pose's accelerations (N, n) at the rows, from the model's forces.

    Twice differentiated readings would be too noisy for a friction of millinewtons.
    """
    e, at, s = here.record.experiment, here.at, here.signals
    step = held_step(e.Ts_s, 1, e.delay_cycles * e.Ts_s, s.lag_s)
    given = e.u if here.added.held is None else e.u + here.added.held
    acting = lagged_input(given, step) if s.lag_s > 0.0 else s.acting(given)
    pushed, moved = products(at.B, acting), products(at.K, s.q) + products(at.D, s.qd)
    own = np.broadcast_to(at.drift[:, 0] / e.Ts_s, s.q.shape)  # means over the following period
    now = 0.5 * (own + np.vstack([own[:1], own[:-1]]))
    if here.added.force is not None:
        now = now + products(at.mobility, here.added.force)
    return np.asarray(pushed - moved + now)
