"""Find the sampling rate that a data file states beside its columns."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from ...config.units import known_unit
from .header_units import header_cell, header_unit
from .number_cells import ANY_FORMAT, with_unit

_PERIODS = frozenset(
    {"ts", "dt", "sampletime", "samplingtime", "period", "tsample", "deltax", "deltat", "increment"}
    | {"xincrement", "xinc", "sampleinterval", "samplinginterval", "sampleperiod", "timeperpoint"}
    | {"samplingperiod", "timeinterval", "interval", "timestep", "stepsize", "horizontalinterval"}
    | {"abtastzeit", "abtastintervall", "zeitschritt", "cycletime", "timebaseinterval", "xdelta"}
    | {"recordinterval", "timedelta", "wfdt", "hinterval", "hresolution", "horizontalresolution"}
)
_RATES = frozenset(
    {"fs", "rate", "samplerate", "samplingrate", "fsample", "ratehz", "samplefrequency"}
    | {"samplingfrequency", "abtastrate", "scanrate", "acquisitionrate", "samplespersecond"}
    | {"abtastfrequenz", "samplefreq", "samplingfreq", "messrate", "datarate"}
)
"""Names of the sampling interval and of the rate, in lower case, letters only."""


def stated_rate(entries: Iterable[tuple[str, str | float]]) -> tuple[str, float] | None:
    """Return the rate in Hz that an entry (name, value) states, and the entry as text.

    An interval without a unit is in s, a rate in Hz. None if no entry states a rate, or if two
    entries contradict each other.
    """
    found = [rate for name, value in entries if (rate := _rate(name, value)) is not None]
    if not found or any(not math.isclose(rate, found[0][1], rel_tol=1e-3) for _, rate in found):
        return None
    return found[0]


def _rate(name: str, value: str | float) -> tuple[str, float] | None:
    cell = header_cell(name)
    word = re.sub(r"[^a-zäöü]", "", cell.name.rpartition(".")[2].lower())
    is_period, is_rate = word in _PERIODS, word in _RATES
    if not (is_period or is_rate):
        return None
    unit = header_unit(cell.unit) if cell.unit else None
    if isinstance(value, str):
        parts = with_unit(value)
        if parts is not None:
            unit = header_unit(parts[2])
        number = ANY_FORMAT.number(parts[0] if parts else value)
    else:
        number = value
    if number is None or not 0.0 < number < math.inf:
        return None
    known = known_unit(unit) if unit else known_unit("s" if is_period else "Hz")
    if known is None or known.si not in ("s", "1/s"):
        return None
    factor = known.factor * number
    shown = f"{name} = {number:g}{f' {unit}' if unit else ' s' if is_period else ' Hz'}"
    return shown, 1.0 / factor if known.si == "s" else factor
