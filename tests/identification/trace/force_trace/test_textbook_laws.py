"""Test laws that are held to their textbook form: which numbers are free, and how well known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.trace.force_balance.force_record import ForceModel
from levid.identification.trace.force_balance.free_numbers import (
    by_value,
    moved_by,
    numbers,
    room,
    way,
)
from levid.identification.trace.records.record_from_log import imported_places
from levid.model.effects.base import Effect, Placed, resolved
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

CONFIG = parse_text(
    """
levid: model
name: arm
dof: [{name: q, unit: rad}]
inputs: [{name: u, unit: N m}]
parameters:
  m: {value: 2.0, unit: kg m2, min: 0.1, max: 10}
M: [[m]]
D: [[1.0]]
K: [[1.0]]
""",
    ModelConfig,
    "arm",
)


def law(key: str) -> Effect:
    (effect,) = (e for e in all_effects(imported_places(CONFIG)) if e.key == key)
    return effect


LAG = Placed(law("actuator_lag"), (0.02,), (0.03,))
SECOND = Placed(law("actuator_lag.second_order"), (3.0 * 0.9, 0.7 / 0.9), (0.81,))


def test_textbook_form_of_a_lag_has_one_number_and_of_second_order_a_depth_of_one() -> None:
    lag, second = LAG.as_textbook(), SECOND.as_textbook()
    assert lag is not None
    assert second is not None
    assert lag.plain
    assert lag.values == (0.03, 0.03)
    assert second.values == pytest.approx((1.0, 3.0, 0.7))
    assert lag.freedom.tolist() == [[1.0], [1.0]]
    assert second.freedom.tolist() == [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    assert LAG.freedom.tolist() == np.eye(2).tolist()
    # An actuator that is earlier than declared, and a law without such a form.
    assert replace(LAG, amplitudes=(-0.001,)).as_textbook() is None
    assert Placed(law("damping.quadratic"), (), (1.0,)).as_textbook() is None


def test_a_saturation_ends_with_a_hard_corner() -> None:
    soft = Placed(law("saturation"), (0.3, 40.0), (0.9,))
    hard = soft.at_its_end()
    assert hard is not None
    assert hard.values == (0.9, 0.3, soft.effect.shape[1].high)
    assert hard.freedom.tolist() == [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]
    assert LAG.at_its_end() is None


def test_a_step_changes_what_is_free_and_keeps_the_form() -> None:
    lag, second = LAG.as_textbook(), SECOND.as_textbook()
    assert lag is not None
    assert second is not None
    point = ForceModel(declared_model(CONFIG), free_parameters(CONFIG), (lag, second))
    assert numbers(point) == pytest.approx([2.0, 0.03, 3.0, 0.7])
    step = np.array([0.1, 0.01, -0.5, 0.1])
    moved = moved_by(point, step)
    assert moved.placed[0].values == pytest.approx((0.04, 0.04))
    assert moved.placed[1].values == pytest.approx((1.0, 2.5, 0.8))
    assert moved.values == pytest.approx([2.2])  # in its scale
    assert way(point, moved) == pytest.approx(step)
    low, high = room(point)
    assert len(low) == len(high) == 4
    # The lag is bounded by both of its numbers: at most twice its duration, at least half of it.
    assert (low[1], high[1]) == pytest.approx((-0.015, 0.03))


def test_errors_of_free_numbers_are_told_for_all_values() -> None:
    lag, second = LAG.as_textbook(), SECOND.as_textbook()
    assert lag is not None
    assert second is not None
    assert by_value(lag, np.array([0.1]), np.inf).tolist() == [0.1, 0.1]
    assert by_value(second, np.array([0.1, 0.2]), np.inf).tolist() == [np.inf, 0.1, 0.2]


def test_a_filter_of_commands_may_be_faster_than_what_records_resolve() -> None:
    places = imported_places(CONFIG)
    fastest_hz = 4.0
    extent = Extent(reach=(1.0,), speed=(1.0,), gap=1.0, command=1.0, beam_m=0.0,
                    spans_s=((0.0, 100.0),), fastest_hz=fastest_hz)  # fmt: skip
    bounded = {e.key: e for e in resolved(all_effects(places, extent), fastest_hz)}
    assert bounded["actuator_lag.second_order"].shape[0].high > 5.0 * fastest_hz
    assert bounded["flexible_mode.loose_mass"].shape[0].high <= fastest_hz
