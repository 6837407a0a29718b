"""Read numbers from the cells of a table: decimal signs, separators of thousands, units."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from typing import Literal

from ...config.units import KnownUnit, known_unit

Decimal = Literal[".", ","]
Thousands = Literal[".", ",", " ", "'"]
Proof = Literal["decimal", "thousands", "either"]
"""What a sign in a number is: a decimal sign, a separator of thousands, or one of the two."""

MISSING = frozenset(
    {"", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "---", "?", "*", "<null>"}
    | {"-nan", "nan(ind)", "-nan(ind)", "1.#ind", "-1.#ind", "1.#qnan", "-1.#qnan"}
    | {"1.#inf", "-1.#inf", "\N{INFINITY}", "-\N{INFINITY}", "+\N{INFINITY}"}
    | {"#num!", "#value!", "#div/0!", "#ref!", "ol", "-ol", "+ol", "ovld", "ovl"}
)
"""Cells, in lower case, that hold no value; `ol` and the like: the meter was overloaded."""
_PLAIN = str.maketrans(
    {
        **dict.fromkeys("\u2212\u2010\u2011\u2012\u2013\ufe63\uff0d", "-"),
        **dict.fromkeys("\u00a0\u2007\u2009\u200a\u202f\u2002\u2003\u3000", " "),
        **dict.fromkeys("\u200b\u200e\u200f\u2060\ufeff", ""),
        **dict.fromkeys("\u2019\u02bc", "'"),
        "\uff0c": ",",
        "\uff0e": ".",
        "\uff0b": "+",
        "\u066b": ",",
    }
)
"""Signs that mean the same as an ASCII sign: minus, spaces of any width, apostrophes."""
_UNUSUAL = frozenset("dD '")
"""Characters of which a number with only ASCII signs needs one to be rewritten."""
_SPACED = re.compile(r"[-+]?\d{1,3}(?:([ '])\d{3})(?:\1\d{3})*(?:[.,]\d*)?")
"""Thousands that are separated by spaces or apostrophes, which nothing else can be."""
_FORTRAN = re.compile(r"([-+]?(?:\d+[.,]?\d*|[.,]\d+))[dD]([-+]?\d{1,3})")
_ONE_SIGN = re.compile(r"[-+]?(?P<before>\d*)(?P<sign>[.,])(?P<after>\d*)(?P<exp>[eE][-+]?\d+)?")
_GROUPS = re.compile(r"[-+]?\d{1,3}(?P<sign>[.,])\d{3}(?:(?P=sign)\d{3})+")
_BOTH = re.compile(
    r"[-+]?\d{1,3}(?:(?P<thousands>[.,])\d{3})+(?!(?P=thousands))(?P<decimal>[.,])\d*"
    r"(?:[eE][-+]?\d+)?"
)
_WITH_UNIT = re.compile(r"(?P<number>[-+]?[\d.,][\d.,]*(?:[eE][-+]?\d+)?)\s*(?P<unit>[^\d\s,.;].*)")


@dataclass(frozen=True)
class NumberFormat:
    """Signs of the numbers in a file. decimal, thousands: None if the file does not state them."""

    decimal: Decimal | None = None
    thousands: Thousands | None = None

    @property
    def decimal_sign(self) -> Decimal | None:
        """The decimal sign that is stated, or that the separator of thousands leaves."""
        if self.decimal is None and self.thousands in (".", ","):
            return "," if self.thousands == "." else "."
        return self.decimal

    def number(self, cell: str) -> float | None:
        """Return the number in a cell; None if it is none in this format.

        Without stated signs, point and comma are decimal signs. Python takes 1_0 for 10; in a table
        it is a slip or a name.
        """
        if "_" in cell:
            return None
        if self is ANY_FORMAT:
            try:
                return float(cell)
            except ValueError:
                pass
        text = plain(cell)
        if self.thousands is not None and self.thousands in text:
            if not _in_groups(text, self.thousands):
                return None
            text = text.replace(self.thousands, "")
        decimal = self.decimal_sign
        if decimal is not None and ("," if decimal == "." else ".") in text:
            return None
        try:
            return float(text.replace(",", ".", 1))
        except ValueError:
            return None


ANY_FORMAT = NumberFormat()


def plain(cell: str) -> str:
    """Return a cell with ASCII signs: minus and spaces as other programs write them, 1.5D3."""
    text = cell
    if not text.isascii():
        text = text.translate(_PLAIN).strip()
    elif text.isdecimal() or not _UNUSUAL & set(text):
        return text
    if found := _FORTRAN.fullmatch(text):
        return f"{found[1]}e{found[2]}"
    if _SPACED.fullmatch(text):
        return text.replace(" ", "").replace("'", "")
    return text


def is_missing(cell: str) -> bool:
    """Return whether a cell says that there is no value."""
    return plain(cell).lower() in MISSING


def with_unit(cell: str) -> tuple[str, KnownUnit, str] | None:
    """Return number, unit and its text of a cell such as `0.5 sec`; None for another cell."""
    found = _WITH_UNIT.fullmatch(plain(cell))
    unit = known_unit(found["unit"]) if found else None
    if found is None or unit is None or ANY_FORMAT.number(found["number"]) is None:
        return None
    return found["number"], unit, found["unit"].strip()


def sign_meaning(cell: str) -> tuple[str, Proof] | None:
    """Return the point or comma in a number and what it must be; None if there is none.

    1.5, 0.123 and 1234.567 have a decimal sign, 1.234.567 a separator of thousands; 1.234 may have
    either. Of a number with both signs, this is about the separator of thousands.
    """
    text = plain(cell)
    if both := _BOTH.fullmatch(text):
        return both["thousands"], "thousands"
    if groups := _GROUPS.fullmatch(text):
        return groups["sign"], "thousands"
    found = _ONE_SIGN.fullmatch(text)
    if found is None:
        return None
    before, after = found["before"], found["after"]
    grouped = 1 <= len(before) <= 3 and before[0] != "0" and len(after) == 3 and not found["exp"]
    return found["sign"], "either" if grouped else "decimal"


def strange_letters(text: str) -> str:
    """Return in words the letters of a text that only look like ASCII; "" without any."""
    found = [c for c in dict.fromkeys(text) if not c.isascii()]
    names = [f"{c!r} is {unicodedata.name(c, 'a sign without name').lower()}" for c in found[:3]]
    return f" ({', '.join(names)})" if names else ""


def _in_groups(text: str, thousands: str) -> bool:
    """Return whether a sign separates groups of three digits before the decimal sign."""
    whole = re.split(r"[eE]", text.lstrip("+-"))[0]
    for decimal in {".", ","} - {thousands}:
        whole = whole.split(decimal)[0]
    first, *others = whole.split(thousands)
    return 1 <= len(first) <= 3 and all(len(group) == 3 for group in others)
