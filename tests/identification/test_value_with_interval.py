"""Test values with intervals: both have the same digits."""

import pytest

from levid.identification.subspace.response_uncertainty import SURE_95
from levid.identification.value_with_interval import value_with_interval


@pytest.mark.parametrize(
    ("value", "half", "text"),
    [
        (489.58, 103.0, "490 +- 100"),
        (2.99993, 0.0123, "3.000 +- 0.012"),
        (3.002e8, 3.2e6, "(3.002 +- 0.032)e8"),
        (-1.2e-5, 3e-7, "(-1.200 +- 0.030)e-5"),
        (0.0, 0.0025, "0.0000 +- 0.0025"),
        (12.0, 45.6, "12 +- 46"),
    ],
)
def test_digits_end_with_the_second_of_the_interval(value: float, half: float, text: str) -> None:
    assert value_with_interval(value, half / SURE_95) == text


@pytest.mark.parametrize("se", [None, 0.0, float("inf"), float("nan")])
def test_value_without_an_error_has_five_digits(se: float | None) -> None:
    assert value_with_interval(12.3456789, se) == "12.346"
