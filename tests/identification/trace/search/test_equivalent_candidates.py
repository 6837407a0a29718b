"""Test the search for candidates that are equivalent to an accepted effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from declared_model_records import PLACES, point, record

from levid.identification.trace.linearised.linearisation_point import WorkingPoint
from levid.identification.trace.linearised.linearise_prediction_errors import linearise
from levid.identification.trace.search.backward_elimination import removal_costs
from levid.identification.trace.search.equivalent_candidates import equivalents
from levid.identification.trace.search.gauss_newton import Candidate, gather
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

OPTIONS = SearchOptions()
EFFECTS = all_effects(PLACES, Extent.typical(PLACES))
WEIGHT, CABLE = "beam_motion.gravity@theta", "cable_pull.linear@theta"


class OneRecord:
    def train(self, at: WorkingPoint, candidates: tuple[Candidate, ...] = (), only=None):
        return [linearise(at, record("moving", 21_000), list(candidates))]


def lighter() -> WorkingPoint:
    """Return the true plant, described with less gravity and an error of the beam's weight."""
    here = point(g=9.0)
    weight = next(e for e in EFFECTS if e.identity == WEIGHT)
    amplitude = here.model.values["m_b"] * (9.81 - 9.0)
    return replace(here, placed=(Placed(weight, (), (amplitude,)),))


def test_cable_is_equivalent_to_the_weight_and_others_are_not() -> None:
    here = lighter()
    (rivals,) = equivalents(here, EFFECTS, OneRecord(), OPTIONS).values()
    names = [t.effect.identity for t in rivals]
    assert CABLE in names
    assert WEIGHT not in names
    assert not {"stiffness.cubic@theta", "friction.coulomb@z"} & set(names)
    cable = rivals[names.index(CABLE)]
    # Equal columns: the same amplitude, and the same gain in every block.
    assert cable.amplitudes[0] == pytest.approx(here.placed[0].amplitudes[0], rel=0.02)
    (cost,) = removal_costs(here, gather(here, OneRecord().train(here)))
    np.testing.assert_allclose(cable.blocks, cost, rtol=1e-3)


def test_without_candidates_nothing_is_equivalent() -> None:
    assert equivalents(lighter(), (), OneRecord(), OPTIONS) == {}
    assert equivalents(point(), EFFECTS, OneRecord(), OPTIONS) == {}
