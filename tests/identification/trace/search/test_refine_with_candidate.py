"""Test the fit of a model with a candidate added: where it begins, where it ends, what it asks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from declared_model_records import PLACES, point, record

from levid.identification.records.record import IdentificationError
from levid.identification.trace.linearised.linearisation_point import WorkingPoint
from levid.identification.trace.linearised.linearise_prediction_errors import linearise
from levid.identification.trace.search.gauss_newton import NEARLY, Candidate, gather, refine
from levid.identification.trace.search.refine_with_candidate import moved_beside, refined_with
from levid.identification.trace.search.tested_candidate import Tried
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

EFFECTS = {e.identity: e for e in all_effects(PLACES, Extent.typical(PLACES))}
WEAKER = Tried(EFFECTS["coil_gain@coil:3"], (), 0.0, np.zeros(1), (0.0,))
"""A gain that the plant does not have, beside parameters that are off."""
TRUE = point()
OFF = point(m_p=1.05 * TRUE.model.values["m_p"], k_z=0.96 * TRUE.model.values["k_z"])


class OneRecord:
    """A record of the declared model, and which points it was asked about."""

    def __init__(self, forbidden: float = np.inf) -> None:
        self.points: list[WorkingPoint] = []
        self.forbidden = forbidden

    def train(self, at: WorkingPoint, candidates: tuple[Candidate, ...] = (), only=None):
        if at.placed and abs(at.model.values["m_p"] - OFF.model.values["m_p"]) > self.forbidden:
            raise IdentificationError("no such model")
        self.points.append(at)
        return [linearise(at, record("still", 8000), list(candidates))]


def squares(at: WorkingPoint) -> float:
    return gather(at, OneRecord().train(at)).squares


def test_all_numbers_begin_where_the_linearised_records_ask() -> None:
    moved = moved_beside(OFF, WEAKER, OneRecord())
    for name in ("m_p", "k_z"):
        true = TRUE.model.values[name]
        # What is left is of second order: of 5 %, 0.25 %.
        assert abs(moved.model.values[name] - true) < 0.1 * abs(OFF.model.values[name] - true)
    assert squares(moved) < 0.01 * squares(OFF)


def test_it_ends_where_a_fit_from_the_old_numbers_ends_and_asks_less() -> None:
    begun = replace(OFF, placed=(WEAKER.placed,))
    plain, at_once = OneRecord(), OneRecord()
    expected, least = refine(begun, plain, within=NEARLY)
    found, left = refined_with(OFF, WEAKER, squares(OFF), at_once)
    assert [p.effect.identity for p in found.placed] == [WEAKER.effect.identity]
    assert left == pytest.approx(least, abs=1.0)  # squared errors: the noise of one number
    for name in ("m_p", "k_z"):
        assert found.model.values[name] == pytest.approx(expected.model.values[name], rel=1e-4)
    asked = [sum(bool(p.placed) for p in records.points) for records in (at_once, plain)]
    assert asked[0] < asked[1]


def test_numbers_that_cannot_be_computed_with_begin_where_they_are() -> None:
    records = OneRecord(forbidden=0.03 * TRUE.model.values["m_p"])
    found, left = refined_with(OFF, WEAKER, squares(OFF), records)
    assert found.placed
    assert left < squares(OFF)
    assert records.points[1].model.values == OFF.model.values
