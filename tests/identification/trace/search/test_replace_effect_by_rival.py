"""Test the swap of an accepted effect with a close rival if much error remains."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from effect_test_helpers import rig_places
from linearisation_point_stub import Point

from levid.identification.trace.search import replace_effect_by_rival
from levid.identification.trace.search.forward_selection import Grown
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
DAMPING, DRAG, COULOMB, GAIN = (
    "air_damping.linear@z", "air_damping.quadratic@z", "friction.coulomb@z", "coil_gain@coil:1"
)  # fmt: skip
LEFT = 10.0
SURELY = Agreement(100.0, 100.0, 100.0, True)


def tried(identity: str, gain: float, agreement: Agreement = SURELY) -> Tried:
    effect = NAMED[identity]
    return Tried(effect, effect.grid[0], gain, np.ones(1), (1.0,), agreement)


def effect_names(found: Grown) -> list[str]:
    return [p.effect.identity for p in found.point.placed]


def found(*rounds: Round) -> Grown:
    placed = [Placed(r.taken.effect, (), (1.0,)) for r in rounds if r.taken is not None]
    return Grown(Point(tuple(placed)), HeldError(1.0 + LEFT, 1.0, np.ones(6)), rounds)  # type: ignore[arg-type]


def round_of(taken: Tried | None, *others: Tried) -> Round:
    survivors = others if taken is None else (taken, *others)
    return Round(1e6, 1e5, survivors, survivors, taken, others)


@pytest.fixture
def starting_points(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Return the effects at the start of each alternative search."""
    reported: list[list[str]] = []

    def grown(so_far: Grown, effects: object, most: int, *_: object) -> Grown:
        reported.append(effect_names(so_far))
        return so_far

    monkeypatch.setattr(replace_effect_by_rival, "grown", grown)
    monkeypatch.setattr(replace_effect_by_rival, "refine", lambda point, *_, **__: (point, 1e3))
    monkeypatch.setattr(replace_effect_by_rival, "tested", lambda _, some, *__: list(some))
    return reported


def records_with_errors(**error_with: float) -> Any:
    """Return records whose held-out error above noise depends on the placed effects."""

    def held_error(point: Point) -> HeldError:
        classes = [p.effect.identity.partition("@")[0].replace(".", "_") for p in point.placed]
        left = min((error_with.get(c, LEFT) for c in classes), default=LEFT)
        return HeldError(1.0 + left, 1.0, np.ones(6))

    return SimpleNamespace(held_error=held_error)


def no_progress(*_: object) -> None:
    """Ignore the progress."""


def test_rival_replaces_the_accepted_effect_if_it_halves_the_error(
    starting_points: list[list[str]],
) -> None:
    so_far = found(
        round_of(tried(GAIN, 9e5)),
        round_of(tried(DAMPING, 5e5), tried(DRAG, 4.5e5)),
        round_of(None, tried(COULOMB, 4e3)),
    )
    swapped = replace_effect_by_rival.otherwise(
        so_far, (), 4, records_with_errors(air_damping_quadratic=0.1), no_progress, OPTIONS
    )
    assert starting_points == [[GAIN, DRAG]]
    assert effect_names(swapped) == [GAIN, DRAG]
    # The rounds report the rival as accepted in that round.
    assert [r.taken and r.taken.effect.identity for r in swapped.rounds] == [GAIN, DRAG]
    assert not swapped.rounds[1].alternatives
    assert swapped.rounds[1].instead_of is NAMED[DAMPING]
    same = replace_effect_by_rival.otherwise(
        so_far, (), 4, records_with_errors(air_damping_quadratic=0.6 * LEFT), no_progress, OPTIONS
    )
    assert same is so_far


