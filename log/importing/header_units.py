"""Read names and units from the header of a data file, and compare units."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from ...config.units import known_unit

_BRACKETED = re.compile(r"^(?P<name>.*?)\s*(?:\[(?P<square>[^\[\]]*)\]|\((?P<round>[^()]*)\))$")
_DIVIDED = re.compile(r"^(?P<name>[^/]*?)\s*/\s*(?P<unit>\S+)$")
_ENDING = re.compile(r"^(?P<name>.+)_(?P<unit>[A-Za-z]+)$")
_TIMES = ("t", "time", "zeit", "timestamp", "time_stamp")
"""Names of times, in lower case: an ending `_s` is their unit."""


@dataclass(frozen=True)
class HeaderCell:
    """A cell of the header: its text, its name without unit, its unit ("" if it has none)."""

    text: str
    name: str
    unit: str = ""


def header_cell(text: str) -> HeaderCell:
    """Split the text of a header cell: Position [mm], Current (A), time/s, position_mm.

    Brackets always hold a unit. After a slash or an underscore only a known unit counts, and a
    single letter after an underscore does only for times: `i_a` is a current of the armature.
    """
    text = text.strip()
    if found := _BRACKETED.match(text):
        unit = found["square"] if found["square"] is not None else found["round"]
        return HeaderCell(text, found["name"] or text, unit.strip())
    if (found := _DIVIDED.match(text)) and known_unit(found["unit"]) and found["name"]:
        return HeaderCell(text, found["name"], found["unit"])
    if (found := _ENDING.match(text)) and known_unit(found["unit"]):
        unit = found["unit"]
        if (len(unit) > 1 and unit != "min") or (unit == "s" and is_time_name(found["name"])):
            return HeaderCell(text, found["name"], unit)
    return HeaderCell(text, text)


def is_time_name(name: str) -> bool:
    """Return whether a column's name without unit says that it holds the time."""
    return name.strip().lower().replace(" ", "_") in _TIMES


def unit_slip(header: str, unit: str, scale: float) -> str | None:
    """Return in words why a unit after `scale` contradicts the header's; None if it may be right.

    A scale between different quantities, such as a force constant, may be anything but 1.
    """
    if header == unit.replace(" ", "").lower():
        return None  # a column's name in small letters: nm is N m too
    ours, theirs = known_unit(unit), known_unit(header)
    if ours is None or theirs is None:
        return None
    if ours.si == theirs.si:
        right = theirs.factor / ours.factor
        if math.isclose(abs(scale), right, rel_tol=0.01):
            return None
        return (
            f"the header says {header}, but unit is {unit} with scale {scale:g}; expected "
            f"scale: {right:.6g}, or unit: {header}"
        )
    if scale != 1.0:
        return None
    return (
        f"the header says {header}, but unit is {unit} with scale 1; expected unit: {header}, or "
        f"the scale from {header} to {unit}"
    )
