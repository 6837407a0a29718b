"""Convert between poses and heights of points, and between point forces and generalised forces."""

from __future__ import annotations

import numpy as np

from .base import Array


def heights(q: Array, shape: Array) -> Array:
    """Return heights (N, C) of points of shape (C, n) at poses q (N, n).

    einsum is faster here than a threaded matrix product, because the matrices are thin.
    """
    return np.asarray(np.einsum("ni,ci->nc", q, shape))


def forces(at_points: Array, shape: Array) -> Array:
    """Return the generalised force (N, n) of forces (N, C) at points of shape (C, n)."""
    return np.asarray(np.einsum("nc,ci->ni", at_points, shape))
