"""Which candidates are said to fit as well as the one that is taken."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rig_effects import rig_places

from levid.identification.trace.search import candidate_shortlist
from levid.identification.trace.search.candidate_screening import Round, Tried
from levid.model.effects.candidate_effects import all_effects

EFFECTS = {effect.identity: effect for effect in all_effects(rig_places())}


def tried(identity: str, gain: float, *shape: float) -> Tried:
    """Return a candidate that gains so much, all of it in the first of two records."""
    effect = EFFECTS[identity]
    return Tried(effect, shape, gain, np.array([gain, 0.0]), (1.0,), 9.0)


@pytest.fixture
def alike(monkeypatch):
    """Return what is kept beside the best, if fits of the records that tell most end alike."""

    def fitted(point, *_):
        return SimpleNamespace(placed=(point.tried,), tried=point.tried), 50.0

    def named(_, candidate: Tried):
        return SimpleNamespace(tried=candidate)

    monkeypatch.setattr(candidate_shortlist, "refine", fitted)
    monkeypatch.setattr(candidate_shortlist, "with_tried", named)
    monkeypatch.setattr(candidate_shortlist, "gather", lambda *_: SimpleNamespace(squares=1000.0))
    records = SimpleNamespace(train=lambda *_, **__: [])
    train = SimpleNamespace(record=np.array([0, 1]))

    def kept(*survivors: Tried) -> list[str]:
        found = Round(1000.0, 100.0, survivors, survivors, (), None, ())
        out, _ = candidate_shortlist.sifted(SimpleNamespace(placed=()), found, train, records)
        assert out.taken is not None
        assert out.taken.effect is survivors[0].effect
        return [t.effect.identity for t in out.alternatives]

    return kept


COIL_6, COIL_0, SATURATION = "coil_gain@coil:6", "coil_gain@coil:0", "saturation@coil:6"


def test_another_coil_is_no_alternative_where_all_records_tell(alike):
    saturates = tried(SATURATION, 600.0, 14.0, 6.0)
    # That with a shape may fit better than on its grid: the fits decide.
    assert alike(tried(COIL_6, 950.0), tried(COIL_0, 900.0), saturates) == [SATURATION]
    assert alike(tried(COIL_6, 950.0), tried(COIL_0, 945.0), saturates) == [COIL_0, SATURATION]


def test_without_shapes_all_records_decide(alike):
    assert alike(tried(COIL_6, 950.0), tried(COIL_0, 900.0)) == []
    assert alike(tried(COIL_6, 950.0), tried(COIL_0, 945.0)) == [COIL_0]
    assert alike(tried(COIL_6, 90.0), tried(COIL_0, 79.0)) == [COIL_0]  # three deviations


def test_who_has_far_to_go_from_a_guess_goes_on_from_where_it_came_to(monkeypatch):
    """A yielding spring fell by two fifths first, and in the end below a plain one."""
    plain, yielding = "flexible_mode.loose_mass@psi", "friction.bearing@beam+psi"
    leaves = {plain: [100.0], yielding: [900.0, 400.0, 50.0]}
    came_to = {plain: [0], yielding: [0]}

    def fitted(point, *_):
        left, steps = leaves[point.tried.effect.identity], came_to[point.tried.effect.identity]
        assert point.at == steps[-1]  # with the model as it was fitted beside it
        steps.append(min(point.at + 1, len(left)))
        after = SimpleNamespace(tried=point.tried, placed=(point.tried,), at=steps[-1])
        return after, left[steps[-1] - 1]

    monkeypatch.setattr(candidate_shortlist, "refine", fitted)
    monkeypatch.setattr(
        candidate_shortlist, "with_tried", lambda _, t: SimpleNamespace(tried=t, at=0)
    )
    monkeypatch.setattr(candidate_shortlist, "gather", lambda *_: SimpleNamespace(squares=1500.0))
    survivors = tried(plain, 900.0, 15.0, 0.1), tried(yielding, 500.0, 15.0, 0.2, 0.02, 0.1)
    found = Round(1000.0, 100.0, survivors, survivors, (), None, ())
    train = SimpleNamespace(record=np.array([0, 1]))
    records = SimpleNamespace(train=lambda *_, **__: [])
    out, point = candidate_shortlist.sifted(SimpleNamespace(placed=()), found, train, records)
    assert out.taken is not None
    assert out.taken.effect.identity == yielding
    assert point.at == 3
