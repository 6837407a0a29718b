"""Write a draft of a SIGNALS.yaml from a data file: columns, units, time, and roles by name."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...config.escaping import MOST_NAME, one_line
from ...config.units import known_unit
from ..errors import LogError
from .clock_restarts import written_once
from .columns_of_file import FileColumn, FileColumns, list_columns, read_columns
from .header_units import header_unit
from .number_cells import NumberFormat
from .outlying_values import find_codes
from .time_axis import time_axis
from .time_columns import TIME_UNITS, ClockColumn, find_clock
from .wrapped_values import find_wrap

Array = NDArray[np.float64]

_VOLTAGE = frozenset({"voltage", "volt", "spannung"})
_CURRENT = frozenset({"current", "strom", "i"})
_INPUTS = frozenset(
    {*_VOLTAGE, *_CURRENT, "u", "input", "in", "force", "kraft", "torque", "moment", "command"}
    | {"cmd", "duty", "pwm", "actuator"}
)
_OUTPUTS = frozenset(
    {"y", "output", "out", "position", "pos", "x", "angle", "phi", "theta", "displacement", "gap"}
    | {"velocity", "vel", "speed", "acceleration", "acc", "encoder", "weg", "winkel", "drehzahl"}
)
_REFERENCES = frozenset({"ref", "reference", "setpoint", "target", "soll", "sollwert"})
"""Words in a column's name that state its role."""
_RESERVED = ("time_s", "cycle")
_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_.]*")
_WORDS = frozenset({"yes", "no", "on", "off", "true", "false", "null"})
"""Words that YAML does not read as text."""
FILL_IN = "FILL_IN"
_MOST_QUOTED = 200
_MOST_STEM = MOST_NAME - 10
"""Longest name made of a header: a number and a unit may follow."""
_RATE_DIFFERENCE = 0.01
"""Relative difference of the rate that a file states from that of its time stamps, to report."""
_SHOWN_VALUES = 5
_TWO_CLOCKS = "check: a second clock: delete this line unless it adds to the time"


@dataclass(frozen=True)
class Draft:
    """Text of a SIGNALS.yaml; what to fill in before it can be used; what to check."""

    text: str
    fill_in: tuple[str, ...]
    check: tuple[str, ...]


@dataclass(frozen=True)
class _Entry:
    """A line of the list of columns; `doubt` and the range of the values become its comment."""

    column: FileColumn
    name: str
    unit: str
    scale: float
    role: str
    doubt: str = ""
    span: str = ""


def draft_signals(path: Path) -> Draft:
    """Return a draft of the SIGNALS.yaml for a data file.

    Raises:
        LogError: not a data file, or a file without columns of numbers.
    """
    found = list_columns(path)
    if not found.columns:
        listed = "; ".join(found.others[:20]) or "nothing"
        raise LogError(f"{path}: expected columns of numbers of one length, found {listed}")
    values, damage = read_columns(path, found)
    readings = [np.where(find_codes(each, levels=True), np.nan, each) for each in values]
    clocks, rate_lines, fill_in = _time(path, found, readings)
    entries = _entries(found.columns, values, readings, clocks)
    sign_lines, open_signs = _signs(found)
    fill_in = (*open_signs, *fill_in)
    roles = {entry.role for entry in entries}
    missing = [role for role in ("input", "output") if role not in roles]
    if missing:
        entries = [
            replace(e, doubt=f"fill in: role: {' or '.join(missing)}?")
            if e.role == "other" and not e.doubt
            else e
            for e in entries
        ]
        fill_in = (*fill_in, f"role: {' and '.join(missing)}; the columns without a role are other")
    damage = f"check: {_quoted(damage.removeprefix(f'{path}: '))}" if damage else ""
    lines = [
        f"# Draft for {_quoted(path.name)}",
        "# Check the lines marked 'check', and complete the lines marked 'fill in'.",
        "# docs/configuration.md, section SIGNALS.yaml, describes all keys.",
        "levid: signals",
        *([f"# {damage}"] if damage else []),
        *sign_lines,
        *rate_lines,
        *(["samples: columns"] if found.samples == "columns" else []),
        "# input_hold: zoh   # input between samples: held (zoh), linear (foh), or band_limited",
        "# If a controller drives an input, say so (docs/log-format.md, 'Data of a control loop'):",
        "# loop: {controller: unknown}",
        "columns:",
        *(_line(entry) for entry in entries),
    ]
    if found.others:
        lines += [
            "# Not listed above:",
            *(f"#   {_quoted(other)}" for other in found.others),
        ]
    check = tuple(f"{e.name}: {e.doubt}" for e in entries if e.doubt.startswith("check"))
    return Draft("\n".join(lines) + "\n", fill_in, (*([damage] if damage else []), *check))


