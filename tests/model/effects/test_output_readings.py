"""Test effects of the sensors of imported plants: the position is a function of the reading."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from effect_test_helpers import rig_places

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.trace.records.record_from_log import imported_places
from levid.model.effects.base import Effect, Placed, Places, Signals
from levid.model.effects.candidate_effects import all_effects

MODEL = """
levid: model
name: stage
dof: [{name: x, unit: m}, {name: turn, unit: rad}]
inputs: [{name: f, unit: N}, {name: t, unit: N m}]
M: [[1.0, 0.0], [0.0, 1.0]]
D: [[1.0, 0.0], [0.0, 1.0]]
K: [[1.0, 0.0], [0.0, 1.0]]
"""
TS, ROWS = 1e-3, 4000
NUMBERS = {
    "reading.gain": ((0.04,), ()),
    "reading.quadratic": ((-0.7,), ()),
    "reading.cubic": ((1.3,), ()),
    "reading.rational": ((-0.7,), (1.2,)),
    "reading.lag": ((0.02,), ()),
    "reading.delay": ((0.004,), (0.004,)),
    "reading.crosstalk": ((0.1,), ()),
    "reading.periodic": ((3e-3, -2e-3), (0.1,)),
    "reading.eccentric": ((0.02, -0.01), ()),  # of the angle
}


def places() -> Places:
    return imported_places(parse_text(MODEL, ModelConfig, "stage"))


def table() -> dict[str, Effect]:
    every = all_effects(places())
    return {e.key: e for e in every if e.where[0] == "x" or e.key == "reading.eccentric"}


def motion(around_rows: bool) -> Signals:
    """Return a smooth motion of some tenths, below 5 Hz."""
    t = np.arange(ROWS) * TS
    first = np.stack([np.cos(9 * t) + 0.3 * np.cos(31 * t), np.sin(14 * t)], axis=1)
    rate = np.stack([-9 * np.sin(9 * t) - 9.3 * np.sin(31 * t), 14 * np.cos(14 * t)], axis=1)
    none = tuple(np.zeros(ROWS) for _ in range(6))
    q, qd, still = 0.2 * first, 0.2 * rate, np.zeros((ROWS, 2))
    return Signals(TS, t, q, qd, still, still, *none, 0, places(), around_rows=around_rows)


@pytest.mark.parametrize("key", NUMBERS)
def test_reading_of_a_motion_is_the_inverse_of_the_position_of_a_reading(key: str) -> None:
    placed = Placed(table()[key], NUMBERS[key][1], NUMBERS[key][0])
    measured = motion(around_rows=True)
    position = measured.q - placed.term(measured).gap
    there = replace(measured, q=position, around_rows=False)
    reading = position + placed.term(there).gap
    # A lag forgets its begin; the splines of a delay end at the record's ends.
    rows = slice(300, -300)
    atol = 1e-6 * np.ptp(measured.q)
    np.testing.assert_allclose(reading[rows], measured.q[rows], atol=atol)
    assert np.abs(position[rows] - measured.q[rows]).max() > 1e-3 * np.ptp(measured.q)


@pytest.mark.parametrize(
    ("bend", "far", "reading"),
    [
        # r = h + b h^2 has a = -b and c = 2 b up to the fourth power.
        (0.4, 0.8, lambda h: h + 0.4 * h * h),
        (-0.4, -0.8, lambda h: h - 0.4 * h * h),
        # r = h / (1 + h / d), a sensor of a gap, exactly.
        (-1.0, -1.0, lambda h: h / (1.0 + h)),
    ],
)
def test_a_rational_reading_is_a_quadratic_of_the_position_or_1_over_a_gap(
    bend: float, far: float, reading: Callable[[np.ndarray], np.ndarray]
) -> None:
    true = motion(around_rows=True)
    measured = replace(true, q=reading(true.q))
    placed = Placed(table()["reading.rational"], (far,), (-bend,))
    left = measured.q - placed.term(measured).gap - true.q
    bent = measured.q - true.q
    assert np.abs(left[:, 0]).max() < 0.02 * np.abs(bent[:, 0]).max()


@pytest.mark.parametrize(
    ("key", "unit"),
    [
        ("reading.quadratic", "1/m"),
        ("reading.cubic", "1/m^2"),
        ("reading.rational", "1/m"),
        ("reading.lag", "s"),
        ("reading.crosstalk", "m/rad"),
    ],
)
def test_numbers_have_the_units_of_the_output(key: str, unit: str) -> None:
    assert table()[key].amplitudes[0].unit == unit


def test_a_part_of_another_command_has_the_ratio_of_their_units() -> None:
    crosstalk = {e.where: e for e in all_effects(places()) if e.key == "actuator.crosstalk"}
    assert set(crosstalk) == {("f", "t"), ("t", "f")}
    assert crosstalk["f", "t"].amplitudes[0].unit == "N/(N m)"
    s = replace(motion(around_rows=True), coil=np.array([[1.0, 2.0]] * ROWS))
    (term,) = crosstalk["f", "t"].build(s, ())
    np.testing.assert_array_equal(term.held, np.array([[2.0, 0.0]] * ROWS))


def test_the_rig_has_sensors_of_its_own() -> None:
    keys = [e.key for e in all_effects(rig_places())]
    assert not [k for k in keys if k.startswith("reading.") or k == "actuator.crosstalk"]
