"""Test the shortlist: which candidates are reported as alternatives to the accepted one."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from effect_test_helpers import rig_places

from levid.identification.trace.search import fit_shortlisted_candidates as shortlist
from levid.identification.trace.search.candidate_screening import Round, Tried
from levid.model.effects.candidate_effects import all_effects

EFFECTS = {effect.identity: effect for effect in all_effects(rig_places())}


def tried(identity: str, gain: float, *shape: float) -> Tried:
    """Return a candidate with this gain, all of it in the first of two records."""
    effect = EFFECTS[identity]
    return Tried(effect, shape, gain, np.array([gain, 0.0]), (1.0,), 9.0)


@pytest.fixture
def alternatives_of(monkeypatch):
    """Return a function that gives the alternatives to the first of some candidates.

    A fit of the shape takes 340 more than its guess.
    """

    def fitted(_, some, __):
        return [replace(t, gain=t.gain + 340.0) if t.shape else t for t in some]

    monkeypatch.setattr(shortlist, "with_fitted_shapes", fitted)
    monkeypatch.setattr(shortlist, "with_tried", lambda _, candidate: candidate)

    def kept(*survivors: Tried) -> list[str]:
        found = Round(1000.0, 100.0, survivors, survivors, (), None, ())
        out, _ = shortlist.sifted(SimpleNamespace(placed=()), found, None)
        assert out.taken is not None
        assert out.taken.effect is survivors[0].effect
        return [t.effect.identity for t in out.alternatives]

    return kept


COIL_6, COIL_0, SATURATION = "coil_gain@coil:6", "coil_gain@coil:0", "saturation@coil:6"


def test_all_records_rule_out_another_coil_as_alternative(alternatives_of):
    saturates = tried(SATURATION, 600.0, 14.0, 6.0)
    # A candidate with a shape may fit better than at its grid point: the fits decide.
    assert alternatives_of(tried(COIL_6, 950.0), tried(COIL_0, 900.0), saturates) == [SATURATION]
    assert alternatives_of(tried(COIL_6, 950.0), tried(COIL_0, 945.0), saturates) == [
        SATURATION,
        COIL_0,
    ]


def test_gain_in_all_records_decides_between_candidates_without_shape(alternatives_of):
    assert alternatives_of(tried(COIL_6, 950.0), tried(COIL_0, 900.0)) == []
    assert alternatives_of(tried(COIL_6, 950.0), tried(COIL_0, 945.0)) == [COIL_0]
    assert alternatives_of(tried(COIL_6, 90.0), tried(COIL_0, 79.0)) == [
        COIL_0
    ]  # three standard deviations


def test_candidate_that_explains_most_with_a_fitted_shape_is_taken(monkeypatch):
    """The fit of a yielding spring starts at a high error and ends below that of a plain one."""
    plain, yielding = "flexible_mode.loose_mass@psi", "friction.bearing@beam+psi"
    ends = {(15.0, 0.1): 905.0, (15.0, 0.2, 0.02, 0.1): 600.0, (9.0, 0.2, 0.02, 0.1): 990.0}

    def fitted(_, some, __):
        return [replace(t, gain=ends[t.shape]) for t in some]

    monkeypatch.setattr(shortlist, "with_fitted_shapes", fitted)
    monkeypatch.setattr(shortlist, "with_tried", lambda _, t: t)
    survivors = tried(plain, 900.0, 15.0, 0.1), tried(yielding, 500.0, 15.0, 0.2, 0.02, 0.1)
    elsewhere = (tried(yielding, 450.0, 9.0, 0.2, 0.02, 0.1),)
    found = Round(1000.0, 100.0, survivors, survivors, elsewhere, None, ())
    out, point = shortlist.sifted(SimpleNamespace(placed=()), found, None)
    assert out.taken is point
    assert (point.effect.identity, point.gain) == (yielding, 990.0)
    assert out.alternatives == ()