def _signs(found: FileColumns) -> tuple[list[str], tuple[str, ...]]:
    """Return the lines on decimal signs and separators of thousands, and what to fill in."""
    signs = found.number_format
    lines = [f'decimal: "{signs.decimal}"'] if signs.decimal else []
    lines += [f'thousands: "{signs.thousands}"'] if signs.thousands else []
    if not found.two_meanings:
        return lines, ()
    sign = signs.decimal or signs.thousands or "."
    assert sign in (".", ",")
    shown = _quoted(found.two_meanings)
    as_decimal = NumberFormat(decimal="." if sign == "." else ",").number(found.two_meanings)
    as_group = NumberFormat(thousands="." if sign == "." else ",").number(found.two_meanings)
    question = (
        f'decimal: "{sign}" if {shown} means {as_decimal:g}, thousands: "{sign}" if it means '
        f"{as_group:g}"
    )
    return [f"decimal: {FILL_IN}   # fill in: {question}"], (question,)


def _time(
    path: Path, found: FileColumns, values: Sequence[Array]
) -> tuple[tuple[ClockColumn, ...], list[str], tuple[str, ...]]:
    """Return the columns with the time, the lines on the rate, and what to fill in."""
    rate_hz = found.rate[1] if found.rate else None
    whole = [each for each in values if len(each)]
    if whole:
        rows = written_once(whole, whole)
        values = [each[rows] if len(each) else each for each in values]
    signals = (_INPUTS | _OUTPUTS | _REFERENCES) - {"x"}
    first_is_signal = bool(signals & set(_words(found.columns[0].label)))
    clocks = find_clock(found.columns, values, rate_hz, first_is_signal=first_is_signal)
    if clocks:
        parts_s = [clock.seconds(values) for clock in clocks]
        try:
            grid = time_axis(str(path), parts_s, [""] * len(clocks), clocks[0].unit_s).grid
        except LogError as error:
            reason = _quoted(str(error).removeprefix(f"{path}: "))
            return clocks, [f"# check: the time: {reason}"], ()
        if clocks[0].unknown:
            column = found.columns[clocks[0].index]
            name = column.label or f"column {column.column}"
            rates = [f"{unit} for {f / grid.period_s:.4g} Hz" for unit, f in TIME_UNITS]
            ticks = "s and scale: 1 / (counts per second) for another counter"
            return clocks, [], (f"unit of {name}: {', '.join(rates)}, {ticks}",)
        rate = [f"# The time column gives the rate, {1.0 / grid.period_s:.6g} Hz."]
        if not grid.regular:
            rate = [
                "# The time stamps are irregular. This key interpolates them to a constant rate:",
                "# resample: true",
            ]
        elif rate_hz is not None and abs(rate_hz * grid.period_s - 1.0) > _RATE_DIFFERENCE:
            assert found.rate is not None
            rate.append(f"# check: the file says {_quoted(found.rate[0])}")
        return clocks, rate, ()
    if found.rate is not None:
        name, rate_hz = found.rate
        return (), [f"rate_hz: {rate_hz:.10g}   # check: from {_quoted(name)}"], ()
    line = f"rate_hz: {FILL_IN}   # fill in: samples per second"
    return (), [line], ("rate_hz: samples per second",)


