"""Test how a law is fitted and judged that would take the place of a found one."""

from __future__ import annotations

import numpy as np

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.trace.force_regression.held_out_gain import Gain
from levid.identification.trace.force_search.compare_with_rivals import contradicted_no_more
from levid.identification.trace.force_search.rated_candidate import Rated, _starts
from levid.identification.trace.records.record_from_log import imported_places
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Effect, Placed
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

MODEL = """
levid: model
name: stage
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
M: [[8.0]]
D: [[60.0]]
K: [[0.0]]
"""


def law(key: str) -> Effect:
    places = imported_places(parse_text(MODEL, ModelConfig, "stage"))
    table = all_effects(places, Extent((0.03,), (0.2,), 0.03, 20.0, 0.0))
    return next(e for e in table if e.key == key)


def test_lugre_friction_begins_at_the_numbers_of_the_dahl_friction_that_it_contains() -> None:
    """A start value is a share of the travel, of which the elastic reach may be a thousandth."""
    lugre = law("friction.lugre")
    short = Placed(law("friction.dahl"), (4e-5,), (11.0,))
    assert _starts(lugre, None) == list(lugre.grid)
    starts = _starts(lugre, short)
    assert starts[: len(lugre.grid)] == list(lugre.grid)
    names = [q.name for q in lugre.shape]
    assert names[0] == "x_s"
    assert starts[len(lugre.grid) :] == [(4e-5, *shape[1:]) for shape in lugre.grid]


def test_a_record_that_contradicts_a_found_law_says_nothing_against_its_rival() -> None:
    """Of two laws that are nearly one force, a record contradicted both."""

    def rated(key: str, *others: float) -> Rated:
        gain = Gain(np.ones(2), np.ones(2), 0.5, np.ones(2), np.array(others))
        return Rated(Placed(law(key), (), (1.0,)), gain, 0.1)

    own = rated("stiffness.cubic", 2e5, -10.10)
    as_much = rated("damping.quadratic", 2e5, -10.15)
    more = rated("friction.coulomb", 9.0, -50.0)
    judged = contradicted_no_more([own, as_much, more], own.placed, SearchOptions())
    assert [r.gain.elsewhere for r in judged] == [False, True, False]


def test_a_law_without_a_number_in_common_begins_at_its_own_values() -> None:
    short = Placed(law("friction.dahl"), (4e-5,), (11.0,))
    stribeck = law("friction.stribeck")
    assert _starts(stribeck, short) == list(stribeck.grid)
