"""Test which of several fitted effects stays, and which are not told from it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from levid.identification.trace.search import effects_not_told_apart as module
from levid.identification.trace.search.effects_not_told_apart import Member, not_told_apart
from levid.identification.trace.search.tested_candidate import HeldError
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Placed, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

OPTIONS = SearchOptions()
BLOCKS = 60


def member(key: str, numbers: int, squares: Any, gain: float = 0.0, where: str = "z") -> Member:
    effect = SimpleNamespace(
        key=key, identity=key, amplitudes=(0,) * numbers, shape=(), where=(where,)
    )
    tried = SimpleNamespace(effect=effect, gain=gain)
    return Member(tried, SimpleNamespace(), np.asarray(squares))


def told(*members: Member) -> list[str]:
    return keys(not_told_apart(members, OPTIONS))


def keys(members: list[Member]) -> list[str]:
    return [m.tried.effect.key for m in members]


def squares(seed: int, worse: float, scatter: float) -> np.ndarray:
    """Return squared errors that are `worse` than 1000 in the mean, and scatter by blocks."""
    d = np.random.default_rng(seed).standard_normal(BLOCKS)
    return 1000.0 + worse + scatter * (d - d.mean()) / d.std()


def test_equal_effects_are_one_group_and_the_accepted_one_stays() -> None:
    flat = np.full(BLOCKS, 1000.0)
    found = not_told_apart(
        [member("a", 1, flat), member("b", 1, flat), member("c", 1, flat)], OPTIONS
    )
    assert keys(found) == ["a", "b", "c"]


def test_effect_that_is_worse_by_more_than_the_scatter_is_told_apart() -> None:
    best = member("a", 1, squares(1, 0.0, 0.0))
    # A sum over 60 blocks of scatter 10 has a standard error of 77; these differ by 180 and 300.
    assert told(best, member("b", 1, squares(2, 3.0, 10.0))) == ["a", "b"]
    assert told(best, member("b", 1, squares(2, 5.0, 10.0))) == ["a"]


def test_difference_within_the_accuracy_of_an_equation_tells_nothing() -> None:
    flat, other = np.full(BLOCKS, 1000.0), np.full(BLOCKS, 1000.1)
    assert told(member("a", 1, flat, 1e5), member("b", 1, other)) == ["a", "b"]
    assert told(member("a", 1, flat, 1e4), member("b", 1, other)) == ["a"]


def test_richer_effect_replaces_a_simpler_one_only_if_it_is_surely_better() -> None:
    simple = member("simple", 1, squares(3, 0.0, 0.0))
    # By two and by four standard errors.
    better = member("rich", 4, squares(4, -2 * 10 / np.sqrt(BLOCKS), 10.0), where="psi")
    surely = member("rich", 4, squares(4, -4 * 10 / np.sqrt(BLOCKS), 10.0))
    assert told(simple, better) == ["simple", "rich"]
    assert told(simple, surely) == ["rich"]
    # Little is not worth more numbers, however sure.
    little = member("rich", 4, squares(4, -0.3, 0.1))
    assert told(simple, little)[0] == "simple"


def test_simpler_effect_takes_the_place_of_the_accepted_one() -> None:
    flat = np.full(BLOCKS, 1000.0)
    rich = member("rich", 4, flat, where="psi")
    assert told(rich, member("simple", 1, flat)) == ["simple", "rich"]


def test_richer_law_at_the_same_place_is_no_equal_of_a_simpler_one() -> None:
    """A dead zone that is wider than all commands is a gain."""
    flat = np.full(BLOCKS, 1000.0)
    gain, zone, other = member("gain", 1, flat), member("zone", 2, flat), member("other", 1, flat)
    assert told(gain, zone, other) == ["gain", "other"]
    assert told(zone, gain) == ["gain"]


def places() -> Places:
    one = np.eye(1)
    nowhere = np.zeros((0, 2))
    return Places(
        ("z",), ("m",), one, one, "N", ("N",), "m", nowhere, nowhere, beam=False, input_names=("f",)
    )


def test_laws_that_an_effect_contains_are_rivals_with_its_numbers() -> None:
    """A Stribeck peak of 0 is Coulomb friction, wherever the fit of that one would have begun."""
    table = all_effects(places(), Extent.typical(places()))
    stribeck = next(e for e in table if e.key == "friction.stribeck")
    (simple,) = module._simpler(Placed(stribeck, (0.02, 0.1), (3e-3, 0.0)), table)
    assert simple.effect.key == "friction.coulomb"
    assert (simple.shape, simple.amplitudes) == (pytest.approx((2e-3,)), (3e-3,))


def test_all_laws_have_the_numbers_of_those_that_they_contain() -> None:
    table = all_effects(places(), Extent.typical(places()))
    contained = 0
    for effect in table:
        amplitudes = (1.0,) * len(effect.amplitudes)
        tried = module._simpler(Placed(effect, effect.grid[0], amplitudes), table)
        assert [len(t.shape) for t in tried] == [len(t.effect.shape) for t in tried]
        contained += len(tried)
    assert contained > 5


def test_equal_fits_share_the_resamples() -> None:
    flat = np.full(BLOCKS, 1000.0)
    assert module._shares([flat, flat], 200) == pytest.approx((0.5, 0.5))
    assert module._shares([flat, flat + 10.0], 200) == pytest.approx((1.0, 0.0))


def test_support_is_the_share_of_resamples_with_a_sure_gain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((4, BLOCKS))
    few = np.where(np.arange(BLOCKS) % 8 == 0, 400.0, 0.0) + noise[1]
    costs = {
        "strong": 50.0 + noise[0],
        "few": few,  # a coil that one record in eight excites
        "weak": 36.0 / BLOCKS + noise[2],  # as much as is asked of an effect
        "coloured": 100.0 * noise[3],  # of both signs: it is what is left, not the effect
    }
    monkeypatch.setattr(module, "removal_costs", lambda *_: list(costs.values()))
    placed = tuple(SimpleNamespace(effect=SimpleNamespace(identity=k)) for k in costs)
    found = module.supports(SimpleNamespace(placed=placed), SimpleNamespace(), OPTIONS)
    assert found["strong"] == 1.0
    assert found["few"] > 0.95
    assert found["weak"] < 0.5
    assert found["coloured"] < 0.1  # its sum is 1.2 deviations off: one resample in 30 is at three


@pytest.mark.parametrize(("rises", "first"), [(False, "simple"), (True, "rich")])
def test_simpler_effect_with_a_larger_free_run_error_takes_no_place(
    rises: bool, first: str
) -> None:
    """A scale of all coils fitted a step as well as one of all sensors, and no motion."""
    flat = np.full(BLOCKS, 1000.0)
    rich, simple = member("rich", 4, flat, where="psi"), member("simple", 1, flat)

    def held_error(point: object) -> HeldError:
        blocks = np.linspace(1.0, 1.1, 6) + (5.0 if rises and point is simple.point else 0.0)
        return HeldError(float(blocks.mean()), 1.0, blocks)

    records = SimpleNamespace(held_error=held_error)
    assert keys(module._equals([rich, simple], records, OPTIONS, 0.0))[0] == first  # type: ignore[arg-type]


def test_difference_that_is_little_of_what_is_left_tells_nothing() -> None:
    """A weight and a scale of all sensors, beside a sensor that sticks in a way no table has."""
    flat, other = np.full(BLOCKS, 1000.0), np.full(BLOCKS, 1100.0)
    members = [member("a", 1, flat, 1e4), member("b", 1, other)]
    assert keys(not_told_apart(members, OPTIONS)) == ["a"]
    assert keys(not_told_apart(members, OPTIONS, left=1e6)) == ["a", "b"]