def _entries(
    columns: Sequence[FileColumn],
    values: Sequence[Array],
    readings: Sequence[Array],
    clocks: Sequence[ClockColumn],
) -> list[_Entry]:
    clock_of = {clock.index: clock for clock in clocks}
    words = [set(_words(column.label)) for column in columns]
    has_voltage = any(own & _VOLTAGE for own in words)
    entries: list[_Entry] = []
    for number, (column, own) in enumerate(zip(columns, words, strict=True)):
        taken = [entry.name for entry in entries]
        if (clock := clock_of.get(number)) is not None:
            unit, name = FILL_IN if clock.unknown else clock.unit, _unique("t", taken)
            doubt = "fill in: unit" if clock.unknown else clock.doubt
            span = "" if column.dates else _span(values[number], column.unit)
            entries.append(_Entry(column, name, unit, clock.scale, "time", doubt, span))
            continue
        if column.dates:
            entries.append(_Entry(column, _unique("date_s", taken), "s", 1.0, "time", _TWO_CLOCKS))
            continue
        role, doubt = "other", ""
        if own & _CURRENT and has_voltage:
            doubt = "check: input if the current is controlled, output if the voltage is"
        elif own & _REFERENCES:
            role, doubt = "reference", "check: role"
        elif own & _INPUTS and not own & _OUTPUTS:
            role, doubt = "input", "check: role"
        elif own & _OUTPUTS and not own & _INPUTS:
            role, doubt = "output", "check: role"
        known = known_unit(header_unit(column.unit) or column.unit) if column.unit else None
        unit, scale = (known.si, known.factor) if known else (_usable(column.unit), 1.0)
        if not column.unit and doubt:
            doubt = f"{doubt}, unit"
        stem = "_".join(_words(column.label)) or f"column_{number}"
        ending = _ending(unit)
        if ending and not stem.endswith(f"_{ending}"):
            stem = f"{stem}_{ending}"
        span = _span(values[number], column.unit)
        wrap = find_wrap(readings[number])
        if wrap is not None and wrap.range is not None:
            span += f"; may begin again after {wrap.range:.10g} (key wraps)"
        entries.append(_Entry(column, _unique(stem, taken), unit, scale, role, doubt, span))
    return entries


def _line(entry: _Entry) -> str:
    keys = [f"column: {_scalar(entry.column.column)}"]
    if entry.column.index is not None:
        keys.append(f"index: {entry.column.index}")
    keys += [f"name: {_scalar(entry.name)}", f"unit: {_scalar(entry.unit)}", f"role: {entry.role}"]
    if entry.scale != 1.0:
        keys.append(f"scale: {entry.scale:.10g}")
    comment = "; ".join(text for text in (entry.doubt, entry.span) if text)
    return f"  - {{{', '.join(keys)}}}{f'   # {comment}' if comment else ''}"


def _span(values: Array, unit: str) -> str:
    """Return the range of a column and five values of it, in the unit of the file."""
    known = values[~np.isnan(values)]
    if not len(known):
        return ""
    some = known[np.linspace(0, len(known) - 1, _SHOWN_VALUES).astype(int)]
    named = f" {_usable(unit)}" if unit else ""
    listed = ", ".join(f"{value:.6g}" for value in some)
    return f"values {known.min():.4g} to {known.max():.4g}{named}, such as {listed}"


def _words(text: str) -> list[str]:
    """Return the words of a name in lower case: letters and digits of ASCII."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text)
    return re.findall(r"[a-z]+\d*|\d+", apart.lower())


def _ending(unit: str) -> str:
    """Return a unit as the end of a name, such as m_s2 for m/s2."""
    return "hz" if unit == "1/s" else "_".join(_words(unit)) if unit != "1" else ""


def _usable(unit: str) -> str:
    """Return a unit that a SIGNALS.yaml accepts; 1 for none."""
    return re.sub(r"[\[\],#\s]+", " ", unit).strip() or "1"


def _unique(stem: str, taken: Iterable[str]) -> str:
    stem = (stem if stem[:1].isalpha() else f"column_{stem}")[:_MOST_STEM].rstrip("_")
    names = {*taken, *_RESERVED}
    numbered = (f"{stem}_{number}" for number in range(2, 10_000))
    return stem if stem not in names else next(name for name in numbered if name not in names)


def _scalar(value: int | str) -> str:
    """Return a value as YAML."""
    if isinstance(value, int):
        return str(value)
    if _PLAIN.fullmatch(value) and value.lower() not in _WORDS:
        return value
    return json.dumps(value, ensure_ascii=not value.isprintable())


def _quoted(text: str) -> str:
    """Return the start of a text for a comment."""
    return one_line(text)[:_MOST_QUOTED]
