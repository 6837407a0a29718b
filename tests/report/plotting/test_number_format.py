"""Test number formats: values end with the digits that their intervals support."""

from __future__ import annotations

import math

import pytest

from levid.config.model import EffectParameter
from levid.identification.value_with_interval import interval_decimals
from levid.report.plotting.number_format import (
    amount,
    change_text,
    half_percent,
    interval,
    place_text,
    plain,
    signal_text,
    to_interval,
    unit_text,
    with_interval,
)


@pytest.mark.parametrize(
    ("half", "digits", "places"),
    [(0.0123, 2, 3), (0.0123, 1, 2), (0.0996, 2, 2), (0.996, 1, 0), (104.0, 2, -1), (5.0, 2, 1)],
)
def test_decimals_end_at_a_digit_of_the_rounded_interval(half, digits, places):
    assert interval_decimals(half, digits) == places


@pytest.mark.parametrize(
    ("value", "half", "text"),
    [
        (2.99993, 0.0123, "3.000"),
        (68250.3, 104.0, "68250"),
        (-6244.5, 104.0, "−6240"),
        (0.5, 0.2, "0.50"),
        (1.5e-7, 3e-9, "1.500·10⁻⁷"),
        (3.0032e8, 1.1e6, "3.003·10⁸"),
        (1e-9, 2e-2, "0.000"),
        (12.3456789, 0.0, "12.3457"),
        (12.3456789, math.inf, "12.3457"),
        (math.nan, 1.0, "nan"),
    ],
)
def test_value_ends_at_the_second_digit_of_its_interval(value, half, text):
    assert to_interval(value, half) == text


def test_interval_of_a_mode():
    assert interval(5.0123, 0.01) == "5.012 ± 0.020"
    assert interval(5.0123, math.nan) == "5.012"


def test_half_interval_in_percent():
    assert half_percent(-2.0, 0.1) == "9.8 %"
    assert half_percent(0.0, 0.1) == half_percent(1.0, None) == "—"
    assert half_percent(0.02, 0.3) == "not told from 0"


@pytest.mark.parametrize(
    ("value", "se", "unit", "text"),
    [
        (3.0032e8, 5.6e5, "N/m^3", "(3.003 ± 0.011)·10⁸ N/m³"),
        (-0.020001, 7.7e-6, "1", "−0.020001 ± 0.000015"),
        (1.0017e-3, 3.7e-7, "N m", "(1.00170 ± 0.00073)·10⁻³ N m"),
        (-6244.5, 53.0, "V/V^2", "(−6240 ± 100) V/V²"),
        (0.0, 1.0, "N", "(0.0 ± 2.0) N"),
        (2.5, None, "s", "2.5 s"),
        (1.5e-7, None, "1", "1.5·10⁻⁷"),
    ],
)
def test_value_has_as_many_digits_as_its_interval(
    value: float, se: float | None, unit: str, text: str
) -> None:
    assert with_interval(EffectParameter(value=value, unit=unit, se=se)) == text


def test_units_names_and_sizes() -> None:
    assert unit_text("N m/rad^3") == "N m/rad³"
    assert unit_text("1") == ""
    assert signal_text("theta'") == "θ′"
    assert signal_text("psi''") == "ψ″"
    assert signal_text("x_b") == "x_b"
    assert place_text("force on theta", ("psi", "theta")) == "force on θ"
    assert place_text("force of coil 3", ("psi", "theta")) == "force of coil 3"
    assert amount(1.36e-6, "m") == "1.36 µm"
    assert amount(4.2e-3, "N m") == "4.2 mN m"
    assert amount(-2.5e5, "N/m^3") == "−2.5·10⁵ N/m³"
    assert amount(float("nan"), "m") == "—"
    assert change_text(2.0, 0.5) == "−75.0 %"
    assert change_text(2.0, 2.0) == "0 %"
    assert plain(-8.20715e-7) == "−8.20715·10⁻⁷"
