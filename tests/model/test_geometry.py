"""Test the geometry of the paper's grid: eq. (9) with its erratum."""

import numpy as np
import pytest

from levid.model.geometry import GeometryError, decoupling_matrix, shape_matrix

R = 0.12
X = R * np.array([1, 1, 1, 0, 0, 0, -1, -1, -1])
Y = R * np.array([1, 0, -1, 1, 0, -1, 1, 0, -1])


def test_grid_gives_the_corrected_equation_9() -> None:
    T = decoupling_matrix(X, Y)
    six = 1 / (6 * R)
    expected = np.array([np.sign(Y) * six, np.sign(X) * six, np.full(9, 1 / 9)])
    # Rounding of the pseudo-inverse.
    np.testing.assert_allclose(T, expected, atol=1e-15 / R)


def test_pose_and_wrench_are_recovered_from_gaps_and_forces() -> None:
    rng = np.random.default_rng(1)
    for n in (3, 4, 9, 12):
        x, y = rng.uniform(-0.2, 0.2, (2, n))
        S, T = shape_matrix(x, y), decoupling_matrix(x, y)
        np.testing.assert_allclose(T @ S, np.eye(3), atol=1e-12)
        # The forces T^T tau give the wrench tau.
        np.testing.assert_allclose(S.T @ T.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("x", "y"), [([0.1, 0.0], [0.0, 0.1]), ([0.1, 0.0, -0.1], [0.2, 0.0, -0.2])]
)
def test_points_that_do_not_determine_three_dof_are_rejected(
    x: list[float], y: list[float]
) -> None:
    with pytest.raises(GeometryError, match="not on one line"):
        decoupling_matrix(x, y)
