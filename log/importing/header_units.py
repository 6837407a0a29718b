"""Read names and units from the header of a data file, and compare units."""

from __future__ import annotations

import math
import re
import unicodedata
from dataclasses import dataclass

from ...config.units import known_unit

_BRACKETS = re.compile(r"\s*(?:\[([^\[\]]*)\]|\(([^()]*)\)|\{([^{}]*)\}|<([^<>]*)>)\s*")
_DIVIDED = re.compile(r"^(?P<name>[^/]*?)\s*/\s*(?P<unit>\S+)$")
_WORDED = re.compile(r"^(?P<name>.*?)(?:\bin\s+|,\s*|:\s*|\s-\s)(?P<unit>\S+)$")
_ENDING = re.compile(r"^(?P<name>.+)_(?P<unit>[A-Za-z]+)$")
_TIMES = frozenset(
    {"t", "time", "times", "zeit", "temps", "timestamp", "stamp", "timestamps", "clock", "date"}
    | {"datetime", "uhrzeit", "datum", "tijd", "tiempo", "tempo"}
)
"""Words, in lower case, one of which the name of a time has if it has no unit of time."""
_NO_TIMES = frozenset({"seq", "ref", "count", "constant", "settling", "rise", "execution", "cycle"})
"""Words that make it another quantity."""
_WORDS = {
    **dict.fromkeys(("volt", "volts", "vdc", "vac"), "V"),
    **dict.fromkeys(("amp", "amps", "ampere", "amperes"), "A"),
    **dict.fromkeys(("second", "seconds", "sec", "secs"), "s"),
    **dict.fromkeys(("millisecond", "milliseconds", "msec", "msecs", "millis"), "ms"),
    **dict.fromkeys(("microsecond", "microseconds", "usec", "usecs", "micros"), "us"),
    **dict.fromkeys(("nanosecond", "nanoseconds", "nsec", "nsecs", "nanosec", "nanosecs"), "ns"),
    "nanos": "ns",
    **dict.fromkeys(("newton", "newtons"), "N"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("micrometer", "micrometers", "micron", "microns"), "um"),
    **dict.fromkeys(("degree", "degrees", "degs", "grad"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("u/min", "1/min", "rev/min", "min-1", "r/min"), "rpm"),
    **dict.fromkeys(("hertz", "sa/s", "samples/s", "samples/sec", "sps"), "Hz"),
}
"""Units written as words, in lower case."""


@dataclass(frozen=True)
class HeaderCell:
    """A cell of the header: its text, its name without unit, its unit ("" if it has none)."""

    text: str
    name: str
    unit: str = ""


def header_unit(text: str) -> str | None:
    """Return a unit in a spelling that known_unit reads, such as V for VOLT; None if unknown."""
    text = unicodedata.normalize("NFKC", text).strip()
    if known_unit(text) is not None and text != "-":
        return text
    return _WORDS.get(text.lower())


def header_cell(text: str) -> HeaderCell:
    """Split the text of a header cell: Position [mm], Current (A), time/s, position_mm, C1 in V.

    Brackets hold a unit. Elsewhere only a known unit counts, and a single letter after an
    underscore does only for times: `i_a` is a current of the armature.
    """
    text = " ".join(unicodedata.normalize("NFC", text).split())
    brackets = [
        (found, next(g for g in found.groups() if g is not None).strip())
        for found in _BRACKETS.finditer(text)
    ]
    known = [each for each in brackets if header_unit(each[1])]
    # V(pos) and u[0] are names; in another unit than the known ones, counts stand apart.
    last = [
        each
        for each in brackets
        if each[0].end() == len(text) and each[0][0][:1] in " [" and not each[1].isdigit()
    ]
    for found, unit in [*known[-1:], *last]:
        name = f"{text[: found.start()]} {text[found.end() :]}".strip()
        return HeaderCell(text, name or text, unit)
    for pattern in (_DIVIDED, _WORDED):
        match = pattern.match(text)
        if match and header_unit(match["unit"]) and (match["name"].strip() or pattern is _WORDED):
            return HeaderCell(text, match["name"].strip() or text, match["unit"])
    if (ending := _ENDING.match(text)) and known_unit(ending["unit"]):
        unit = ending["unit"]
        if (len(unit) > 1 and unit != "min") or (unit == "s" and is_time_name(ending["name"])):
            return HeaderCell(text, ending["name"], unit)
    return HeaderCell(text, text)


def is_time_name(name: str) -> bool:
    """Return whether a column's name without unit says that it holds the time."""
    words = set(_words(name))
    named = bool(words & _TIMES) or time_unit_in(name) is not None
    return named and not words & _NO_TIMES


def time_unit_in(name: str) -> str | None:
    """Return the unit of time that a column's name has as a word, such as micros or ms.

    Of units with few letters, the name is nothing else: v_ms is a speed. None without one.
    """
    if (whole := known_unit(name)) is not None and whole.si == "s" and whole.factor < 1.0:
        return name
    units = (_WORDS.get(word) for word in _words(name))
    return next((unit for unit in units if unit in ("s", "ms", "us", "ns")), None)


def _words(name: str) -> list[str]:
    return re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower())


def unit_slip(header: str, unit: str, scale: float) -> str | None:
    """Return in words why a unit after `scale` contradicts the header's; None if it may be right.

    A scale between different quantities, such as a force constant, may be anything but 1.
    """
    if header == unit.replace(" ", "").lower():
        return None  # a column's name in small letters: nm is N m too
    ours, theirs = known_unit(unit), known_unit(header_unit(header) or header)
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
