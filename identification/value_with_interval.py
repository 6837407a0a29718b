"""Write a value with its 95 % interval, both to the second digit of the interval; or a share."""

from __future__ import annotations

import math

_PLAIN = range(-3, 6)
"""Powers of ten of numbers that are written without one."""


PERCENT = 100.0
"""Of a whole."""


def percent(share: float, digits: int = 2) -> str:
    """Return a share in per cent, such as 3.2 %."""
    return f"{in_full(PERCENT * share, digits)} %"


def in_full(value: float, digits: int = 3) -> str:
    """Return a number rounded to some digits, without a power of ten: 770, not 7.7e+02."""
    return f"{float(f'{value:.{digits}g}'):g}"


def value_with_interval(value: float, se: float | None, plus_minus: str = "+-") -> str:
    """Return a value such as 3.0 +- 0.12 or (3.002 +- 0.032)e8; without an error, five digits."""
    from .subspace.response_uncertainty import SURE_95

    if se is None or not 0.0 < se < math.inf or not math.isfinite(value):
        return f"{value:.5g}"
    half = SURE_95 * se
    power = math.floor(math.log10(max(abs(value), half)))
    shift = 0 if power in _PLAIN else power
    value, half = value / 10.0**shift, half / 10.0**shift
    digits = interval_decimals(half)
    shown = (f"{round(v, digits):.{max(digits, 0)}f}" for v in (value, half))
    pair = f" {plus_minus} ".join(shown)
    return pair if shift == 0 else f"({pair})e{shift}"


def told_from_zero(value: float, se: float | None) -> bool:
    """Return whether 0 is outside the 95 % interval of a value; of one without an error it is."""
    from .subspace.response_uncertainty import SURE_95

    return se is None or not abs(value) <= SURE_95 * se


def interval_decimals(half: float, digits: int = 2) -> int:
    """Return the number of decimals up to digit `digits` of half a confidence interval.

    It is negative if that digit is left of the decimal point: -1 for tens. half: > 0.
    """
    return digits - 1 - exponent_of(half, digits)


def exponent_of(value: float, digits: int) -> int:
    """Return the power of ten of a value rounded to `digits` digits: 1 of 9.97 with two."""
    return int(f"{value:.{digits - 1}e}".partition("e")[2])
