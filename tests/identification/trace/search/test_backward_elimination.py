"""Test backward elimination: named effects that a free form makes redundant are removed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
from effect_test_helpers import rig_places

from levid.identification.trace.search import backward_elimination
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Placed
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.freeform import freeform_effects
from levid.model.effects.operating_range import Extent

OPTIONS = SearchOptions()
NAMED = {e.identity: e for e in all_effects(rig_places())}
FORM = freeform_effects(rig_places(), Extent.typical(rig_places()))[0]
WORTH = {"coil_gain@coil:1": 1e6, "coil_gain@coil:2": 0.0, "coil_gain@coil:3": 0.0}
"""Increase of the squared error without each effect; the plant has only the first."""


@dataclass(frozen=True)
class Point:
    placed: tuple[Placed, ...]


def squared_error(point: Point) -> float:
    there = {p.effect.identity for p in point.placed}
    return 1000.0 + sum(worth for name, worth in WORTH.items() if name not in there)


def refit(point: Point, _: object, within: float) -> tuple[Point, float]:
    """Stand in for a fit, which returns new objects for all effects."""
    return replace(point, placed=tuple(replace(p) for p in point.placed)), squared_error(point)


@pytest.mark.parametrize("order", [(1, 2, 3), (2, 1, 3), (3, 2, 1)])
def test_each_redundant_effect_is_removed(order, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backward_elimination, "refine", refit)
    monkeypatch.setattr(
        backward_elimination,
        "gather",
        lambda point, _: SimpleNamespace(squares=squared_error(point), excess=10.0),
    )
    names = [f"coil_gain@coil:{i}" for i in order]
    effects = [*(NAMED[name] for name in names), FORM]
    point = Point(tuple(Placed(e, (), (1.0,) * len(e.amplitudes)) for e in effects))
    reduced = backward_elimination.without_guesses(
        point, SimpleNamespace(train=lambda _: ()), OPTIONS
    )
    assert [p.effect.identity for p in reduced.placed] == ["coil_gain@coil:1", FORM.identity]
