"""Test where the textbook form of a law begins: it does about what the fitted law does."""

from __future__ import annotations

import numpy as np
import pytest

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.trace.records.record_from_log import imported_places
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

MODEL = """
levid: model
name: axis
dof: [{name: q, unit: rad}]
inputs: [{name: u, unit: N m}]
M: [[1.0]]
D: [[1.0]]
K: [[1.0]]
"""


@pytest.mark.parametrize("depth", [0.4, 1.7])
def test_second_order_lag_of_depth_one_is_as_late(depth: float) -> None:
    """At the same frequency and damping it was later or earlier by far, and no fit came back."""
    places = imported_places(parse_text(MODEL, ModelConfig, "axis"))
    table = all_effects(places, Extent((1.0,), (10.0,), 1.0, 1.0, 0.0, fastest_hz=50.0))
    (effect,) = (e for e in table if e.key == "actuator_lag.second_order")
    frequency_hz, damping = 20.0, 0.8
    plain = Placed(effect, (frequency_hz, damping), (depth,)).as_textbook()
    assert plain is not None
    assert plain.amplitudes == (1.0,)

    def response(placed: Placed, freq_hz: np.ndarray) -> np.ndarray:
        (share,), (corner_hz, zeta) = placed.amplitudes, placed.shape
        s = 1j * freq_hz / corner_hz
        return 1.0 + share * (1.0 / (s**2 + 2.0 * zeta * s + 1.0) - 1.0)

    slow = np.array([0.1, 0.2])
    found = response(Placed(effect, (frequency_hz, damping), (depth,)), slow)
    np.testing.assert_allclose(np.angle(response(plain, slow)), np.angle(found), rtol=1e-3)
