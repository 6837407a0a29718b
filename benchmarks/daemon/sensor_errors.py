"""Spoil sensor readings on request, alike on every backend.

Lines: `frozen 4` (repeats its reading; several sensors as `frozen 2,5`, or `frozen all`), `off 4
0.0005` (m), `drift 4 0.0001` (m/s), `gain 4 1.03`, `spike 4 0.0002` (m, one cycle in 50),
`intermittent 4 0.0003` (m, half of the time, in turns of 0.2 s).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NAMES = ("frozen", "off", "drift", "gain", "spike", "intermittent")
_SPIKE_EVERY = 50
_TURN_S = 0.2


class SensorErrors:
    """Errors of S sensors; `spoil` applies them to the readings of each cycle."""

    def __init__(self, sensors: int, period_s: float) -> None:
        self._period_s = period_s
        self._held = np.zeros(sensors)
        self._lines: list[tuple[str, list[int], float]] = []
        self._cycles = 0

    @property
    def active(self) -> bool:
        """Whether any error is on."""
        return bool(self._lines)

    def command(self, line: str) -> None:
        """Begin the error of a line; raises ValueError."""
        name, at, *amount = line.split()
        if name not in NAMES:
            raise ValueError(f"expected one of {', '.join(NAMES)}, found '{name}'")
        sensors = range(len(self._held)) if at == "all" else map(int, at.split(","))
        self._lines.append((name, list(sensors), float(amount[0]) if amount else 0.0))
        self._cycles = 0

    def clear(self) -> None:
        """End all errors."""
        self._lines.clear()

    def spoil(self, gap_m: Array) -> None:
        """Change the readings (S,) of a cycle, in m, in place."""
        self._cycles += 1
        passed_s = self._cycles * self._period_s
        for name, at, amount in self._lines:
            if name == "frozen":
                gap_m[at] = self._held[at]
            elif name == "off":
                gap_m[at] += amount
            elif name == "drift":
                gap_m[at] += amount * passed_s
            elif name == "gain":
                gap_m[at] *= amount
            elif name == "spike":
                gap_m[at] += amount * (self._cycles % _SPIKE_EVERY == 1)
            else:
                gap_m[at] += amount * (passed_s % (2.0 * _TURN_S) < _TURN_S)
        self._held[:] = gap_m
