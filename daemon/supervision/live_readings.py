"""Read pose, manipulator, coils and gaps of the newest cycle for the status, with their limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...log.signals import SIGNALS

Array = NDArray[np.float64]

_RECENT_S, _MOST_ROWS = 0.25, 512
_NOISE_ROWS, _LEAST_ROWS = 128, 16
"""Newest rows from which noise is estimated."""
_UNITS = {signal.name: signal.unit for signal in SIGNALS}
_MANIPULATOR = ("beam", "rotor")
_TILT_OR_GAP = {"rad": "tilt_rad", "m": "gap_m"}
"""Limit of a DOF of the platform by its unit."""


def recent_rows(rig: RigConfig) -> int:
    """Return how many of the newest rows `live_readings` needs: 0.25 s, at most 512 rows."""
    return min(max(round(_RECENT_S * rig.rate_hz), _LEAST_ROWS), _MOST_ROWS)


def live_readings(rows: NDArray[np.void], heat_n2: Array, rig: RigConfig) -> dict[str, Any]:
    """Return the keys `pose`, `manipulator`, `coils` and `gaps` of the status.

    rows: the newest `recent_rows` log rows, oldest first; without rows all values are None.
    heat_n2: low-pass squared force of each coil (C,) in N^2.
    """
    limits = rig.limits
    pose = [
        _quantity(rows, dof, getattr(limits, _TILT_OR_GAP[unit]), unit)
        for dof in type(rig.control).model_fields
        for unit in _TILT_OR_GAP
        if f"{dof}_{unit}" in _UNITS
    ]
    manipulator = [
        _quantity(rows, name, getattr(limits, f"{name}_{unit}", None), unit)
        for name in _MANIPULATOR
        for unit in _TILT_OR_GAP
        if f"{name}_{unit}" in _UNITS
    ]
    return {
        "pose": pose,
        "manipulator": manipulator,
        "coils": {
            "unit": _UNITS["coil_n"],
            "value": _numbers(rows, "coil_n"),
            "readback": _numbers(rows, "coil_readback_n"),
            "rms": [_number(value) for value in np.sqrt(np.maximum(heat_n2, 0.0))],
            "limit": limits.coil_n,
            "rms_limit": limits.coil_rms_n,
        },
        "gaps": {
            "unit": _UNITS["gap_m"],
            "value": _numbers(rows, "gap_m"),
            "noise": noise(rows["gap_m"]),
            "limit": limits.gap_m,
        },
    }


def last_cycle(rows: NDArray[np.void]) -> dict[str, float | None]:
    """Return lateness and execution time of the newest row in us; None without rows."""
    return {
        f"{name}_us": 1e6 * float(rows[f"{name}_s"][-1]) if len(rows) else None
        for name in ("lateness", "execution")
    }


def noise(values: NDArray[np.generic]) -> float | None:
    """Return the standard deviation of white noise in the newest values (n,) or (n, channels).

    It follows from third differences, which remove slow motion: their variance is 20 times that of
    white noise. The median makes it robust against steps. Of several channels the median counts.
    None if there are too few values.
    """
    if len(values) < _LEAST_ROWS:
        return None
    third = np.diff(values[-_NOISE_ROWS:].astype(np.float64), 3, axis=0)
    deviation = 1.4826 * np.median(np.abs(third), axis=0) / math.sqrt(20.0)
    return _number(float(np.median(deviation)))


def _quantity(
    rows: NDArray[np.void], name: str, limit: float | None, unit: str
) -> dict[str, str | float | None]:
    column, reference = f"{name}_{unit}", f"{name}_ref_{unit}"
    return {
        "name": name,
        "unit": unit,
        "value": _number(rows[column][-1]) if len(rows) else None,
        "reference": _number(rows[reference][-1]) if len(rows) else None,
        "low": _number(rows[column].min()) if len(rows) else None,
        "high": _number(rows[column].max()) if len(rows) else None,
        "noise": noise(rows[column]),
        "limit": limit,
    }


def _numbers(rows: NDArray[np.void], name: str) -> Sequence[float | None]:
    """Return the newest value of each channel; None of each without rows."""
    channels = rows[name].shape[1]
    return [_number(value) for value in rows[name][-1]] if len(rows) else [None] * channels


def _number(value: float) -> float | None:
    """Return a finite number; None for others, which JSON cannot represent."""
    return float(value) if math.isfinite(value) else None
