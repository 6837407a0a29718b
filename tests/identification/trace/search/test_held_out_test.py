"""Test the agreement of held-out records with an effect: smaller errors, or no effect in them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from effect_test_helpers import rig_places

from levid.identification.trace.search import forward_selection
from levid.identification.trace.search.candidate_screening import HeldError, Round, Tried
from levid.identification.trace.search.held_out_test import helps
from levid.model.effects.candidate_effects import all_effects

NAMED = {e.identity: e for e in all_effects(rig_places())}
FLOOR = 1.75
GAIN = 1e5


def tried(identity: str, held: bool) -> Tried:
    effect = NAMED[identity]
    return Tried(effect, effect.grid[0], GAIN, None, (1.0,), 100.0, held)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("identity", "held", "before", "after", "gone", "explained", "agree"),
    [
        # Records with the effect must have smaller errors.
        ("dead_zone@coil:7", True, 36.0, 20.0, 0.9, False, True),
        ("dead_zone@coil:7", True, 36.0, 36.7, 0.99, False, False),
        ("dead_zone@coil:7", True, 36.0, 35.95, 0.9, False, False),
        # Records without the effect may get slightly worse if others improve much.
        ("dead_zone@coil:7", False, 36.0, 36.7, 0.99, False, True),
        ("dead_zone@coil:7", False, 36.0, 39.7, 0.58, False, False),
        ("dead_zone@coil:7", False, 36.0, 36.7, 0.05, False, False),
        # At the noise floor there is nothing to gain; an absent effect must cost almost nothing.
        ("dead_zone@coil:7", False, FLOOR, FLOOR * 1.001, 0.99, True, True),
        ("dead_zone@coil:7", False, FLOOR, FLOOR * 1.1, 0.99, True, False),
        # What the simulation cannot show, the errors one step ahead have confirmed.
        ("dead_zone@coil:7", True, FLOOR, FLOOR * 1.001, 0.99, True, True),
        ("dead_zone@coil:7", True, FLOOR, FLOOR * 1.1, 0.99, True, False),
        # Effects on the drives alone do not move the platform.
        ("cogging@beam", True, FLOOR, FLOOR * 1.001, 0.5, True, True),
        ("cogging@beam", True, FLOOR, FLOOR * 1.1, 0.5, True, False),
    ],
)
def test_held_out_records_accept_or_reject_an_effect(
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
    ("explained", "excess", "expected_screenings"),
    [
        (False, -4e3, ["all"]),
        (True, -4e3, ["drives"]),
        # 2 % of what noise leaves are 1e4.
        (True, 2e4, ["drives", "all"]),
        (True, 7e6, ["drives", "all"]),
    ],
)
def test_all_candidates_are_screened_if_only_fitted_records_have_a_residual(
    explained: bool, excess: float, expected_screenings: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    candidates = [
        (NAMED[name], NAMED[name].grid[0]) for name in ("dead_zone@coil:7", "cogging@beam")
    ]
    evidence = SimpleNamespace(excess=excess, count=SimpleNamespace(sum=lambda: 5e5))
    screenings: list[str] = []

    def train(_: object, some: list[Any]) -> None:
        screenings.append("all" if len(some) == 2 else "drives")

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
    screened_round, _ = forward_selection._screened(
        SimpleNamespace(placed=()),  # type: ignore[arg-type]
        candidates,
        HeldError(FLOOR, FLOOR),
        explained,
        (),
        SimpleNamespace(train=train),  # type: ignore[arg-type]
        lambda *_: None,
    )
    assert screenings == expected_screenings
    # Where the held-out simulation is explained, an effect has to take 2 % of what noise leaves.
    names = [(t.effect.effect_class, t.held) for t in screened_round.survivors]
    drives = [("cogging", True), ("cogging", False)]
    coil = [("dead_zone", True), ("dead_zone", False)]
    assert names == (coil + drives if expected_screenings[-1] == "all" else drives)
