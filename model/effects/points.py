"""Heights and forces of single points of a platform, many rows at once."""

from __future__ import annotations

import numpy as np

from .base import Array


def heights(q: Array, shape: Array) -> Array:
    """Return heights (N, C) of points of shape (C, n) at poses q (N, n).

    Plain sums: threaded products of such thin matrices wait longer than they compute.
    """
    return np.asarray(np.einsum("ni,ci->nc", q, shape))


def forces(at_points: Array, shape: Array) -> Array:
    """Return the generalised force (N, n) of forces (N, C) at points of shape (C, n)."""
    return np.asarray(np.einsum("nc,ci->ni", at_points, shape))
