"""Test the fit of one candidate where its start values are beyond what its law can be."""

from __future__ import annotations

import numpy as np

from levid.identification.trace.force_regression.candidate_fit import _coordinates, _shape
from levid.model.effects.base import Quantity

PITCH, SPEED = Quantity("pitch", "rad", 0.1, 10.0, log=True), Quantity("v", "rad/s", -1.0, 3.0)


def test_start_beyond_a_bound_begins_at_the_bound() -> None:
    """A line of the spectrum over many turns of an encoder has a period longer than any pitch."""
    at = _coordinates((PITCH, SPEED), (350.0, -2.0))
    np.testing.assert_array_equal(at, [2.0, 1.0])
    assert _shape((PITCH, SPEED), at) == (10.0, -1.0)


def test_start_between_the_bounds_stays() -> None:
    at = _coordinates((PITCH, SPEED), (1.0, 2.0))
    np.testing.assert_allclose(at, [1.5, 1.75])
    np.testing.assert_allclose(_shape((PITCH, SPEED), at), (1.0, 2.0))
