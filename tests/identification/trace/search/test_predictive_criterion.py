"""Test the criterion by which effects are taken: agreement of data that did not fit, and size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_test_helpers import rig_places

from levid.identification.trace.search.predictive_criterion import (
    Criterion,
    certainty,
    confirmed,
    helps,
    is_worse,
)
from levid.identification.trace.search.tested_candidate import Agreement, HeldError, Tried
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.freeform import freeform_effects
from levid.model.effects.operating_range import Extent

OPTIONS = SearchOptions()
NAMED = {e.identity: e for e in all_effects(rig_places())}
SURELY = Agreement(50.0, 50.0, 50.0, True)


def tried(identity: str, gain: float, agreement: Agreement = SURELY) -> Tried:
    effect = NAMED[identity]
    return Tried(effect, effect.grid[0], gain, np.ones(3), (1.0,), agreement)


@pytest.mark.parametrize(
    ("between", "expected", "held", "taken", "statistic"),
    [
        (25.0, 2.0, -1.0, True, 25.0),  # held-out records cannot tell
        (25.0, 2.0, -4.0, False, 25.0),  # they do very little of it, but contradict that surely
        (5.0, 2.0, 2.0, False, 5.0),
        (25.0, 20.0, 19.0, True, 19.0),
        (25.0, 20.0, 11.0, True, 11.0),  # more than half of it is there: errors become smaller
        (25.0, 20.0, 9.0, False, 9.0),
        (5.0, 20.0, 19.0, False, 19.0),  # the blocks that chose it do not agree with each other
    ],
)
def test_held_out_records_are_asked_for_what_they_should_show(
    between: float, expected: float, held: float, taken: bool, statistic: float
) -> None:
    agreement = Agreement(between, expected, held, asked=expected > OPTIONS.agreement)
    assert confirmed(agreement, OPTIONS) is taken
    assert certainty(agreement) == statistic


@pytest.mark.parametrize(
    ("identity", "taken"),
    [
        ("rod_stiffness.cubic@psi", False),
        # Another law of friction may be the right one; that is decided elsewhere.
        ("friction.dahl@psi", True),
        ("rod_stiffness.cubic@z", True),
        ("coil_gain@coil:7", True),
        ("flexible_mode.saddle@", True),  # without a single location
    ],
)
def test_small_residual_of_friction_gives_no_further_effect_at_its_dof(
    identity: str, taken: bool
) -> None:
    """For example, eight slip elements instead of twenty leave 1/500 of the friction's share."""
    criterion = Criterion(OPTIONS, 2e5, 1e8, rubbed={"psi": 1e8})
    one = tried(identity, 2e5)
    assert criterion.takes(one) is taken
    assert criterion.takes(replace(one, gain=3e5))


def test_free_form_must_take_more_than_a_name() -> None:
    form = freeform_effects(rig_places(), Extent.typical(rig_places()))[0]
    criterion = Criterion(OPTIONS, 1e6, 0.0)
    name = tried("coil_gain@coil:7", 1.5e5, Agreement(50.0, 1.0, 1.0, False))
    assert criterion.takes(name)
    assert not criterion.takes(replace(name, effect=form))
    assert criterion.takes(replace(name, effect=form, gain=2.5e5))


def test_free_run_error_tells_whether_what_it_shows_matters() -> None:
    """The weight of a beam takes 2 % of the prediction errors that a sticking sensor leaves."""
    one = tried("beam_motion.gravity@theta", 2e4)
    assert Criterion(OPTIONS, 1e6, 0.0).takes(one)
    silent = replace(one, agreement=replace(SURELY, asked=False))
    assert not Criterion(OPTIONS, 1e6, 0.0).takes(silent)
    # Where the free run is explained there is nothing to take of it.
    assert not Criterion(OPTIONS, 1e6, 0.0, visible=1e4).takes(one)


def test_what_chance_gives_and_what_others_leave_is_too_little() -> None:
    assert not Criterion(OPTIONS, 10.0, 0.0).takes(
        tried("coil_gain@coil:7", 0.9 * OPTIONS.least_squares)
    )
    assert Criterion(OPTIONS, 10.0, 0.0).takes(
        tried("coil_gain@coil:7", 1.1 * OPTIONS.least_squares)
    )
    # An equation that is right to a hundredth leaves 1e-4 of the squares that it took.
    assert not Criterion(OPTIONS, 10.0, 1e7).takes(tried("coil_gain@coil:7", 9e2))


def test_shape_that_is_a_first_guess_need_not_take_as_much() -> None:
    criterion = Criterion(OPTIONS, 1e6, 0.0)
    enough = criterion.worth(tried("dead_zone@coil:7", 0.0))
    assert criterion.may_take(tried("dead_zone@coil:7", 0.6 * enough))
    assert not criterion.may_take(tried("dead_zone@coil:7", 0.4 * enough))
    assert not criterion.may_take(tried("coil_gain@coil:7", 0.6 * enough))


@pytest.mark.parametrize(
    ("asked", "explained", "gain", "after", "helped"),
    [
        (True, False, 0.05, 5.0, True),
        (True, False, 0.05, 9.5, False),  # it takes less than a tenth of what noise leaves
        (True, False, 0.5, 9.5, True),  # so it does in free run only, which a larger one may cause
        (True, False, 0.5, 9.95, False),  # it foretells nothing
        (True, True, 0.05, 9.5, True),  # there is nothing left to take
        (False, False, 0.05, 10.1, True),  # it does nothing there
        (False, False, 0.05, 20.0, False),
    ],
)
def test_held_out_records_must_have_smaller_errors_in_free_run(
    asked: bool, explained: bool, gain: float, after: float, helped: bool
) -> None:
    criterion = Criterion(OPTIONS, 1e5, 0.0)
    one = tried("coil_gain@coil:7", gain * criterion.excess, replace(SURELY, asked=asked))
    scatter = np.array([0.1, -0.2, 0.3, -0.1, -0.2, 0.1])
    errors = [HeldError(10.0, 1.0, np.full(6, 10.0)), HeldError(after, 1.0, after + scatter)]
    assert helps(one, *errors, explained, criterion) is helped
    drives = replace(one, effect=NAMED["cogging@beam"])  # it does not move the platform
    assert helps(drives, *errors, explained, criterion) is (after < 15.0)


@pytest.mark.parametrize(
    ("rise", "worse"),
    [
        ([-1.0, -2.0, -1.0, -2.0, -1.0, -2.0], False),
        ([0.0] * 6, False),  # it does nothing there
        ([1.0, -1.0, 2.0, -1.0, 1.0, 0.0], False),  # it costs one block and helps another
        ([1.0, 2.0, 1.0, 2.0, 1.0, 2.0], True),
        ([np.inf] * 6, True),  # the simulation diverges with it
    ],
)
def test_free_run_error_that_surely_rises_is_worse(rise: list[float], worse: bool) -> None:
    before = np.array([3.0, 9.0, 4.0, 5.0, 8.0, 3.0])
    after = before + rise
    errors = [HeldError(float(np.mean(one)), 1.0, one) for one in (before, after)]
    with np.errstate(invalid="ignore"):
        assert is_worse(errors[1], errors[0], OPTIONS) is worse
