"""Convert between poses and heights of points, and between point forces and generalised forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .base import Array, Signals
from .lag_and_hysteresis_recursions import with_moment

Law = Callable[[Array], Array]


def heights(q: Array, shape: Array) -> Array:
    """Return heights (N, C) of points of shape (C, n) at poses q (N, n).

    einsum is faster here than a threaded matrix product, because the matrices are thin.
    """
    return np.asarray(np.einsum("ni,ci->nc", q, shape))


def forces(at_points: Array, shape: Array) -> Array:
    """Return the generalised force (N, n) of forces (N, C) at points of shape (C, n)."""
    return np.asarray(np.einsum("nc,ci->ni", at_points, shape))


def times_height(signals: Signals, coils: Sequence[int], F: Array, law: Law) -> Array:
    """Return commands F (N, C) times a law of the coils' heights while they act (..., N, C).

    They are held commands that move a mass as the product does. It is lagged as a whole, so the
    height must lead by the lag.
    """
    ahead, rates = (
        heights(now + signals.lag_s * rate, signals.places.actuator_motion[list(coils)])
        for now, rate in ((signals.q, signals.qd), (signals.qd, signals.qdd))
    )
    mean, moment = signals.while_acting(ahead, rates, law)
    return with_moment(F * mean, F * moment)


def times_speed(signals: Signals, coils: Sequence[int], F: Array, law: Law) -> Array:
    """Return the same of a law of the coils' speeds."""
    shape = signals.places.actuator_motion[list(coils)]
    ahead = heights(signals.qd + signals.lag_s * signals.qdd, shape)
    mean, moment = signals.while_acting(ahead, heights(signals.qdd, shape), law)
    return with_moment(F * mean, F * moment)
