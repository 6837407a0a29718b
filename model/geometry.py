"""Geometry of coils and sensors: forces to wrench, gaps to pose (eq. 9, corrected)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


class GeometryError(ValueError):
    """Points do not determine three degrees of freedom."""


def shape_matrix(x_m: Sequence[float], y_m: Sequence[float]) -> NDArray[np.float64]:
    """Return S (n, 3) of n points: heights of a rigid platform are S q, the wrench is S^T F.

    q = [psi, theta, z] in rad, rad, m; row i is [y_i, x_i, 1], since the height of (x, y) is
    z + y psi + x theta (theta is positive about -y). The wrench is [sum y F, sum x F, sum F] in
    N m, N m, N.
    """
    x, y = np.asarray(x_m, float), np.asarray(y_m, float)
    return np.stack([y, x, np.ones_like(x)], axis=1)


def decoupling_matrix(x_m: Sequence[float], y_m: Sequence[float]) -> NDArray[np.float64]:
    """Return T (3, n), the least-squares inverse of the geometry: q = T gaps, F = T^T tau.

    For the paper's 3 x 3 grid it is eq. (9) with 1/9 in the third row; the printed 1/6 there makes
    the height and the summed force 1.5 times too large.

    Raises:
        GeometryError: fewer than three points, or all of them on one line.
    """
    S = shape_matrix(x_m, y_m)
    # Tilts are in rad and heights in m: normalise the columns before the rank test.
    scaled = S / np.maximum(np.linalg.norm(S, axis=0), np.finfo(float).tiny)
    if len(S) < 3 or np.linalg.matrix_rank(scaled, tol=1e-6) < 3:
        raise GeometryError(
            f"expected at least three points that are not on one line, found {len(S)} at "
            f"x = {list(map(float, x_m))}, y = {list(map(float, y_m))} m"
        )
    return np.asarray(np.linalg.pinv(S), np.float64)
