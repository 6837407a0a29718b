"""Print values in readable units, with the digits that their noise supports."""

from __future__ import annotations

import math
from dataclasses import dataclass

_PREFIXES = ((1.0, ""), (1e3, "m"), (1e6, "u"))
_LEAST_LIMIT = 10.0
"""The first prefix is used with which the limit is at least this: 850 um, 100 mm, 20 N."""
_MOST_DECIMALS = 4
_PARTS_OF_LIMIT = 1e4
"""Resolution without any noise, as a part of the limit."""
_HOUR_S, _MINUTE_S = 3600, 60


@dataclass(frozen=True)
class Scale:
    """Convert values of a quantity to a readable unit.

    factor: readable value over SI value. decimals: decimals that the noise supports.
    """

    factor: float
    unit: str
    decimals: int

    def text(self, value: float | None) -> str:
        """Return a value without its unit; "-" if there is none."""
        if value is None:
            return "-"
        return f"{self.factor * value:z.{self.decimals}f}"

    def limit(self, value: float | None) -> str:
        """Return a limit without its unit; "-" if there is none."""
        return "-" if value is None else f"{self.factor * value:g}"


def scale_of(
    unit: str, noise: float | None, limit: float | None, before: Scale | None = None
) -> Scale:
    """Return the scale of a quantity in an SI unit from its noise (standard deviation) and limit.

    The last digit is the first one that is larger than the noise. With the scale `before`, its
    decimals are kept until the noise has clearly changed, so that a display does not flicker.
    """
    factor, prefix = next(
        (p for p in _PREFIXES if limit is not None and p[0] * limit >= _LEAST_LIMIT),
        _PREFIXES[0] if limit is None or not limit else _PREFIXES[-1],
    )
    least = noise or (limit or 1.0) / _PARTS_OF_LIMIT
    exact = -math.log10(factor * least)
    decimals = min(max(math.floor(exact + 1e-9), 0), _MOST_DECIMALS)
    if before is not None and before.decimals - 0.3 < exact < before.decimals + 1.3:
        decimals = before.decimals
    return Scale(factor, f"{prefix}{unit}", decimals)


def duration(seconds: float) -> str:
    """Return a time such as 42 s, 3 min 12 s or 1 h 02 min."""
    whole = round(seconds)
    if whole < _MINUTE_S:
        return f"{whole} s"
    if whole < _HOUR_S:
        return f"{whole // _MINUTE_S} min {whole % _MINUTE_S:02d} s"
    return f"{whole // _HOUR_S} h {whole % _HOUR_S // _MINUTE_S:02d} min"
