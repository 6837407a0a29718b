"""Describe a rig, its rows and its status to the rig page, as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...log.signals import SIGNALS
from ..control.faults import FAULTS, Fault
from ..control.states import IN_FLIGHT, State
from .decimation import Decimated
from .flight_events import Event

_SHOWN = {"rad": (1e3, "mrad"), "m": (1e6, "µm")}
"""Factor and unit of small displacements; a limit above `_LARGE` is shown in the next ones."""
_SHOWN_LARGE = {"rad": (1.0, "rad"), "m": (1e3, "mm")}
_LARGE = 0.02
_STATUS = (
    *("state", "cycle", "fault", "detail", "fault_log", "session", "step", "share"),
    *("late", "stale", "lost", "recording", "log_lost", "recorder_restarts"),
)


class Bar(NamedTuple):
    """One displacement with a reference: its fields, factor and unit to show, and its limit."""

    name: str
    field: str
    reference: str
    factor: float
    unit: str
    limit: float


def bars_of(rig: RigConfig) -> list[Bar]:
    """Return the displacements that a log has a reference of, in the order of the log."""
    limits = rig.limits
    names = {signal.name for signal in SIGNALS}
    arm_m = max(map(abs, (*rig.geometry.coil_x_m, *rig.geometry.coil_y_m)))
    tilt_rad = limits.tilt_rad or limits.gap_m / arm_m
    own = {"beam": limits.beam_m, "rotor": math.pi}
    bars = []
    for signal in SIGNALS:
        stem, _, unit = signal.name.rpartition("_")
        reference = f"{stem}_ref_{unit}"
        if signal.shape != "scalar" or unit not in _SHOWN or reference not in names:
            continue
        limit = own.get(stem, tilt_rad if unit == "rad" else limits.gap_m)
        factor, shown = (_SHOWN_LARGE if limit > _LARGE else _SHOWN)[unit]
        bars.append(Bar(stem, signal.name, reference, factor, shown, limit * factor))
    return bars


def rig_data(rig: RigConfig, control: bool) -> dict[str, Any]:
    """Return what does not change while the daemon runs."""
    place, limits = rig.geometry, rig.limits
    return {
        "name": rig.name,
        "rate_hz": rig.rate_hz,
        "control": control,
        "coils": list(zip(place.coil_x_m, place.coil_y_m, strict=True)),
        "sensors": list(zip(place.sensors_x_m, place.sensors_y_m, strict=True)),
        "bars": [bar._asdict() for bar in bars_of(rig)],
        "coil_n": limits.coil_n,
        "coil_rms_n": limits.coil_rms_n,
        "gap_m": limits.gap_m,
        "beam_m": limits.beam_m,
        "states": {state.name: state.meaning for state in State},
        "in_flight": sorted(state.name for state in IN_FLIGHT),
    }


def row_data(rows: Decimated, bars: list[Bar], heat: NDArray[np.float64]) -> dict[str, Any]:
    """Return the last row, with minimum and maximum of all intervals."""
    last = rows.last[-1]

    def low(field: str) -> Any:
        return rows.minimum[field].min(axis=0)

    def high(field: str) -> Any:
        return rows.maximum[field].max(axis=0)

    return {
        "cycle": int(last["cycle"]),
        "state": State(int(last["state"])).name if last["state"] in set(State) else "?",
        "bars": [
            [
                _short(value * bar.factor)
                for value in (
                    last[bar.field],
                    last[bar.reference],
                    low(bar.field),
                    high(bar.field),
                )
            ]
            for bar in bars
        ],
        "gaps": _list(last["gap_m"], 1e6),
        "gap_low": _list(low("gap_m"), 1e6),
        "gap_high": _list(high("gap_m"), 1e6),
        "coils": _list(last["coil_n"], 1.0),
        "heat": _list(np.sqrt(np.maximum(heat, 0.0)), 1.0),
        "late_us": [_short(1e6 * last["lateness_s"]), _short(1e6 * high("lateness_s"))],
        "execution_us": _short(1e6 * high("execution_s")),
        "saturated": int(high("saturated")),
        "stale": int(high("stale")),
    }


def status_data(status: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a page shows of the daemon's status."""
    fault = FAULTS[Fault[status["fault"]]]
    timing = status["timing"]
    return {
        **{key: status[key] for key in _STATUS},
        "zero_force": status["zero_force"],
        "cause": fault.cause,
        "check": fault.check,
        "cleared": fault.cleared,
        "lateness_us": timing["lateness_us"],
        "execution_us": timing["execution_us"],
        "late_by": timing["late_by"],
        "not_ready": [
            {"check": found["check"], "found": found["found"], "remedy": found["remedy"]}
            for found in status["preflight"]
            if found["outcome"] == "failed"
        ],
    }


def event_data(event: Event) -> dict[str, Any]:
    """Return an event."""
    return {"time_s": round(event.time_s, 3), "level": event.level, "text": event.text}


def _list(values: NDArray[np.floating[Any]], factor: float) -> list[float | None]:
    return [_short(value * factor) for value in values.tolist()]


def _short(value: float) -> float | None:
    """Return four digits, or None for what JSON does not know."""
    return float(f"{value:.4g}") if math.isfinite(value) else None
