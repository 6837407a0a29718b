"""Convert the cells of one column to numbers, and report numbers that have two meanings."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...config.units import KnownUnit
from ..errors import LogError
from .number_cells import NumberFormat, is_missing, plain, sign_meaning, strange_letters, with_unit
from .signals_yaml import Column, SignalsFile
from .text_layout import TextLayout
from .time_cells import Stamp, stamp, stamps_s

_SIGN_NAMES = {".": "points", ",": "commas"}
_SHOWN = 40
"""Most characters of a cell in an error."""


class ColumnReader:
    """Convert cells to numbers, NaN for those without a value.

    unit: the unit that the cells themselves state, "" if they do not. Where SIGNALS.yaml does not
    state the signs of the numbers, the first cell of each kind is kept for `check_signs`.
    """

    def __init__(
        self, path: Path, column: Column, signals: SignalsFile, layout: TextLayout
    ) -> None:
        self.column = column
        self.unit = ""
        self.seen: dict[tuple[str, str], tuple[int, str]] = {}
        self._path = path
        self._format = NumberFormat(signals.decimal, signals.thousands)
        self._stated = self._format.decimal_sign is not None
        # float() reads neither decimal commas nor separators of thousands.
        self._quick = self._format.decimal_sign != "," and signals.thousands is None
        self._decimal_signs = {sign for sign, proof in layout.signs if proof == "decimal"}
        self._decided = self._stated or "." in self._decimal_signs
        self._missing = {text for text in signals.missing if isinstance(text, str)}
        self._numbers = array("d")
        self._stamps: dict[int, Stamp] = {}
        self._first_unit: KnownUnit | None = None

    def read(self, line: int, cell: str) -> None:
        """Append the number in a cell; raise LogError if there is none."""
        if self._quick:
            try:
                value = float(cell)
            except ValueError:
                pass
            else:
                if "_" not in cell:
                    if not self._decided and "." in cell:
                        self._note_sign(line, cell)
                    self._numbers.append(value)
                    return
        self._numbers.append(self._other(line, cell))

    def values(self) -> NDArray[np.float64]:
        """Return the numbers (n,); dates in s after the first."""
        found = np.array(self._numbers, np.float64)
        if self._stamps:
            return stamps_s([self._stamps.get(row) for row in range(len(found))])
        return found

    def notes(self) -> list[str]:
        """Return remarks on how the cells were read."""
        if any(s.zoned for s in self._stamps.values()):
            return [f"{self.column.name}: times with an offset are converted to UTC"]
        return []

    def _other(self, line: int, cell: str) -> float:
        if cell in self._missing:
            return float("nan")
        if (value := self._format.number(cell)) is not None:
            self._note_sign(line, cell)
            return value
        if is_missing(cell):
            return float("nan")
        if self.column.role == "time" and (when := stamp(cell)) is not None:
            return self._stamp(line, cell, when)
        if (found := with_unit(cell)) is not None:
            number, unit, text = found
            value = self._format.number(number)
            if self._first_unit is None:
                self._first_unit, self.unit = unit, text
            if value is not None and unit.si == self._first_unit.si:
                self._note_sign(line, number)
                return value * (unit.factor / self._first_unit.factor)
        raise self._error(line, cell)

    def _stamp(self, line: int, cell: str, when: Stamp) -> float:
        if self.column.unit != "s":
            raise LogError(
                f"{self._path}: {self.column.label}: dates and times of day are converted to s; "
                f"expected unit: s, found {self.column.unit}"
            )
        first = next(iter(self._stamps.values()), when)
        if (first.zoned, first.has_date) != (when.zoned, when.has_date):
            raise LogError(
                f"{self._path}: line {line}, {self.column.label}: expected a date, a time of day "
                f"and an offset from UTC in all rows or in none, found {cell[:_SHOWN]!r}"
            )
        self._stamps[len(self._numbers)] = when
        return float("nan")

    def _note_sign(self, line: int, cell: str) -> None:
        known = {sign for sign in ".," if sign in cell} == self._decimal_signs
        if self._stated or known:
            return
        meaning = sign_meaning(cell)
        if meaning is None:
            return
        self.seen.setdefault(meaning, (line, cell))
        if meaning[1] == "decimal":
            self._decimal_signs.add(meaning[0])
            self._decided = self._decided or meaning[0] == "."

    def _error(self, line: int, cell: str) -> LogError:
        where = f"{self._path}: line {line}, {self.column.label}"
        meaning = sign_meaning(cell)
        if meaning is not None and meaning[1] == "thousands" and not self._stated:
            return LogError(
                f"{where}: expected a number without separators of thousands, found "
                f'{cell[:_SHOWN]!r}; set thousands: "{meaning[0]}" in the signals file'
            )
        if meaning is not None and self._stated:
            decimal = self._format.decimal_sign
            thousands = self._format.thousands
            other = "" if thousands is None else f' and thousands: "{thousands}"'
            return LogError(
                f'{where}: expected a number as decimal: "{decimal}"{other} says, found '
                f"{cell[:_SHOWN]!r}; state the other sign too, by decimal or thousands, or correct "
                "the cell"
            )
        remedy = strange_letters(plain(cell))
        if not remedy and not any(c.isdigit() for c in cell):
            remedy = (
                "; if it means that there is no value, list it in the signals file: "
                f"missing: [{cell[:_SHOWN]!r}]"
            )
        elif not remedy:
            remedy = "; correct the cell, or empty it if its value is lost"
        return LogError(f"{where}: expected a number, found {cell[:_SHOWN]!r}{remedy}")


def check_signs(path: Path, readers: Sequence[ColumnReader], layout: TextLayout) -> None:
    """Raise LogError if a point or comma in the numbers may be a decimal sign or none.

    A number that can be read in one way only decides for the whole file.
    """
    seen = {
        key: (line, reader.column.label, cell)
        for reader in reversed(readers)
        for key, (line, cell) in reader.seen.items()
    }
    decimal = {sign for sign, proof in (*seen, *layout.signs) if proof == "decimal"}
    mixed = [seen[sign, "decimal"] for sign in ".," if (sign, "decimal") in seen]
    if len(decimal) > 1 and mixed:
        line, label, cell = max(mixed)
        other: Literal[".", ","] = "." if "," in cell else ","
        raise LogError(
            f"{path}: line {line}, {label}: expected decimal points or decimal commas in the whole "
            f"file, found both: {cell[:_SHOWN]!r} beside numbers with decimal {_SIGN_NAMES[other]}"
        )
    for sign in ".,":
        if sign in decimal or (sign, "either") not in seen:
            continue
        line, label, cell = seen[sign, "either"]
        number = NumberFormat(decimal=sign).number(cell)  # type: ignore[arg-type]
        grouped = NumberFormat(thousands=sign).number(cell)  # type: ignore[arg-type]
        question = f'{number:g} or {grouped:g}; set decimal: "{sign}" or thousands: "{sign}"'
        if decimal:  # the other sign
            question = f'{grouped:g}, as other numbers have another sign; set thousands: "{sign}"'
        raise LogError(
            f"{path}: line {line}, {label}: expected numbers that can be read in one way, found "
            f"{cell[:_SHOWN]!r}: {question} in the signals file, or correct the cell"
        )
