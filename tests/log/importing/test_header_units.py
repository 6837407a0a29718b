"""Test names and units in headers, and the comparison with the units of a SIGNALS.yaml."""

from __future__ import annotations

import math

import pytest

from levid.config.units import known_unit
from levid.log.importing.header_units import header_cell, unit_slip


@pytest.mark.parametrize(
    ("text", "name", "unit"),
    [
        ("Position [mm]", "Position", "mm"),
        ("Current (A)", "Current", "A"),
        ("time/s", "time", "s"),
        ("a / m/s^2", "a", "m/s^2"),
        ("position_mm", "position", "mm"),
        ("t_s", "t", "s"),
        ("x_s", "x_s", ""),  # the position of a stage, say
        ("i_a", "i_a", ""),  # the current of an armature
        ("y_min", "y_min", ""),
        ("u/u0", "u/u0", ""),
        ("V1", "V1", ""),
        ("Phase (deg)", "Phase", "deg"),
        ("[mm]", "[mm]", "mm"),
        ("Pos (counts)", "Pos", "counts"),
        ("control[0]", "control[0]", ""),
    ],
)
def test_header_is_split_into_name_and_unit(text, name, unit):
    cell = header_cell(text)
    assert (cell.text, cell.name, cell.unit) == (text, name, unit)


@pytest.mark.parametrize(
    ("text", "factor", "si"),
    [
        ("mm", 1e-3, "m"),
        ("µm", 1e-6, "m"),
        ("ms", 1e-3, "s"),
        ("mm/s²", 1e-3, "m/s2"),
        ("m/s^2", 1.0, "m/s2"),
        ("°", math.pi / 180, "rad"),
        ("rpm", math.pi / 30, "rad/s"),
        ("N m", 1.0, "N m"),
        ("mNm", 1e-3, "N m"),
        ("kHz", 1e3, "1/s"),
        ("%", 0.01, "1"),
        ("1", 1.0, "1"),
    ],
)
def test_known_unit_has_a_factor_to_si(text, factor, si):
    found = known_unit(text)
    assert found.factor == pytest.approx(factor, rel=1e-12)
    assert found.si == si


@pytest.mark.parametrize("text", ["g", "counts", "°C", "", "m/", "mm..", "a/b"])
def test_unknown_unit_has_none(text):
    assert known_unit(text) is None


@pytest.mark.parametrize(
    ("header", "unit", "scale"),
    [
        ("mm", "m", 1e-3),
        ("mm", "m", -1e-3),
        ("mm", "mm", 1.0),
        ("rpm", "rad/s", 0.10472),
        ("A", "N", 12.5),  # a force constant
        ("counts", "m", 1.0),
        ("Nm", "N m", 1.0),
    ],
)
def test_consistent_units_are_no_slip(header, unit, scale):
    assert unit_slip(header, unit, scale) is None


def test_slip_of_a_unit_is_described_with_the_expected_scale():
    assert unit_slip("mm", "m", 1.0) == (
        "the header says mm, but unit is m with scale 1; expected scale: 0.001, or unit: mm"
    )
    assert "expected unit: A, or the scale from A to N" in unit_slip("A", "N", 1.0)


def test_small_letters_of_the_unit_are_no_other_unit() -> None:
    assert unit_slip("nm", "N m", 1.0) is None
    assert unit_slip("nm", "m", 1.0) is not None
