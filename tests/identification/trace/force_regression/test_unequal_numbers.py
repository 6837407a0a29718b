"""Test the doubt of a lag whose lateness and duration differ: something else is late."""

from __future__ import annotations

import pytest

from levid.config.base import parse_text
from levid.config.model import EffectParameter, ModelConfig
from levid.identification.trace.force_regression.force_trace_summary import FoundLaw
from levid.identification.trace.force_regression.rated_candidate import Rated
from levid.identification.trace.records.record_from_log import imported_places
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects

MODEL = """
levid: model
name: arm
dof: [{name: q, unit: rad}]
inputs: [{name: u, unit: V}]
M: [[1.0]]
D: [[1.0]]
K: [[1.0]]
"""


@pytest.mark.parametrize(
    ("lag", "tail", "se", "unequal"),
    [
        (0.017, 0.1, 1e-3, True),
        (0.017, 0.1, 0.03, False),  # not told apart
        (0.004, 0.006, 1e-6, False),  # by less than half
        (0.02, 0.02, 1e-6, False),
    ],
)
def test_lag_and_tail_of_a_plain_lag_are_the_same(
    lag: float, tail: float, se: float, unequal: bool
) -> None:
    places = imported_places(parse_text(MODEL, ModelConfig, "arm"))
    (effect,) = (e for e in all_effects(places) if e.key == "actuator_lag")
    rated = Rated(Placed(effect, (tail,), (lag,)), None, 0.1)  # type: ignore[arg-type]
    numbers = {
        "lag": EffectParameter(value=lag, unit="s", se=se),
        "tail": EffectParameter(value=tail, unit="s", se=se),
    }
    law = FoundLaw(rated, numbers, 1.0, (), (), 0.0, 0.1, None, (False, False), True, 3.0)
    assert law.doubtful == unequal
    assert any("lag and tail" in d for d in law.doubts) == unequal