def test_rival_with_the_smallest_error_is_chosen(starting_points: list[list[str]]) -> None:
    so_far = found(round_of(tried(DAMPING, 5e5), tried(DRAG, 4.8e5), tried(COULOMB, 4.6e5)))
    swapped = replace_effect_by_rival.otherwise(
        so_far,
        (),
        4,
        records_with_errors(air_damping_quadratic=4.0, friction_coulomb=2.0),
        no_progress,
        OPTIONS,
    )
    assert starting_points == [[DRAG], [COULOMB]]
    assert effect_names(swapped) == [COULOMB]
    # After a small error no other rival is tried.
    del starting_points[:]
    swapped = replace_effect_by_rival.otherwise(
        so_far, (), 4, records_with_errors(air_damping_quadratic=0.5), no_progress, OPTIONS
    )
    assert (starting_points, effect_names(swapped)) == ([[DRAG]], [DRAG])


@pytest.mark.parametrize(
    "rival",
    [
        tried(DRAG, 2.4e5),  # less than half of the gain
        tried(DRAG, 4.9e5, Agreement(100.0, 100.0, 5.0, True)),  # held-out data do not agree
        tried(DRAG, 4.9e5, Agreement(5.0, 1.0, 1.0, False)),  # nor do blocks that did not fit it
    ],
)
def test_rival_with_small_gain_or_without_agreement_is_not_tried(
    rival: Tried, starting_points: list[list[str]]
) -> None:
    so_far = found(round_of(tried(DAMPING, 5e5), rival))
    assert (
        replace_effect_by_rival.otherwise(
            so_far, (), 4, records_with_errors(air_damping_quadratic=0.1), no_progress, OPTIONS
        )
        is so_far
    )
    assert not starting_points


def test_no_swap_if_the_rival_is_placed_or_the_effect_was_removed(
    starting_points: list[list[str]],
) -> None:
    with_rival = found(
        round_of(tried(DAMPING, 5e5), tried(DRAG, 4.9e5)), round_of(tried(DRAG, 1e5))
    )
    assert (
        replace_effect_by_rival.otherwise(
            with_rival, (), 4, records_with_errors(), no_progress, OPTIONS
        )
        is with_rival
    )
    with_removed_effect = with_rival._replace(
        point=replace(with_rival.point, placed=with_rival.point.placed[1:])
    )
    assert (
        replace_effect_by_rival.otherwise(
            with_removed_effect, (), 4, records_with_errors(), no_progress, OPTIONS
        )
        is with_removed_effect
    )
    assert not starting_points


def test_at_most_three_rivals_are_tried_and_failed_fits_are_ignored(
    starting_points: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    rivals = [tried(f"coil_gain@coil:{n}", 4.9e5 - n) for n in range(2, 7)]
    so_far = found(round_of(tried(GAIN, 5e5), *rivals))
    assert (
        replace_effect_by_rival.otherwise(
            so_far, (), 4, records_with_errors(), no_progress, OPTIONS
        )
        is so_far
    )
    assert starting_points == [[f"coil_gain@coil:{n}"] for n in (2, 3, 4)]
    del starting_points[:]

    def diverges(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError

    # A failed fit does not change the result.
    for fails in ("grown", "refine"):
        monkeypatch.setattr(replace_effect_by_rival, fails, diverges)
        assert (
            replace_effect_by_rival.otherwise(
                so_far, (), 4, records_with_errors(), no_progress, OPTIONS
            )
            is so_far
        )
    assert not starting_points


def test_progress_never_decreases(
    starting_points: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def grown(
        so_far: Grown, effects: Any, most: int, gain: float, records: Any, progress: Any, *_: Any
    ) -> Grown:
        progress("screening", 0.15)
        return so_far

    monkeypatch.setattr(replace_effect_by_rival, "grown", grown)
    reported: list[float] = []
    so_far = found(round_of(tried(GAIN, 5e5), tried(DRAG, 4.9e5)))
    replace_effect_by_rival.otherwise(
        so_far, (), 4, records_with_errors(), lambda _, done: reported.append(done), OPTIONS
    )
    assert len(reported) == 2
    assert reported == sorted(reported)
