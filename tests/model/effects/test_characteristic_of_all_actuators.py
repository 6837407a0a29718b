"""Test the square that all actuators have in common, as twin propellers, fans or pumps have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from levid.docs.make_effects_table import one_dof, two_dof
from levid.model.effects.base import Effect, Places, Signals, total
from levid.model.effects.candidate_effects import all_effects

TS_S, ROWS = 2e-3, 400


def signals(lag_s: float) -> Signals:
    rng = np.random.default_rng(3)
    q, qd, qdd, u = rng.standard_normal((4, ROWS, 2))
    none = np.zeros(ROWS)
    others = (none,) * 6
    t = TS_S * np.arange(ROWS)
    return Signals(TS_S, t, q, qd, qdd, u, *others, 0, two_dof(), lag_s)


def squares(places: Places, key: str) -> list[Effect]:
    return [e for e in all_effects(places) if e.key == key]


@pytest.mark.parametrize("lag_s", [0.0, 0.03])
@pytest.mark.parametrize("key", ["actuator.squared", "actuator.squared_after_lag"])
def test_it_is_the_sum_of_those_of_each(key: str, lag_s: float) -> None:
    found = squares(two_dof(), key)
    (common,) = (e for e in found if len(e.where) == 2)
    single = [e for e in found if len(e.where) == 1]
    assert len(single) == 2
    assert common.title.endswith(", same for all actuators")
    s = signals(lag_s)
    (term,) = common.build(s, ())
    each = total([one for e in single for one in e.build(s, ())])
    assert term.held is not None
    np.testing.assert_allclose(term.held, each.held, rtol=1e-12)


@pytest.mark.parametrize("key", ["actuator.squared", "actuator.squared_after_lag"])
def test_one_actuator_or_commands_of_two_units_have_none_in_common(key: str) -> None:
    mixed = replace(two_dof(), input_units=("N", "m"))
    for places in (one_dof("m", "N"), mixed):
        assert all(len(e.where) == 1 for e in squares(places, key))
