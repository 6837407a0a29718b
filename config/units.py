"""Read units such as mm, N m/rad or kg m^2, and their factors to SI."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

_BASES: dict[str, tuple[float, str]] = {
    "s": (1.0, "s"),
    "m": (1.0, "m"),
    "A": (1.0, "A"),
    "V": (1.0, "V"),
    "N": (1.0, "N"),
    "Nm": (1.0, "N m"),
    "W": (1.0, "W"),
    "J": (1.0, "J"),
    "Hz": (1.0, "1/s"),
    "Pa": (1.0, "Pa"),
    "T": (1.0, "T"),
    "K": (1.0, "K"),
    "Ohm": (1.0, "Ohm"),
    "rad": (1.0, "rad"),
}
"""Units that take a prefix: factor to the SI unit, and the SI unit."""
_OTHERS: dict[str, tuple[float, str]] = {
    "min": (60.0, "s"),
    "h": (3600.0, "s"),
    "d": (86400.0, "s"),
    "sec": (1.0, "s"),
    "second": (1.0, "s"),
    "seconds": (1.0, "s"),
    "Second": (1.0, "s"),
    "Volt": (1.0, "V"),
    "Ampere": (1.0, "A"),
    "msec": (1e-3, "s"),
    "usec": (1e-6, "s"),
    "kg": (1.0, "kg"),
    "deg": (math.pi / 180.0, "rad"),
    "rpm": (math.pi / 30.0, "rad/s"),
    "%": (0.01, "1"),
    "1": (1.0, "1"),
    "-": (1.0, "1"),
}
_PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
_SPELLINGS = {"µ": "u", "μ": "u", "°": "deg", "Ω": "Ohm", "²": "2", "³": "3", "·": " ", "*": " "}
_FACTOR = re.compile(r"([A-Za-z%]+|1|-)\^?([23]?)")


_LARGEST_ARM_M, _LEAST_ARM_M = 10.0, 1e-3
"""Distances of the outermost coil or sensor from the centre that no platform exceeds."""


def position_slip(positions: Mapping[str, Sequence[float]]) -> str | None:
    """Return what is wrong if positions on a platform are in another unit than m; else None.

    `positions` are coordinates in m by key.
    """
    for key, values in positions.items():
        far = max(map(abs, values), default=0.0)
        if far > _LARGEST_ARM_M:
            slip = f"; do you mean {far / 1e3:g} m?" if far <= 1e3 * _LARGEST_ARM_M else ""
            return (
                f"{key}: expected positions within +-{_LARGEST_ARM_M:g} m of the centre, found "
                f"{far:g} m{slip}"
            )
    every = [abs(x) for values in positions.values() for x in values]
    if every and max(every) < _LEAST_ARM_M:
        return (
            f"{next(iter(positions))}: expected positions up to {_LEAST_ARM_M:g} m or more from "
            f"the centre, found {max(every):g} m; is it in m?"
        )
    return None


@dataclass(frozen=True)
class KnownUnit:
    """A unit: its factor to SI, the SI unit in the spelling of levid."""

    factor: float
    si: str


def known_unit(text: str) -> KnownUnit | None:
    """Return the unit that a text such as mm, m/s^2 or N m says; None for an unknown unit."""
    text = text.strip()
    for spelling, plain in _SPELLINGS.items():
        text = text.replace(spelling, plain)
    factor, parts = 1.0, []
    for position, product in enumerate(text.split("/")):
        found = [_power(part) for part in product.strip("() ").split()]
        if not found or None in found:
            return None
        for unit in found:
            assert unit is not None
            factor *= unit.factor if position == 0 else 1.0 / unit.factor
        words = [unit.si for unit in found if unit is not None and unit.si != "1"]
        parts.append(" ".join(words) or "1")
    while len(parts) > 1 and parts[-1] == "1":
        parts.pop()
    return KnownUnit(factor, "/".join(parts))


def si_slip(text: str) -> str | None:
    """Return in words what is not SI about the unit of a number in SI; None if nothing is known."""
    # Not in the table: in the header of an accelerometer, g is 9.81 m/s^2.
    if re.search(r"(^|[ /*(])m?g\b", text):
        return f"expected an SI unit with kg, found {text}: a gram is 1e-3 kg"
    known = known_unit(text)
    if known is None or math.isclose(known.factor, 1.0, rel_tol=1e-9):
        return None
    return (
        f"expected an SI unit without prefix, found {text}: use {known.si}, and the value times "
        f"{known.factor:.6g}"
    )


def _power(text: str) -> KnownUnit | None:
    """Return one factor of a unit, such as mm or s^2."""
    found = _FACTOR.fullmatch(text)
    if found is None:
        return None
    word, power = found[1], int(found[2] or 1)
    base = _OTHERS.get(word)
    if base is None:
        for prefix, factor in _PREFIXES.items():
            known = _BASES.get(word.removeprefix(prefix)) if word.startswith(prefix) else None
            if known is not None:
                base = (factor * known[0], known[1])
                break
    if base is None:
        return None
    return KnownUnit(base[0] ** power, base[1] if power == 1 else f"{base[1]}{power}")
