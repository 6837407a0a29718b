"""When held-out records agree with an effect: by their errors, or because they do not show it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from rig_effects import rig_places

from levid.identification.trace.search import forward_selection
from levid.identification.trace.search.candidate_screening import HeldError, Round, Tried
from levid.identification.trace.search.held_out_test import helps
from levid.model.effects.candidate_effects import all_effects

NAMED = {e.identity: e for e in all_effects(rig_places())}
FLOOR = 1.75


def tried(identity: str, held: bool) -> Tried:
    effect = NAMED[identity]
    return Tried(effect, effect.grid[0], 1e5, None, (1.0,), 100.0, held)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("identity", "held", "before", "after", "gone", "explained", "agree"),
    [
        # Who shows it has to gain by it.
        ("dead_zone@coil:7", True, 36.0, 20.0, 0.9, False, True),
        ("dead_zone@coil:7", True, 36.0, 36.7, 0.99, False, False),
        ("dead_zone@coil:7", True, 36.0, 35.95, 0.9, False, False),
        # Who does not may lose as little as others gain much.
        ("dead_zone@coil:7", False, 36.0, 36.7, 0.99, False, True),
        ("dead_zone@coil:7", False, 36.0, 39.7, 0.58, False, False),
        ("dead_zone@coil:7", False, 36.0, 36.7, 0.05, False, False),
        # At the floor there is nothing to gain; what does not show costs next to nothing.
        ("dead_zone@coil:7", False, FLOOR, FLOOR * 1.001, 0.99, True, True),
        ("dead_zone@coil:7", False, FLOOR, FLOOR * 1.1, 0.99, True, False),
        ("dead_zone@coil:7", True, FLOOR * 1.05, FLOOR, 0.99, True, False),
        # What the drives alone feel moves no platform.
        ("cogging@beam", True, FLOOR, FLOOR * 1.001, 0.5, True, True),
        ("cogging@beam", True, FLOOR, FLOOR * 1.1, 0.5, True, False),
    ],
)
def test_held_out_records_agree_or_are_not_asked(
    identity: str,
    held: bool,
    before: float,
    after: float,
    gone: float,
    explained: bool,
    agree: bool,
) -> None:
    errors = HeldError(before, FLOOR), HeldError(after, FLOOR)
    assert helps(tried(identity, held), *errors, gone, explained) is agree


@pytest.mark.parametrize(
    ("explained", "excess", "asked"),
    [(False, -4e3, ["all"]), (True, -4e3, ["drives"]), (True, 7e6, ["drives", "all"])],
)
def test_all_are_screened_where_others_show_what_held_out_records_do_not(
    explained: bool, excess: float, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    candidates = [
        (NAMED[name], NAMED[name].grid[0]) for name in ("dead_zone@coil:7", "cogging@beam")
    ]
    evidence = SimpleNamespace(excess=excess, count=SimpleNamespace(sum=lambda: 5e5))
    seen: list[str] = []

    def train(_: object, some: list[Any]) -> None:
        seen.append("all" if len(some) == 2 else "drives")

    monkeypatch.setattr(forward_selection, "gather", lambda *_: evidence)

    def screened(_: object, some: list[Any], *rest: Any) -> Round:
        least = rest[-1]
        survivors = [
            replace(tried("dead_zone@coil:7", held), effect=effect)
            for effect, _ in some
            for held in (True, False)
        ]
        survivors = [t for t in survivors if least.taken_by(t)]
        return Round(excess, 5e5, (), tuple(survivors), (), None, ())

    monkeypatch.setattr(forward_selection, "screened", screened)
    answered, _ = forward_selection._screened(
        SimpleNamespace(placed=()),  # type: ignore[arg-type]
        candidates,
        HeldError(FLOOR, FLOOR),
        explained,
        (),
        SimpleNamespace(train=train),  # type: ignore[arg-type]
        lambda *_: None,
    )
    assert seen == asked
    # What could be asked of records that are explained has nothing to explain there.
    names = [(t.effect.effect_class, t.held) for t in answered.survivors]
    drives = [("cogging", True), ("cogging", False)]
    coil = [("dead_zone", True)] * (not explained) + [("dead_zone", False)]
    assert names == (coil + drives if asked[-1] == "all" else drives)
