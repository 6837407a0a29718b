"""What was beaten narrowly is tried in the place of what was taken, where much is left."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rig_effects import rig_places
from search_working_points import Point

from levid.identification.trace.search import candidate_swap
from levid.identification.trace.search.candidate_screening import HeldError, Round, Tried
from levid.identification.trace.search.forward_selection import Grown
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects

NAMED = {e.identity: e for e in all_effects(rig_places())}
DAMPING, DRAG, COULOMB, GAIN = (
    "air_damping.linear@z", "air_damping.quadratic@z", "friction.coulomb@z", "coil_gain@coil:1"
)  # fmt: skip
LEFT = 10.0


def tried(identity: str, gain: float, chance: float = 100.0, held: bool = True) -> Tried:
    effect = NAMED[identity]
    return Tried(effect, effect.grid[0], gain, np.ones(1), (1.0,), chance, held)


def named(found: Grown) -> list[str]:
    return [p.effect.identity for p in found.point.placed]


def found(*rounds: Round) -> Grown:
    placed = [Placed(r.taken.effect, (), (1.0,)) for r in rounds if r.taken is not None]
    return Grown(Point(tuple(placed)), HeldError(1.0 + LEFT, 1.0), rounds)  # type: ignore[arg-type]


def round_of(taken: Tried | None, *others: Tried) -> Round:
    survivors = others if taken is None else (taken, *others)
    return Round(1e6, 1e5, survivors, survivors, (), taken, others)


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Return the names that each way begins with; what a way leaves is told by `leaves`."""
    seen: list[list[str]] = []

    def grown(so_far: Grown, effects: object, most: int, *_: object) -> Grown:
        seen.append(named(so_far))
        return so_far

    monkeypatch.setattr(candidate_swap, "grown", grown)
    monkeypatch.setattr(candidate_swap, "refine", lambda point, *_, **__: (point, 1e3))
    monkeypatch.setattr(candidate_swap, "asked_again", lambda _, rival, *__: rival)
    return seen


def leaves(**left: float) -> Any:
    """Return records of which an effect of such a name leaves so much beyond noise."""

    def held_error(point: Point) -> HeldError:
        classes = [p.effect.identity.partition("@")[0].replace(".", "_") for p in point.placed]
        return HeldError(1.0 + min((left.get(c, LEFT) for c in classes), default=LEFT), 1.0)

    return SimpleNamespace(held_error=held_error)


def told(*_: object) -> None:
    """Say nothing."""


def test_a_rival_takes_the_place_of_what_was_taken_if_it_leaves_less_than_half(
    begun: list[list[str]],
) -> None:
    so_far = found(
        round_of(tried(GAIN, 9e5)),
        round_of(tried(DAMPING, 5e5), tried(DRAG, 4.5e5)),
        round_of(None, tried(COULOMB, 4e3)),
    )
    way = candidate_swap.otherwise(so_far, (), 4, leaves(air_damping_quadratic=0.1), told)
    assert begun == [[GAIN, DRAG]]
    assert named(way) == [GAIN, DRAG]
    # The rounds tell it as if it had been taken then.
    assert [r.taken and r.taken.effect.identity for r in way.rounds] == [GAIN, DRAG]
    assert not way.rounds[1].alternatives
    assert way.rounds[1].instead_of is NAMED[DAMPING]
    same = candidate_swap.otherwise(so_far, (), 4, leaves(air_damping_quadratic=0.6 * LEFT), told)
    assert same is so_far


def test_of_several_ways_the_one_that_leaves_least_is_gone(begun: list[list[str]]) -> None:
    so_far = found(round_of(tried(DAMPING, 5e5), tried(DRAG, 4.8e5), tried(COULOMB, 4.6e5)))
    way = candidate_swap.otherwise(
        so_far, (), 4, leaves(air_damping_quadratic=4.0, friction_coulomb=2.0), told
    )
    assert begun == [[DRAG], [COULOMB]]
    assert named(way) == [COULOMB]
    # Where little is left no other is tried.
    del begun[:]
    way = candidate_swap.otherwise(so_far, (), 4, leaves(air_damping_quadratic=0.5), told)
    assert (begun, named(way)) == ([[DRAG]], [DRAG])


@pytest.mark.parametrize(
    "rival",
    [
        tried(DRAG, 3.9e5),  # beaten clearly
        tried(DRAG, 4.9e5, chance=5.0),  # others do not agree
        tried(DRAG, 4.9e5, chance=15.0, held=False),
    ],
)
def test_who_was_beaten_clearly_or_contradicted_is_not_tried(
    rival: Tried, begun: list[list[str]]
) -> None:
    so_far = found(round_of(tried(DAMPING, 5e5), rival))
    assert (
        candidate_swap.otherwise(so_far, (), 4, leaves(air_damping_quadratic=0.1), told) is so_far
    )
    assert not begun


def test_what_is_there_or_was_given_up_has_no_rival(begun: list[list[str]]) -> None:
    there = found(round_of(tried(DAMPING, 5e5), tried(DRAG, 4.9e5)), round_of(tried(DRAG, 1e5)))
    assert candidate_swap.otherwise(there, (), 4, leaves(), told) is there
    given_up = there._replace(point=replace(there.point, placed=there.point.placed[1:]))
    assert candidate_swap.otherwise(given_up, (), 4, leaves(), told) is given_up
    assert not begun


def test_three_ways_are_tried_and_one_that_fits_nowhere_is_none(
    begun: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    rivals = [tried(f"coil_gain@coil:{n}", 4.9e5 - n) for n in range(2, 7)]
    so_far = found(round_of(tried(GAIN, 5e5), *rivals))
    assert candidate_swap.otherwise(so_far, (), 4, leaves(), told) is so_far
    assert begun == [[f"coil_gain@coil:{n}"] for n in (2, 3, 4)]
    del begun[:]

    def runs_away(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError

    # What fails on the way takes nothing of what was found.
    for fails in ("grown", "refine"):
        monkeypatch.setattr(candidate_swap, fails, runs_away)
        assert candidate_swap.otherwise(so_far, (), 4, leaves(), told) is so_far
    assert not begun


def test_progress_goes_back_on_no_way(
    begun: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def grown(so_far: Grown, _: object, most: int, *rest: Any) -> Grown:
        rest[-1]("screening", 0.15)
        return so_far

    monkeypatch.setattr(candidate_swap, "grown", grown)
    seen: list[float] = []
    so_far = found(round_of(tried(GAIN, 5e5), tried(DRAG, 4.9e5)))
    candidate_swap.otherwise(so_far, (), 4, leaves(), lambda _, done: seen.append(done))
    assert len(seen) == 2
    assert seen == sorted(seen)
