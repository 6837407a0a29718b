"""What was taken in place of an effect goes when that comes; what has its own share stays."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from rig_effects import rig_places

from levid.identification.trace import giving_up
from levid.identification.trace.screening import Round, Tried
from levid.model.effects.base import Placed
from levid.model.effects.table import all_effects

NAMED = {e.identity: e for e in all_effects(rig_places())}
FIRST, SECOND, THIRD = "coil_gain@coil:1", "coil_gain@coil:2", "coil_gain@coil:3"
EXCESS = 1e6


@dataclass(frozen=True)
class Point:
    placed: tuple[Placed, ...]


def tried(identity: str, gain: float) -> Tried:
    return Tried(NAMED[identity], (), gain, None, (1.0,), 100.0)  # type: ignore[arg-type]


def placed(*identities: str) -> Point:
    return Point(tuple(Placed(NAMED[i], (), (1.0,)) for i in identities))


def round_of(taken: Tried | None, *alternatives: Tried) -> Round:
    return Round(EXCESS, 1e5, (), (), (), taken, alternatives)


@pytest.mark.parametrize(("back", "stands_in"), [(0.0, True), (1e3, True), (5e3, False)])
def test_stand_in_is_one_if_little_comes_back_without_it(
    back: float, stands_in: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refined(point: Point, _: object, within: float) -> tuple[Point, float]:
        return point, 1000.0 + back * (len(point.placed) < 3)

    monkeypatch.setattr(giving_up, "refine", refined)
    rounds = [round_of(None), round_of(tried(FIRST, 9e5), tried(THIRD, 1.0), tried(SECOND, 8e5))]
    begun = placed(FIRST, THIRD, SECOND)
    point, squares, number = giving_up.without_stand_in(
        begun, 1000.0, tried(SECOND, 5e4), rounds, None
    )
    names = [p.effect.identity for p in point.placed]
    if not stands_in:
        assert (point, squares, number) == (begun, 1000.0, None)
        return
    assert names == [THIRD, SECOND]
    assert (squares, number) == (1000.0 + back, 1)
    told = giving_up.taken_instead(rounds[1], SECOND)
    assert told.taken is rounds[1].alternatives[1]  # it explained this much then
    assert [t.effect.identity for t in told.alternatives] == [FIRST, THIRD]


def test_what_was_no_alternative_or_is_gone_is_no_stand_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(giving_up, "refine", lambda point, _, within: (point, 0.0))
    for begun, rounds in (
        (placed(FIRST, SECOND), [round_of(tried(FIRST, 9e5), tried(THIRD, 8e5))]),
        (placed(THIRD, SECOND), [round_of(tried(FIRST, 9e5), tried(SECOND, 8e5))]),
    ):
        answer = giving_up.without_stand_in(begun, 1000.0, tried(SECOND, 5e4), rounds, None)
        assert answer == (begun, 1000.0, None)
