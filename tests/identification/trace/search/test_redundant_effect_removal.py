"""Test the removal of effects that stood in for another one once that one is accepted."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
from effect_test_helpers import rig_places
from linearisation_point_stub import Measured, Point

from levid.identification.trace.search import backward_elimination, forward_selection
from levid.identification.trace.search.candidate_screening import HeldError, Round, Tried
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects

NAMED = {e.identity: e for e in all_effects(rig_places())}
FIRST, SECOND, THIRD = "coil_gain@coil:1", "coil_gain@coil:2", "coil_gain@coil:3"
EXCESS = 1e6


def tried(identity: str, gain: float) -> Tried:
    return Tried(NAMED[identity], (), gain, None, (1.0,), 100.0)  # type: ignore[arg-type]


def placed(*identities: str) -> Point:
    each = tuple(Placed(NAMED[i], (), (1.0,)) for i in identities)
    return Point(each, Measured(measured=False))


def round_of(taken: Tried | None, *alternatives: Tried) -> Round:
    return Round(EXCESS, 1e5, (), (), (), taken, alternatives)


def accept_first(point: Point, found: Round, *_: object) -> tuple[Round, Point]:
    """Return the round with its first survivor accepted, and the point with this effect."""
    taken = found.survivors[0]
    added = Placed(taken.effect, (), taken.amplitudes)
    return replace(found, taken=taken), replace(point, placed=(*point.placed, added))


@pytest.mark.parametrize(("back", "stands_in"), [(0.0, True), (1e3, True), (5e3, False)])
def test_effect_is_a_stand_in_if_the_error_hardly_grows_without_it(
    back: float, stands_in: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refined(point: Point, _: object, within: float) -> tuple[Point, float]:
        return point, 1000.0 + back * (len(point.placed) < 3)

    monkeypatch.setattr(backward_elimination, "refine", refined)
    rounds = [round_of(None), round_of(tried(FIRST, 9e5), tried(THIRD, 1.0), tried(SECOND, 8e5))]
    begun = placed(FIRST, THIRD, SECOND)
    point, squares, number = backward_elimination.without_stand_in(
        begun, 1000.0, tried(SECOND, 5e4), rounds, None
    )
    names = [p.effect.identity for p in point.placed]
    if not stands_in:
        assert (point, squares, number) == (begun, 1000.0, None)
        return
    assert names == [THIRD, SECOND]
    assert (squares, number) == (1000.0 + back, 1)
    report = backward_elimination.taken_instead(rounds[1], SECOND)
    assert report.taken is rounds[1].alternatives[1]  # with its gain in that round
    assert [t.effect.identity for t in report.alternatives] == [FIRST, THIRD]


def test_removed_effect_or_other_alternative_is_no_stand_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(backward_elimination, "refine", lambda point, _, within: (point, 0.0))
    for begun, rounds in (
        (placed(FIRST, SECOND), [round_of(tried(FIRST, 9e5), tried(THIRD, 8e5))]),
        (placed(THIRD, SECOND), [round_of(tried(FIRST, 9e5), tried(SECOND, 8e5))]),
    ):
        answer = backward_elimination.without_stand_in(
            begun, 1000.0, tried(SECOND, 5e4), rounds, None
        )
        assert answer == (begun, 1000.0, None)


@pytest.mark.parametrize(
    ("back", "removed"), [(-1e4, True), (0.0, True), (5e3, True), (5e4, False)]
)
def test_effect_that_only_helped_another_out_of_a_local_minimum_is_removed(
    back: float, removed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refined(point: Point, _: object, within: float) -> tuple[Point, float]:
        return point, 1000.0 + back

    monkeypatch.setattr(backward_elimination, "refine", refined)
    begun = placed(FIRST, SECOND)
    alone = backward_elimination.without_guide(begun, 1000.0, 1000.0 + 1e5, None)
    assert (alone is not None) is removed
    assert alone is None or alone.placed == begun.placed[:1]
    assert backward_elimination.without_guide(placed(FIRST), 1000.0, 1e5, None) is None


@pytest.mark.parametrize(("after", "kept"), [(1.0, [FIRST]), (9.99, [FIRST, SECOND])])
def test_search_continues_without_the_helper_if_held_out_errors_fall(
    after: float, kept: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, alone = placed(FIRST), replace(placed(FIRST), disturbance=Measured(True))
    train = SimpleNamespace(squares=1e5, excess=EXCESS)
    screened_names = [round_of(None), round_of(None)]
    screened_names[0] = replace(screened_names[0], survivors=(tried(SECOND, 9e4),))
    rounds = iter(screened_names)
    monkeypatch.setattr(forward_selection, "_screened", lambda *_: (next(rounds), train))
    monkeypatch.setattr(forward_selection, "sifted", accept_first)
    monkeypatch.setattr(forward_selection, "refine", lambda point, *_, **__: (point, 1e3))
    monkeypatch.setattr(forward_selection, "asked_again", lambda _, taken, *__: taken)
    monkeypatch.setattr(forward_selection, "without_guide", lambda *_: alone)
    monkeypatch.setattr(forward_selection, "without_idle", lambda point, _: point)
    monkeypatch.setattr(forward_selection, "_believing", lambda point, *_: point)
    errors = {id(alone): after}
    records = SimpleNamespace(
        with_estimated_noise=lambda point: point,
        held_error=lambda point: HeldError(errors.get(id(point), 5.0), 1.0),
    )
    point, error, report = forward_selection.grown(
        forward_selection.Grown(begun, HeldError(10.0, 1.0), ()),
        [NAMED[SECOND]],
        3,
        0.0,
        records,
        lambda *_: None,
    )
    assert [p.effect.identity for p in point.placed] == kept
    assert error.squares == min(after, 5.0)
    assert [found.taken is None for found in report] == [len(kept) == 1, True]


@pytest.mark.parametrize("accepted_with_second", [True, False])
def test_rejected_effect_is_tried_again_after_another_is_accepted(
    accepted_with_second: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Held-out records reject FIRST without SECOND."""
    screened_names: list[tuple[str, ...]] = []

    def screened(point: Point, candidates, *_: object) -> tuple[Round, SimpleNamespace]:
        there = [effect.identity for effect, _ in candidates]
        screened_names.append(tuple(there))
        survivors = tuple(tried(name, 9e4) for name in (FIRST, SECOND, THIRD) if name in there)
        train = SimpleNamespace(squares=1e5, excess=1e5)
        return replace(round_of(None), survivors=survivors), train

    def answer(point: Point, taken: Tried, *_: object) -> Tried:
        names = [p.effect.identity for p in point.placed]
        refused = taken.effect.identity == THIRD or (
            taken.effect.identity == FIRST and not (accepted_with_second and SECOND in names)
        )
        return replace(taken, chance=-20.0 if refused else 100.0)

    monkeypatch.setattr(forward_selection, "_screened", screened)
    monkeypatch.setattr(forward_selection, "sifted", accept_first)
    monkeypatch.setattr(forward_selection, "refine", lambda point, *_, **__: (point, 1e3))
    monkeypatch.setattr(forward_selection, "asked_again", answer)
    monkeypatch.setattr(
        forward_selection, "without_stand_in", lambda point, left, *_: (point, left, None)
    )
    monkeypatch.setattr(forward_selection, "without_guide", lambda *_: None)
    monkeypatch.setattr(forward_selection, "without_idle", lambda point, _: point)
    monkeypatch.setattr(forward_selection, "_believing", lambda point, *_: point)
    records = SimpleNamespace(
        with_estimated_noise=lambda point: point,
        held_error=lambda point: HeldError(5.0 / (1 + len(point.placed)), 1.0),
    )
    effects = [NAMED[name] for name in (FIRST, SECOND, THIRD)]
    point, _, report = forward_selection.grown(
        forward_selection.Grown(placed(), HeldError(10.0, 1.0), ()),
        effects,
        6,
        0.0,
        records,
        lambda *_: None,
    )
    names = [p.effect.identity for p in point.placed]
    assert names == ([SECOND, FIRST] if accepted_with_second else [SECOND])
    # An effect rejected twice is not tried again, and the search ends.
    assert [FIRST in there for there in screened_names[:3]] == [True, False, True]
    assert screened_names[-1] == ()
    assert report[-1].taken is None


def test_platform_effect_with_a_small_gain_may_follow_random_forces() -> None:
    drives = tried("cogging@beam", 0.001 * EXCESS)
    rounds = [
        round_of(tried(FIRST, 0.5 * EXCESS)), round_of(None), round_of(drives),
        round_of(tried(SECOND, 0.006 * EXCESS)), round_of(tried(THIRD, 0.04 * EXCESS)),
    ]  # fmt: skip
    assert backward_elimination.followers(rounds) == {SECOND}


def test_share_of_friction_is_reported_for_each_dof(monkeypatch: pytest.MonkeyPatch) -> None:
    both = placed("rod_stiffness.cubic@psi", "friction.bearing@beam+psi", "friction.dahl@psi")
    monkeypatch.setattr(forward_selection, "brought", lambda *_: [9e5, 7e5, 3e5])
    assert forward_selection._rubbed(both, None) == {"psi": 7e5}
    monkeypatch.setattr(forward_selection, "brought", lambda *_: pytest.fail("asked without need"))
    assert forward_selection._rubbed(placed(FIRST), None) == {}
