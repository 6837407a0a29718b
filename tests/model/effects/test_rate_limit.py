"""Test the rate limits of an actuator against the ramp itself."""

from __future__ import annotations

import numpy as np

from levid.model.effects.rate_limit import _followed

STEP, FINE = 0.8, 4000


def test_ramp_has_its_mean_moment_and_end() -> None:
    F = np.random.default_rng(0).standard_normal(100)
    s, value = (np.arange(FINE) + 0.5) / FINE, F[0]
    for row, found in enumerate(zip(*_followed(F, STEP), strict=True)):
        left = F[row] - value
        ramp = value + np.sign(left) * np.minimum(STEP * s, abs(left))
        value += np.sign(left) * min(STEP, abs(left))
        # Midpoints miss the corner of the ramp by its bend over a step.
        np.testing.assert_allclose(
            found, [ramp.mean(), np.mean(ramp * (s - 0.5)), value], atol=1.0 / FINE**1.5
        )
