"""Test the removal of effects that stood in for another one once that one is accepted."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from effect_test_helpers import rig_places
from linearisation_point_stub import Measured, Point

from levid.identification.trace.search import backward_elimination, forward_selection
from levid.identification.trace.search.predictive_criterion import Criterion
from levid.identification.trace.search.tested_candidate import (
    Agreement,
    HeldError,
    Round,
    Tried,
)
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects

OPTIONS = SearchOptions()
NAMED = {e.identity: e for e in all_effects(rig_places())}
FIRST, SECOND, THIRD = "coil_gain@coil:1", "coil_gain@coil:2", "coil_gain@coil:3"
EXCESS = 1e6
SURELY, CONTRADICTED = Agreement(100.0, 100.0, 100.0, True), Agreement(100.0, 100.0, -20.0, True)


def tried(identity: str, gain: float) -> Tried:
    return Tried(NAMED[identity], (), gain, np.ones(1), (1.0,), SURELY)


def held_error(squares: float) -> HeldError:
    """Return an error whose blocks scatter by a tenth, each point's in its own way."""
    scatter = np.random.default_rng(round(1e3 * squares)).normal(size=6)
    return HeldError(squares, 1.0, squares + 0.1 * scatter)


def placed(*identities: str) -> Point:
    each = tuple(Placed(NAMED[i], (), (1.0,)) for i in identities)
    return Point(each, Measured(measured=False))


def added(point: Point, taken: Tried, *_: object) -> tuple[Point, float]:
    return replace(point, placed=(*point.placed, taken.placed)), 1e3


def round_of(taken: Tried | None, *alternatives: Tried) -> Round:
    return Round(EXCESS, 1e5, (), (), taken, alternatives)


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
        begun, 1000.0, tried(SECOND, 5e4), rounds, None, OPTIONS
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
            begun, 1000.0, tried(SECOND, 5e4), rounds, None, OPTIONS
        )
        assert answer == (begun, 1000.0, None)


@pytest.mark.parametrize(
    ("back", "removed"), [(-1e4, True), (0.0, True), (9e4, True), (1.1e5, False)]
)
def test_effect_that_only_helped_another_out_of_a_local_minimum_is_removed(
    back: float, removed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refined(point: Point, _: object, within: float) -> tuple[Point, float]:
        return point, 1000.0 + back

    monkeypatch.setattr(backward_elimination, "refine", refined)
    shaped = NAMED["dead_zone@coil:1"]
    begun = placed(FIRST, SECOND)
    begun = replace(begun, placed=(Placed(shaped, shaped.grid[0], (1.0,)), begun.placed[1]))
    alone = backward_elimination.without_guide(begun, 1000.0, EXCESS, None, OPTIONS)
    assert (alone is not None) is removed
    assert alone is None or alone.placed == begun.placed[:1]
    for linear in (placed(FIRST), placed(FIRST, SECOND)):  # their fit has one minimum
        assert backward_elimination.without_guide(linear, 1000.0, EXCESS, None, OPTIONS) is None


@pytest.mark.parametrize(("after", "kept"), [(1.0, [FIRST]), (9.99, [FIRST, SECOND])])
def test_search_continues_without_the_helper_if_held_out_errors_fall(
    after: float, kept: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, alone = placed(FIRST), replace(placed(FIRST), disturbance=Measured(True))
    train = SimpleNamespace(squares=1e5, excess=EXCESS)
    screened_names = [round_of(None), round_of(None)]
    screened_names[0] = round_of(tried(SECOND, 9e4))
    rounds = iter(screened_names)
    monkeypatch.setattr(
        forward_selection,
        "_screened",
        lambda *_: (next(rounds), train, Criterion(OPTIONS, 9e4, 0.0)),
    )
    monkeypatch.setattr(forward_selection, "refined_with", added)
    monkeypatch.setattr(forward_selection, "tested", lambda _, some, *__: list(some))
    monkeypatch.setattr(forward_selection, "without_guide", lambda *_: alone)
    monkeypatch.setattr(forward_selection, "without_idle", lambda point, *_: point)
    monkeypatch.setattr(forward_selection, "_believing", lambda point, *_: point)
    errors = {id(alone): after}
    records = SimpleNamespace(
        with_estimated_noise=lambda point: point,
        held_error=lambda point: held_error(errors.get(id(point), 5.0)),
    )
    point, error, report = forward_selection.grown(
        forward_selection.Grown(begun, held_error(10.0), ()),
        [NAMED[SECOND]],
        3,
        0.0,
        records,
        lambda *_: None,
        OPTIONS,
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

    def screened(point: Point, candidates, *_: object) -> tuple[Round, SimpleNamespace, Criterion]:
        there = [effect.identity for effect, _ in candidates]
        screened_names.append(tuple(there))
        best = next((tried(name, 9e4) for name in (FIRST, SECOND, THIRD) if name in there), None)
        train = SimpleNamespace(squares=1e5, excess=1e5)
        return round_of(best and refused(point, best)), train, Criterion(OPTIONS, 9e4, 0.0)

    def refused(point: Point, taken: Tried) -> Tried:
        """Return a candidate that is refused once it was fitted, or not."""
        names = [p.effect.identity for p in point.placed]
        refused = taken.effect.identity == THIRD or (
            taken.effect.identity == FIRST and not (accepted_with_second and SECOND in names)
        )
        return replace(taken, agreement=CONTRADICTED) if refused else taken

    monkeypatch.setattr(forward_selection, "_screened", screened)
    monkeypatch.setattr(forward_selection, "refined_with", added)
    monkeypatch.setattr(
        forward_selection, "without_stand_in", lambda point, left, *_: (point, left, None)
    )
    monkeypatch.setattr(forward_selection, "without_guide", lambda *_: None)
    monkeypatch.setattr(forward_selection, "without_idle", lambda point, *_: point)
    monkeypatch.setattr(forward_selection, "_believing", lambda point, *_: point)
    records = SimpleNamespace(
        with_estimated_noise=lambda point: point,
        held_error=lambda point: held_error(5.0 / (1 + len(point.placed))),
    )
    effects = [NAMED[name] for name in (FIRST, SECOND, THIRD)]
    point, _, report = forward_selection.grown(
        forward_selection.Grown(placed(), held_error(10.0), ()),
        effects,
        6,
        0.0,
        records,
        lambda *_: None,
        OPTIONS,
    )
    names = [p.effect.identity for p in point.placed]
    assert names == ([SECOND, FIRST] if accepted_with_second else [SECOND])
    # An effect rejected twice is not tried again, and the search ends.
    assert [FIRST in there for there in screened_names[:3]] == [True, False, True]
    assert screened_names[-1] == ()
    assert report[-1].taken is None


def test_share_of_friction_is_reported_for_each_dof(monkeypatch: pytest.MonkeyPatch) -> None:
    both = placed("rod_stiffness.cubic@psi", "friction.bearing@beam+psi", "friction.dahl@psi")
    monkeypatch.setattr(forward_selection, "brought", lambda *_: [9e5, 7e5, 3e5])
    assert forward_selection._rubbed(both, None) == {"psi": 7e5}
    monkeypatch.setattr(forward_selection, "brought", lambda *_: pytest.fail("asked without need"))
    assert forward_selection._rubbed(placed(FIRST), None) == {}
